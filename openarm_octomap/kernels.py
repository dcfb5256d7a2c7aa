# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the map: the cells that rays end in, and the exact walk along each ray.

They do what liboctomap does for a cloud whose points are first made unique by cell, with
the same types in the same order, so that the cells come out identical. Coordinates are in the frame of the map, m;
keys are those of `octree.lattice`. What a scan marks are sets of cells, a bit each, in the order of
`octree.block_kernels`. The GIL is released.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.depth_view import DepthImage
from openarm_common.kernels import inlined_kernel, kernel
from openarm_common.octree.block_kernels import FREE as FREE
from openarm_common.octree.block_kernels import OCCUPIED as OCCUPIED
from openarm_common.octree.block_kernels import UNKNOWN as UNKNOWN
from openarm_common.octree.block_kernels import Words
from openarm_common.octree.lattice import KEY_ZERO
from openarm_common.robot.filter_kernels import Whole
from openarm_common.types import Bytes, Floats, Ints

Axes = tuple[Ints, ...]


@inlined_kernel
def _key(x: Whole, y: Whole, z: Whole) -> np.int64:
    return (np.int64(x) + 1048576) << 42 | (np.int64(y) + 1048576) << 21 | (np.int64(z) + 1048576)


@kernel
def _free_slot(x: Whole, y: Whole, z: Whole, table: Ints) -> Whole:
    """Where a cell belongs in a hash table of keys that are -1 where there is none; -1 when it is there already."""
    mask, key = table.size - 1, _key(x, y, z)
    slot = np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40)) & mask
    while table[slot] != -1:
        if table[slot] == key:
            return -1
        slot = (slot + 1) & mask
    return slot


@kernel
def image_ends(
    depth: DepthImage, scale: np.float32, near: np.float32, far: np.float32,
    block: int, stride: int, reach: np.float32,
    ray_x: Floats, ray_y: Floats, T: Floats, label: Bytes,
    resolution: float, key_min: Ints, origin: Floats, max_range: float,
    axes: Axes, hits: Words, ended: Words, table: Ints, ends: NDArray[np.int32],
) -> tuple[int, int, int]:  # fmt: skip
    """Return cells where the rays of a depth image end, each once; those of surfaces are marked.

    Args:
        depth: (h, w) planar depth in counts of `scale` metres.
        scale: Metres of a count.
        near: Nearest valid depth, m.
        far: Farthest valid depth, m.
        block: Edge in pixels of the blocks whose pixels must all lack a return for a ray to clear; 0: none clears.
        stride: Every so many columns and rows of such a block have a ray.
        reach: Range that such a ray clears, m.
        ray_x: (w,) x over z of each column.
        ray_y: (h,) y over z of each row.
        T: (3, 4) float32, camera in the frame of the map.
        label: (h, w): 0 environment; 1 robot: the ray clears up to it and marks nothing; 2 nothing is known.
        resolution: Edge of a cell, m.
        key_min: (3,) key of the first cell of the box.
        origin: (3,) the camera.
        max_range: Surfaces further away than this mark nothing, m; negative: none does.
        axes: Axes of the box, as in `VoxelBlocks`.
        hits: Cells that a ray ended in, of all scans of an update; changed.
        ended: Cells of the box that are among `ends`; empty before.
        table: Hash table of the keys outside of the box: a power of two long, all -1 before and after.
        ends: (h * w, 3), filled with keys.

    Returns:
        How many ends there are, how many pixels had a valid depth, how many rays without return clear.
    """
    h, w = depth.shape
    at_x, at_y, at_z = axes
    nx, ny, nz = at_x.size, at_y.size, at_z.size
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
                at = at_x[x] + at_y[y] + at_z[q]
                word, bit = np.uint64(at) >> np.uint64(6), np.uint64(1) << np.uint64(at & 63)
                if hit and not hits[word] & bit:
                    near_enough = True
                    if max_range >= 0.0:
                        near_enough = cell_distance(x, y, q, key_min, resolution, origin) <= max_range
                    if near_enough:
                        hits[word] |= bit
                if ended[word] & bit:
                    continue
                ended[word] |= bit
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


@kernel
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


@kernel
def cloud_ends(
    points: Floats, label: Bytes,
    resolution: float, key_min: Ints, origin: Floats, max_range: float,
    axes: Axes, hits: Words, ended: Words, table: Ints, ends: NDArray[np.int32],
) -> tuple[int, int]:  # fmt: skip
    """Do as `image_ends` for points (n, 3) float32 in the frame of the map; `label` is (n,), the rest the same.

    Returns:
        How many ends there are, and how many points were finite.
    """
    at_x, at_y, at_z = axes
    nx, ny, nz = at_x.size, at_y.size, at_z.size
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
            at = at_x[x] + at_y[y] + at_z[z]
            word, bit = np.uint64(at) >> np.uint64(6), np.uint64(1) << np.uint64(at & 63)
            if label[i] == 0 and (max_range < 0.0 or cell_distance(x, y, z, key_min, resolution, origin) <= max_range):
                hits[word] |= bit
            if ended[word] & bit:
                continue
            ended[word] |= bit
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


