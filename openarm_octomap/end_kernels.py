# SPDX-License-Identifier: Apache-2.0
"""Numba kernels: the cells in which the rays of a depth image or a cloud end, each once.

Coordinates are in the frame of the map, m; points are float32 and become keys in float64, as in liboctomap. For keys
and marks see `openarm_octomap.kernels`. The GIL is released.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from openarm_common.camera.depth_view import DepthImage
from openarm_common.octree.lattice import KEY_ZERO
from openarm_common.robot.filter_kernels import Whole
from openarm_common.types import Bytes, Floats, Ints
from openarm_octomap.kernels import HIT_BIT, cell_distance

Shorts = NDArray[np.uint16]


@njit(cache=True, nogil=True, inline="always")
def _key(x: Whole, y: Whole, z: Whole) -> np.int64:
    return (np.int64(x) + 1048576) << 42 | (np.int64(y) + 1048576) << 21 | (np.int64(z) + 1048576)


@njit(cache=True, nogil=True)
def _free_slot(x: Whole, y: Whole, z: Whole, table: Ints) -> Whole:
    """Where a cell belongs in a hash table of keys that are -1 where there is none; -1 when it is there already."""
    mask, key = table.size - 1, _key(x, y, z)
    slot = np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40)) & mask
    while table[slot] != -1:
        if table[slot] == key:
            return -1
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def image_points(
    depth: DepthImage, scale: np.float32, near: np.float32, far: np.float32,
    ray_x: Floats, ray_y: Floats, T: Floats, out: Floats,
) -> int:  # fmt: skip
    """Points of the valid pixels in the frame of the map, as `image_ends` computes them.

    Args:
        depth: (h, w) planar depth in counts of `scale` metres.
        scale: Metres of a count.
        near: Nearest valid depth, m.
        far: Farthest valid depth, m.
        ray_x: (w,) x over z of each column.
        ray_y: (h,) y over z of each row.
        T: (3, 4) float32, camera in the frame of the map.
        out: (h * w, 3), filled.

    Returns:
        How many points there are.
    """
    n = 0
    for v in range(depth.shape[0]):
        b = ray_y[v]
        for u in range(depth.shape[1]):
            z = np.float32(depth[v, u]) * scale
            if near <= z <= far:
                a = ray_x[u]
                out[n, 0] = (T[0, 0] * a + (T[0, 1] * b + T[0, 2])) * z + T[0, 3]
                out[n, 1] = (T[1, 0] * a + (T[1, 1] * b + T[1, 2])) * z + T[1, 3]
                out[n, 2] = (T[2, 0] * a + (T[2, 1] * b + T[2, 2])) * z + T[2, 3]
                n += 1
    return n


@njit(cache=True, nogil=True)
def image_ends(
    depth: DepthImage, scale: np.float32, near: np.float32, far: np.float32,
    block: int, stride: int, reach: np.float32,
    ray_x: Floats, ray_y: Floats, T: Floats, label: Bytes,
    resolution: float, key_min: Ints, origin: Floats, max_range: float,
    marks: Bytes, ticks: Shorts, tick: int, table: Ints, ends: NDArray[np.int32],
) -> tuple[int, int, int]:  # fmt: skip
    """Cells where the rays of a depth image end, each once; those of surfaces are marked.

    Args:
        depth: As for `image_points`, and so are `scale`, `near`, `far`, `ray_x`, `ray_y`, `T`.
        scale: Metres of a count.
        near: Nearest valid depth, m.
        far: Farthest valid depth, m.
        block: Edge in pixels of the blocks whose pixels must all lack a return for a ray to clear; 0: none clears.
        stride: Every so many columns and rows of such a block have a ray.
        reach: How far such a ray clears, m.
        ray_x: (w,).
        ray_y: (h,).
        T: (3, 4).
        label: (h, w): 0 surroundings; 1 robot: the ray clears up to it and marks nothing; 2 nothing is known.
        resolution: Edge of a cell, m.
        key_min: (3,) key of marks[0, 0, 0].
        origin: (3,) the camera.
        max_range: Surfaces further away than this mark nothing, m; negative: none does.
        marks: (nx, ny, nz), changed.
        ticks: (nx, ny, nz): which scan last had an end in the cell; changed.
        tick: Number of this scan, not in `ticks` yet.
        table: Hash table of the keys outside of the box: a power of two long, all -1 before and after.
        ends: (h * w, 3), filled with keys.

    Returns:
        How many ends there are, how many pixels had a valid depth, how many rays without return clear.
    """
    h, w = depth.shape
    nx, ny, nz = marks.shape
    factor = 1.0 / resolution
    used = np.empty(table.size // 2, np.int32)
    outside, m, valid, cleared = 0, 0, 0, 0
    last_x, last_y, last_z, last_hit = -1, -1, -1, False
    block_size = max(block, 1)
    empty = np.zeros(w // block_size + 1, np.bool_)
    bx, by, bz = KEY_ZERO - key_min[0], KEY_ZERO - key_min[1], KEY_ZERO - key_min[2]
    for v in range(h):
        b = ray_y[v]
        p0 = T[0, 1] * b + T[0, 2]
        p1 = T[1, 1] * b + T[1, 2]
        p2 = T[2, 1] * b + T[2, 2]
        if block > 0 and v % block == 0:
            _find_empty(depth, scale, near, far, label, v, block, empty)
        for u in range(w):
            z = np.float32(depth[v, u]) * scale
            hit = label[v, u] == 0
            if near <= z <= far:
                valid += 1
                if label[v, u] == 2:
                    continue
            elif empty[u // block_size] and u % stride == 0 and v % stride == 0:
                z, hit = reach, False
                cleared += 1
            else:
                continue
            a = ray_x[u]
            x = int(np.floor(factor * np.float64((T[0, 0] * a + p0) * z + T[0, 3]))) + bx
            y = int(np.floor(factor * np.float64((T[1, 0] * a + p1) * z + T[1, 3]))) + by
            q = int(np.floor(factor * np.float64((T[2, 0] * a + p2) * z + T[2, 3]))) + bz
            if x == last_x and y == last_y and q == last_z and hit == last_hit:
                continue
            last_x, last_y, last_z, last_hit = x, y, q, hit
            # the same as in `cloud_ends`: a function of all these arrays, inlined or not, takes 1.7 times as long
            if 0 <= x < nx and 0 <= y < ny and 0 <= q < nz:
                if hit and not marks[x, y, q] & HIT_BIT:
                    near_enough = True
                    if max_range >= 0.0:
                        near_enough = cell_distance(x, y, q, key_min, resolution, origin) <= max_range
                    if near_enough:
                        marks[x, y, q] |= HIT_BIT
                if ticks[x, y, q] == tick:
                    continue
                ticks[x, y, q] = tick
            else:
                slot = _free_slot(x, y, q, table)
                if slot < 0 or outside >= used.size:
                    continue
                table[slot] = _key(x, y, q)
                used[outside] = slot
                outside += 1
            ends[m, 0], ends[m, 1], ends[m, 2] = x, y, q
            m += 1
    for i in range(outside):
        table[used[i]] = -1
    return m, valid, cleared


@njit(cache=True, nogil=True)
def _find_empty(
    depth: DepthImage, scale: np.float32, near: np.float32, far: np.float32, label: Bytes,
    v0: int, block: int, empty: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Which blocks of the rows from v0 have no return at all: a dropout in a surface is no view into the distance."""
    h, w = depth.shape
    for i in range(empty.size):
        u0 = i * block
        empty[i] = v0 + block <= h and u0 + block <= w
        for v in range(v0, min(v0 + block, h)):
            if not empty[i]:
                break
            for u in range(u0, u0 + block):
                z = np.float32(depth[v, u]) * scale
                if near <= z <= far or label[v, u] != 0:
                    empty[i] = False
                    break


