# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of a body and the map: balls in the distance field, and where one is too near, the cells themselves.

The kernels release the GIL. m, base frame.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from openarm_common.types import Array, Ints
from openarm_motion.collision.fast_model import Model, Work
from openarm_motion.collision.shape_kernels import separation


@njit(cache=True, nogil=True, inline="always")
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


@njit(cache=True, nogil=True)
def map_room(m: int, enough: float, model: Model, work: Work) -> float:
    """By how much a body is further from the map than it must be; looked for until it is `enough`."""
    groups, spheres, shapes, keeps = model.sphere_groups, model.spheres, model.sphere_shapes, model.sphere_keep
    field, corner, edge = model.field, model.corner, model.edge
    kinds, sizes, bodies, poses = model.kinds, model.sizes, model.bodies, model.poses
    frames, done, world = work.frames, work.done, work.world
    frame = frames[groups[m, 0]]
    least, cell, width = enough, kinds.shape[0] - 1, edge[0]
    for k in range(groups[m, 1], groups[m, 2]):
        room = map_distance(frame, spheres[k], field, corner, edge)
        if room >= 0.0:
            least = min(least, room)
            continue
        # the ball is too near: look at the shape itself and each cell that the ball may be near to
        i, keep, least = shapes[k], keeps[k], 0.0
        put_shape(i, bodies, poses, frames, done, world)
        reach = spheres[k, 3] + width
        low, high = np.empty(3, np.int64), np.empty(3, np.int64)
        for r in range(3):
            x = frame[r, 3] - corner[r]
            for c in range(3):
                x += frame[r, c] * spheres[k, c]
            low[r] = max(math.floor((x - reach) / width), 0)
            high[r] = min(math.floor((x + reach) / width) + 1, field.shape[r])
        for x in range(low[0], high[0]):
            for y in range(low[1], high[1]):
                for z in range(low[2], high[2]):
                    if field[x, y, z] > 0.0:
                        continue
                    world[cell, 0, 3] = corner[0] + (x + 0.5) * width
                    world[cell, 1, 3] = corner[1] + (y + 0.5) * width
                    world[cell, 2, 3] = corner[2] + (z + 0.5) * width
                    if separation(i, cell, keep, kinds, sizes, world) < keep:
                        return -1.0
    return least


@njit(cache=True, nogil=True)
def map_distance(frame: Array, ball: Array, field: NDArray[np.float32], corner: Array, edge: Array) -> float:
    """Distance in the map at a ball's centre less its radius and what rounding to cells takes."""
    nx, ny, nz = field.shape
    inverse = 1.0 / edge[0]
    x = frame[0, 0] * ball[0] + frame[0, 1] * ball[1] + frame[0, 2] * ball[2] + frame[0, 3] - corner[0]
    y = frame[1, 0] * ball[0] + frame[1, 1] * ball[1] + frame[1, 2] * ball[2] + frame[1, 3] - corner[1]
    z = frame[2, 0] * ball[0] + frame[2, 1] * ball[1] + frame[2, 2] * ball[2] + frame[2, 3] - corner[2]
    # the nearest cell stands for a point outside: what is in the map is no nearer to the point than to it
    i = min(max(math.floor(x * inverse), 0), nx - 1)
    j = min(max(math.floor(y * inverse), 0), ny - 1)
    k = min(max(math.floor(z * inverse), 0), nz - 1)
    return field[i, j, k] - ball[3] - edge[1]
