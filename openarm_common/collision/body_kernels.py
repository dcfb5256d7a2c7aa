# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of where bodies and their shapes are. Body 0 is the base, body i + 1 follows joint i. m, rad."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from openarm_common.kernels import inlined_kernel
from openarm_common.types import Array, Ints


@inlined_kernel
def place_bodies(
    q: Array, parents: Ints, placements: Array, axes: Array, prismatic: NDArray[np.bool_], frames: Array
) -> None:
    """Bring bodies to where they are in a state.

    Args:
        q: (n,) of the joints.
        parents: (n,) body that joint i hangs on.
        placements: (n, 4, 4) of each joint in its parent body at zero.
        axes: (n, 3) unit, in the joint's frame.
        prismatic: (n,) which joints slide.
        frames: (n + 1, 3, 4) poses of bodies; the first one is given, the others are written.
    """
    for i in range(parents.shape[0]):
        p = parents[i]
        x, y, z = axes[i, 0], axes[i, 1], axes[i, 2]
        c, s = 1.0, 0.0
        if not prismatic[i]:
            c, s = math.cos(q[i]), math.sin(q[i])
        v = 1.0 - c
        t00, t01, t02 = c + x * x * v, x * y * v - z * s, x * z * v + y * s
        t10, t11, t12 = y * x * v + z * s, c + y * y * v, y * z * v - x * s
        t20, t21, t22 = z * x * v - y * s, z * y * v + x * s, c + z * z * v
        for r in range(3):
            p0, p1, p2 = frames[p, r, 0], frames[p, r, 1], frames[p, r, 2]
            a0 = p0 * placements[i, 0, 0] + p1 * placements[i, 1, 0] + p2 * placements[i, 2, 0]
            a1 = p0 * placements[i, 0, 1] + p1 * placements[i, 1, 1] + p2 * placements[i, 2, 1]
            a2 = p0 * placements[i, 0, 2] + p1 * placements[i, 1, 2] + p2 * placements[i, 2, 2]
            a3 = p0 * placements[i, 0, 3] + p1 * placements[i, 1, 3] + p2 * placements[i, 2, 3]
            frames[i + 1, r, 0] = a0 * t00 + a1 * t10 + a2 * t20
            frames[i + 1, r, 1] = a0 * t01 + a1 * t11 + a2 * t21
            frames[i + 1, r, 2] = a0 * t02 + a1 * t12 + a2 * t22
            along = (a0 * x + a1 * y + a2 * z) * q[i] if prismatic[i] else 0.0
            frames[i + 1, r, 3] = a3 + frames[p, r, 3] + along


@inlined_kernel
def put_shape(k: int, bodies: Ints, poses: Array, frames: Array, done: Ints, world: Array) -> None:
    """Bring a shape to where its body is, once a state."""
    b, now = bodies[k], done[done.shape[0] - 1]
    if b > 0 and done[k] != now:
        done[k] = now
        for r in range(3):
            f0, f1, f2 = frames[b, r, 0], frames[b, r, 1], frames[b, r, 2]
            for c in range(4):
                world[k, r, c] = f0 * poses[k, 0, c] + f1 * poses[k, 1, c] + f2 * poses[k, 2, c]
            world[k, r, 3] += frames[b, r, 3]