@njit(cache=True, nogil=True)
def cloud_ends(
    points: Floats, label: Bytes,
    resolution: float, key_min: Ints, origin: Floats, max_range: float,
    marks: Bytes, ticks: Shorts, tick: int, table: Ints, ends: NDArray[np.int32],
) -> tuple[int, int]:  # fmt: skip
    """As `image_ends` for points (n, 3) float32 in the frame of the map; `label` is (n,), the rest the same.

    Returns:
        How many ends there are, and how many points were finite.
    """
    nx, ny, nz = marks.shape
    factor = 1.0 / resolution
    used = np.empty(table.size // 2, np.int32)
    outside, m, valid = 0, 0, 0
    limit = 2.0 * KEY_ZERO * resolution
    for i in range(points.shape[0]):
        px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if not (abs(px) < limit and abs(py) < limit and abs(pz) < limit):  # NaN, infinite or off the lattice
            continue
        valid += 1
        if label[i] == 2:
            continue
        x = int(np.floor(factor * px)) + KEY_ZERO - key_min[0]
        y = int(np.floor(factor * py)) + KEY_ZERO - key_min[1]
        z = int(np.floor(factor * pz)) + KEY_ZERO - key_min[2]
        if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
            if label[i] == 0 and (max_range < 0.0 or cell_distance(x, y, z, key_min, resolution, origin) <= max_range):
                marks[x, y, z] |= HIT_BIT
            if ticks[x, y, z] == tick:
                continue
            ticks[x, y, z] = tick
        else:
            slot = _free_slot(x, y, z, table)
            if slot < 0 or outside >= used.size:
                continue
            table[slot] = _key(x, y, z)
            used[outside] = slot
            outside += 1
        ends[m, 0], ends[m, 1], ends[m, 2] = x, y, z
        m += 1
    for i in range(outside):
        table[used[i]] = -1
    return m, valid
