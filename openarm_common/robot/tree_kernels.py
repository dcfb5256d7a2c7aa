# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of a kinematic tree: where its bodies are. Body 0 is the base, body i + 1 follows joint i. m, rad."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from openarm_common.kernels import inlined_kernel, kernel
from openarm_common.types import Array, Ints


@kernel
def unplaced(n: int) -> Array:
    """Frames (n + 1, 3, 4) of a base and n bodies that `place_bodies` has yet to place."""
    frames = np.zeros((n + 1, 3, 4))
    for r in range(3):
        frames[0, r, r] = 1.0
    return frames


@inlined_kernel
def place_bodies(
    q: Array,
    parents: Ints,
    placements: Array,
    axes: Array,
    prismatic: NDArray[np.bool_],
    frames: Array,
    levers: Array,
) -> None:
    """Bring bodies to where they are in a state.

    Args:
        q: (n,) of the joints.
        parents: (n,) body that joint i hangs on.
        placements: (n, 4, 4) of each joint in its parent body at zero.
        axes: (n, 3) unit, in the joint's frame.
        prismatic: (n,) which joints slide.
        frames: (n + 1, 3, 4) poses of bodies; the first one is given, the others are written.
        levers: (n, 6) direction and origin of the axis of each joint, written; with them comes the Jacobian.
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
            levers[i, r], levers[i, 3 + r] = a0 * x + a1 * y + a2 * z, a3 + frames[p, r, 3]
            along = levers[i, r] * q[i] if prismatic[i] else 0.0
            frames[i + 1, r, 3] = levers[i, 3 + r] + along


@kernel
def forward(
    q: Array,
    parents: Ints,
    placements: Array,
    axes: Array,
    prismatic: NDArray[np.bool_],
    body: int,
    tip: Array,
    frames: Array,
    levers: Array,
    out: Array,
) -> None:
    """Fill `out` (4, 4) with the pose of what is at `tip` (4, 4) of a body, `frames` and `levers` as `place_bodies`."""
    place_bodies(q, parents, placements, axes, prismatic, frames, levers)
    for r in range(3):
        x, y, z = frames[body, r, 0], frames[body, r, 1], frames[body, r, 2]
        out[r, 3] = frames[body, r, 3] + x * tip[0, 3] + y * tip[1, 3] + z * tip[2, 3]
        for c in range(3):
            out[r, c] = x * tip[0, c] + y * tip[1, c] + z * tip[2, c]
        out[3, r] = 0.0
    out[3, 3] = 1.0


@kernel
def forward_many(
    states: Array,
    parents: Ints,
    placements: Array,
    axes: Array,
    prismatic: NDArray[np.bool_],
    body: int,
    tip: Array,
) -> Array:
    """Return the poses (m, 4, 4) of what is at `tip` (4, 4) of a body in states (m, n)."""
    m, n = states.shape
    poses, frames, levers = np.empty((m, 4, 4)), unplaced(n), np.empty((n, 6))
    for k in range(m):
        forward(states[k], parents, placements, axes, prismatic, body, tip, frames, levers, poses[k])
    return poses


@kernel
def jacobian(levers: Array, prismatic: NDArray[np.bool_], p: Array, out: Array) -> None:
    """Fill the geometric Jacobian (6, n) of a chain at point `p`: linear rows first, base frame.

    Args:
        levers: (n, 6) as `place_bodies` writes them.
        prismatic: (n,) which joints slide.
        p: (3,) m.
        out: (6, n).
    """
    for i in range(levers.shape[0]):
        x, y, z = levers[i, 0], levers[i, 1], levers[i, 2]
        if prismatic[i]:
            out[0, i], out[1, i], out[2, i] = x, y, z
            out[3, i], out[4, i], out[5, i] = 0.0, 0.0, 0.0
            continue
        dx, dy, dz = p[0] - levers[i, 3], p[1] - levers[i, 4], p[2] - levers[i, 5]
        out[0, i] = y * dz - z * dy
        out[1, i] = z * dx - x * dz
        out[2, i] = x * dy - y * dx
        out[3, i], out[4, i], out[5, i] = x, y, z
