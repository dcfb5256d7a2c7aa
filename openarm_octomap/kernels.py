# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the map: the exact walk along each ray, log-odds.

Together with `end_kernels` they do what liboctomap does for a cloud whose points are first made unique by cell, with
the same types in the same order, so that the cells come out identical. Coordinates are in the frame of the map, m;
keys are those of `octree.lattice`. Marks of a scan: bit 0 a ray went through, bit 1 a ray ended there. The GIL
is released.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from openarm_common.octree.lattice import KEY_ZERO
from openarm_common.robot.filter_kernels import Whole
from openarm_common.types import Bytes, Floats, Ints

FREE_BIT, HIT_BIT = 1, 2
UNKNOWN, FREE, OCCUPIED = 0, 1, 2
_HUGE = 1.7976931348623157e308


@njit(cache=True, nogil=True, inline="always")
def _centre(index: Whole, first: Whole, resolution: float) -> np.float32:
    return np.float32((np.float64(index + first - KEY_ZERO) + 0.5) * resolution)


@njit(cache=True, nogil=True, inline="always")
def _norm(x: np.float32, y: np.float32, z: np.float32) -> np.float64:
    return np.sqrt(np.float64(x * x + y * y + z * z))


@njit(cache=True, nogil=True)
def cell_distance(x: Whole, y: Whole, z: Whole, key_min: Ints, resolution: float, origin: Floats) -> np.float64:
    """Distance of the centre of a cell, given by its index, from a point (3,), m; as liboctomap computes it."""
    return _norm(
        _centre(x, key_min[0], resolution) - origin[0],
        _centre(y, key_min[1], resolution) - origin[1],
        _centre(z, key_min[2], resolution) - origin[2],
    )


@njit(cache=True, nogil=True)
def walk_rays(
    ends: NDArray[np.int32], count: int, resolution: float, key_min: Ints, origin: Floats, max_range: float,
    marks: Bytes,
) -> int:  # fmt: skip
    """Mark the cells that rays pass through, from the origin to before the centre of each end cell.

    The origin and the ends may lie outside of the box. The arithmetic is that of liboctomap: positions in float32,
    parameters along the ray in float64, summed step by step, and a ray stops where its parameter passes its length.

    Args:
        ends: (n, 3) cell indices relative to the box.
        count: How many of them count.
        resolution: Edge of a cell, m.
        key_min: (3,) key of marks[0, 0, 0].
        origin: (3,) where the rays begin, m.
        max_range: Rays end here at the latest, m; negative: no limit.
        marks: (nx, ny, nz) C-contiguous, changed.

    Returns:
        How many steps were made.
    """
    nx, ny, nz = marks.shape
    flat = marks.ravel()
    factor = 1.0 / resolution
    o0, o1, o2 = origin[0], origin[1], origin[2]
    begin_x = int(np.floor(factor * np.float64(o0))) + KEY_ZERO - key_min[0]
    begin_y = int(np.floor(factor * np.float64(o1))) + KEY_ZERO - key_min[1]
    begin_z = int(np.floor(factor * np.float64(o2))) + KEY_ZERO - key_min[2]
    begins_inside = 0 <= begin_x < nx and 0 <= begin_y < ny and 0 <= begin_z < nz
    steps = 0
    for i in range(count):
        qx, qy, qz = np.int64(ends[i, 0]), np.int64(ends[i, 1]), np.int64(ends[i, 2])
        e0, e1, e2 = _centre(qx, key_min[0], resolution), _centre(qy, key_min[1], resolution), np.float32(0.0)
        e2 = _centre(qz, key_min[2], resolution)
        d0, d1, d2 = e0 - o0, e1 - o1, e2 - o2
        norm = _norm(d0, d1, d2)
        if max_range >= 0.0 and norm > max_range:
            length32, range32 = np.float32(norm), np.float32(max_range)
            e0 = o0 + (d0 / length32) * range32
            e1 = o1 + (d1 / length32) * range32
            e2 = o2 + (d2 / length32) * range32
            qx = int(np.floor(factor * np.float64(e0))) + KEY_ZERO - key_min[0]
            qy = int(np.floor(factor * np.float64(e1))) + KEY_ZERO - key_min[1]
            qz = int(np.floor(factor * np.float64(e2))) + KEY_ZERO - key_min[2]
            d0, d1, d2 = e0 - o0, e1 - o1, e2 - o2
            norm = _norm(d0, d1, d2)
        gx, gy, gz = begin_x, begin_y, begin_z
        if qx == gx and qy == gy and qz == gz:
            continue
        # a ray whose ends lie on the same outer side of the box never enters it
        if (
            (gx < 0 and qx < 0) or (gy < 0 and qy < 0) or (gz < 0 and qz < 0)
            or (gx >= nx and qx >= nx) or (gy >= ny and qy >= ny) or (gz >= nz and qz >= nz)
        ):  # fmt: skip
            continue
        length32 = np.float32(norm)
        length = np.float64(length32)
        d0 /= length32
        d1 /= length32
        d2 /= length32
        sx = 1 if d0 > 0 else (-1 if d0 < 0 else 0)
        sy = 1 if d1 > 0 else (-1 if d1 < 0 else 0)
        sz = 1 if d2 > 0 else (-1 if d2 < 0 else 0)
        tx, ty, tz, ax, ay, az = _HUGE, _HUGE, _HUGE, _HUGE, _HUGE, _HUGE
        if sx != 0:
            border = (np.float64(gx + key_min[0] - KEY_ZERO) + 0.5) * resolution
            border += np.float64(np.float32(sx * resolution * 0.5))
            tx = (border - np.float64(o0)) / np.float64(d0)
            ax = resolution / abs(np.float64(d0))
        if sy != 0:
            border = (np.float64(gy + key_min[1] - KEY_ZERO) + 0.5) * resolution
            border += np.float64(np.float32(sy * resolution * 0.5))
            ty = (border - np.float64(o1)) / np.float64(d1)
            ay = resolution / abs(np.float64(d1))
        if sz != 0:
            border = (np.float64(gz + key_min[2] - KEY_ZERO) + 0.5) * resolution
            border += np.float64(np.float32(sz * resolution * 0.5))
            tz = (border - np.float64(o2)) / np.float64(d2)
            az = resolution / abs(np.float64(d2))
        left = abs(qx - gx) + abs(qy - gy) + abs(qz - gz)
        done = False
        if not begins_inside:
            while not done:
                if tx < ty:
                    if tx < tz:
                        gx += sx
                        tx += ax
                    else:
                        gz += sz
                        tz += az
                elif ty < tz:
                    gy += sy
                    ty += ay
                else:
                    gz += sz
                    tz += az
                left -= 1
                steps += 1
                if (left == 0 and gx == qx and gy == qy and gz == qz) or min(min(tx, ty), tz) > length:
                    done = True
                elif 0 <= gx < nx and 0 <= gy < ny and 0 <= gz < nz:
                    break
        if done:
            continue
        # the box is convex: once the ray is out again it stays out
        step_x, step_y = sx * ny * nz, sy * nz
        out_x = nx if sx > 0 else -1
        out_y = ny if sy > 0 else -1
        out_z = nz if sz > 0 else -1
        at = (gx * ny + gy) * nz + gz
        flat[at] |= FREE_BIT
        while True:
            if tx < ty:
                if tx < tz:
                    gx += sx
                    tx += ax
                    at += step_x
                    if gx == out_x:
                        break
                else:
                    gz += sz
                    tz += az
                    at += sz
                    if gz == out_z:
                        break
            elif ty < tz:
                gy += sy
                ty += ay
                at += step_y
                if gy == out_y:
                    break
            else:
                gz += sz
                tz += az
                at += sz
                if gz == out_z:
                    break
            left -= 1
            steps += 1
            if (left == 0 and gx == qx and gy == qy and gz == qz) or min(min(tx, ty), tz) > length:
                break
            flat[at] |= FREE_BIT
    return steps