_HUGE = 1.7976931348623157e308


@inlined_kernel
def _centre(index: Whole, first: Whole, resolution: float) -> np.float32:
    return np.float32((np.float64(index + first - KEY_ZERO) + 0.5) * resolution)


@inlined_kernel
def _norm(x: np.float32, y: np.float32, z: np.float32) -> np.float64:
    return np.sqrt(np.float64(x * x + y * y + z * z))


@kernel
def cell_distance(x: Whole, y: Whole, z: Whole, key_min: Ints, resolution: float, origin: Floats) -> np.float64:
    """Return the distance of the centre of a cell (index) from a point (3,), m; as liboctomap computes it.

    Args:
        x: Index of the cell.
        y: Index of the cell.
        z: Index of the cell.
        key_min: (3,) key of the cell 0, 0, 0.
        resolution: Edge of a cell, m.
        origin: (3,), m.
    """
    return _norm(
        _centre(x, key_min[0], resolution) - origin[0],
        _centre(y, key_min[1], resolution) - origin[1],
        _centre(z, key_min[2], resolution) - origin[2],
    )


@inlined_kernel
def _first_step(
    index: Whole, first: Whole, origin: np.float32, direction: np.float32, resolution: float
) -> tuple[int, float, float]:
    """Return the step of a ray along an axis, where on the ray the first border is, and how far apart borders are."""
    step = 1 if direction > 0 else (-1 if direction < 0 else 0)
    if step == 0:
        return step, _HUGE, _HUGE
    border = (np.float64(index + first - KEY_ZERO) + 0.5) * resolution
    border += np.float64(np.float32(step * resolution * 0.5))
    return step, (border - np.float64(origin)) / np.float64(direction), resolution / abs(np.float64(direction))


@kernel
def walk_rays(
    ends: NDArray[np.int32], count: int, resolution: float, key_min: Ints, origin: Floats, max_range: float,
    axes: Axes, through: Words,
) -> int:  # fmt: skip
    """Mark the cells that rays pass through, from the origin to before the centre of each end cell.

    The origin and the ends may lie outside of the box. The arithmetic is that of liboctomap: positions in float32,
    parameters along the ray in float64, summed step by step, and a ray stops where its parameter passes its length.

    Args:
        ends: (n, 3) cell indices relative to the box.
        count: Number of them that count.
        resolution: Edge of a cell, m.
        key_min: (3,) key of the first cell of the box.
        origin: (3,) where the rays begin, m.
        max_range: Rays end here at the latest, m; negative: no limit.
        axes: Axes of the box, as in `VoxelBlocks`.
        through: Cells that a ray went through; changed.

    Returns:
        How many steps were made.
    """
    at_x, at_y, at_z = axes
    nx, ny, nz = at_x.size, at_y.size, at_z.size
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
        sx, tx, ax = _first_step(gx, key_min[0], o0, d0, resolution)
        sy, ty, ay = _first_step(gy, key_min[1], o1, d1, resolution)
        sz, tz, az = _first_step(gz, key_min[2], o2, d2, resolution)
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
        out_x = nx if sx > 0 else -1
        out_y = ny if sy > 0 else -1
        out_z = nz if sz > 0 else -1
        x, y, z = at_x[gx], at_y[gy], at_z[gz]
        at = np.uint64(x + y + z)
        through[at >> np.uint64(6)] |= np.uint64(1) << (at & np.uint64(63))
        while True:
            if tx < ty:
                if tx < tz:
                    gx += sx
                    tx += ax
                    if gx == out_x:
                        break
                    x = at_x[np.uint64(gx)]
                else:
                    gz += sz
                    tz += az
                    if gz == out_z:
                        break
                    z = at_z[np.uint64(gz)]
            elif ty < tz:
                gy += sy
                ty += ay
                if gy == out_y:
                    break
                y = at_y[np.uint64(gy)]
            else:
                gz += sz
                tz += az
                if gz == out_z:
                    break
                z = at_z[np.uint64(gz)]
            left -= 1
            steps += 1
            if (left == 0 and gx == qx and gy == qy and gz == qz) or min(min(tx, ty), tz) > length:
                break
            at = np.uint64(x + y + z)
            through[at >> np.uint64(6)] |= np.uint64(1) << (at & np.uint64(63))
    return steps