@njit(cache=True, nogil=True)
def apply_marks(
    marks: Bytes, log_odds: Floats, states: Bytes, seen: NDArray[np.int32], now: int,
    hit: np.float32, miss: np.float32, low: np.float32, high: np.float32, changed: NDArray[np.int32],
) -> int:  # fmt: skip
    """Turn marks into log-odds, and clear the marks.

    Args:
        marks: (n,) flat; a cell that a ray ended in counts as hit, whatever went through it.
        log_odds: (n,), NaN where unknown.
        states: (n,) UNKNOWN, FREE, OCCUPIED.
        seen: (n,) when each cell was last looked at.
        now: Written to `seen`.
        hit: Added for a hit.
        miss: Added for a miss.
        low: Lower limit.
        high: Upper limit.
        changed: (n,), filled with the indices of the cells whose state changed.

    Returns:
        How many states changed.
    """
    count = 0
    words = marks.view(np.uint64)
    for i in range(words.size):
        if words[i] == 0:
            continue
        for j in range(8 * i, 8 * i + 8):
            mark = marks[j]
            if mark == 0:
                continue
            value = log_odds[j]
            if np.isnan(value):
                value = np.float32(0.0)
            value = min(value + hit, high) if mark & HIT_BIT else max(value + miss, low)
            state = OCCUPIED if value >= np.float32(0.0) else FREE
            if state != states[j]:
                states[j] = state
                changed[count] = j
                count += 1
            log_odds[j] = value
            seen[j] = now
        words[i] = 0
    return count


@njit(cache=True, nogil=True)
def forget_before(
    limit: int, log_odds: Floats, states: Bytes, seen: NDArray[np.int32], changed: NDArray[np.int32]
) -> int:
    """Make occupied cells unknown that were last looked at before `limit`; flat arrays, returns how many."""
    count = 0
    for i in range(states.size):
        if states[i] == OCCUPIED and seen[i] < limit:
            states[i] = UNKNOWN
            log_odds[i] = np.float32(np.nan)
            changed[count] = i
            count += 1
    return count
