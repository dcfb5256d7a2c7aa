# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the fused surface: what fills each voxel, what lies in shadow, what a ray has passed.

Coordinates are in voxels: voxel (i, j, k) reaches from (i, j, k) to (i + 1, j + 1, k + 1); the table is z = 0.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from openarm_common.kernels import kernel
from openarm_common.types import Array, Bytes, Floats, Ints

#: What a voxel holds: nothing; the target as it was seen; what is below a seen point of it; the same of everything
#: else; the shadow of the target; the shadow of everything else.
FREE, SEEN, FILLED, OTHER, SHADOW, HIDDEN = 0, 1, 2, 3, 4, 5
#: Points of a column this near to its highest one make its height, voxels.
_TOP = 3.0
#: Rays prove nothing this near to the point that they end in, voxels.
_NEAR_END = 3.0
#: So many rays must have passed a voxel.
_PASSED = 2

Counts = NDArray[np.uint16]


@kernel
def count(points: Array, counts: Counts) -> None:
    """Count the points (n, 3) in each voxel (nx, ny, nz)."""
    nx, ny, nz = counts.shape
    for n in range(points.shape[0]):
        i, j, k = math.floor(points[n, 0]), math.floor(points[n, 1]), math.floor(points[n, 2])
        if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
            counts[i, j, k] += 1


@kernel
def heights(points: Array, nx: int, ny: int) -> Floats:
    """Return the height (nx, ny) of what stands in each column, NaN where nothing does.

    It is the mean of the highest points, smoothed by a median over neighbours; gaps that are surrounded are closed, and
    columns without neighbours are left out.
    """
    top = np.full((nx, ny), -1.0, np.float32)
    for n in range(points.shape[0]):
        i, j = math.floor(points[n, 0]), math.floor(points[n, 1])
        if 0 <= i < nx and 0 <= j < ny and points[n, 2] > top[i, j]:
            top[i, j] = points[n, 2]
    total, many = np.zeros((nx, ny), np.float32), np.zeros((nx, ny), np.int32)
    for n in range(points.shape[0]):
        i, j = math.floor(points[n, 0]), math.floor(points[n, 1])
        if 0 <= i < nx and 0 <= j < ny and points[n, 2] > top[i, j] - _TOP:
            total[i, j] += points[n, 2]
            many[i, j] += 1
    raw = np.full((nx, ny), np.nan, np.float32)
    for i in range(nx):
        for j in range(ny):
            if many[i, j]:
                raw[i, j] = total[i, j] / many[i, j]
    for _ in range(2):
        raw = _close(raw)
    return _smooth(raw)


@kernel
def _close(raw: Floats) -> Floats:
    """Fill columns of which at least five of eight neighbours are known."""
    nx, ny = raw.shape
    out = raw.copy()
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            if not np.isnan(raw[i, j]):
                continue
            total, many = 0.0, 0
            for a in range(i - 1, i + 2):
                for b in range(j - 1, j + 2):
                    if not np.isnan(raw[a, b]):
                        total += raw[a, b]
                        many += 1
            if many >= 5:
                out[i, j] = total / many
    return out


@kernel
def _smooth(raw: Floats) -> Floats:
    """Median over the known columns of 3 × 3; those with fewer than two neighbours become NaN."""
    nx, ny = raw.shape
    out = np.full((nx, ny), np.nan, np.float32)
    near = np.empty(9, np.float32)
    for i in range(nx):
        for j in range(ny):
            if np.isnan(raw[i, j]):
                continue
            many = 0
            for a in range(max(i - 1, 0), min(i + 2, nx)):
                for b in range(max(j - 1, 0), min(j + 2, ny)):
                    if not np.isnan(raw[a, b]):
                        near[many] = raw[a, b]
                        many += 1
            if many >= 3:
                out[i, j] = np.median(near[:many])
    return out


@kernel
def fill(target: Floats, others: Floats, counts: Counts, around: Counts, cells: Bytes) -> None:
    """Fill each column from what was seen downwards, to the table or to the next thing that was seen.

    Args:
        target: (nx, ny) heights of the target, NaN where it is not.
        others: (nx, ny) heights of everything else.
        counts: (nx, ny, nz) points of the target.
        around: (nx, ny, nz) points of everything else.
        cells: (nx, ny, nz), filled.
    """
    nx, ny, nz = cells.shape
    for i in range(nx):
        for j in range(ny):
            at = -1 if np.isnan(target[i, j]) else min(math.floor(target[i, j]), nz - 1)
            over = -1 if np.isnan(others[i, j]) else min(math.floor(others[i, j]), nz - 1)
            mine = False
            for k in range(max(at, over), -1, -1):
                if k <= at and (k == at or counts[i, j, k]):
                    mine = True
                    cells[i, j, k] = SEEN
                elif k == over or (k < over and around[i, j, k]):
                    mine = False
                    cells[i, j, k] = OTHER
                else:
                    cells[i, j, k] = FILLED if mine else OTHER


@kernel
def shade(points: Array, eye: Array, label: int, cells: Bytes) -> None:
    """Mark what is free and lies behind points (n, 3), seen from a camera at `eye` (3,), with a label."""
    nx, ny, nz = cells.shape
    for n in range(points.shape[0]):
        dx, dy, dz = points[n, 0] - eye[0], points[n, 1] - eye[1], points[n, 2] - eye[2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length < 1e-6:
            continue
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        dx, dy, dz = 0.7 * dx / length, 0.7 * dy / length, 0.7 * dz / length
        for _ in range(2 * (nx + ny + nz)):
            x, y, z = x + dx, y + dy, z + dz
            i, j, k = math.floor(x), math.floor(y), math.floor(z)
            if i < 0 or j < 0 or k < 0 or i >= nx or j >= ny or k >= nz:
                break
            if cells[i, j, k] == FREE:
                cells[i, j, k] = label


@kernel
def passed(points: Array, eye: Array, out: Bytes) -> None:
    """Count the rays from a camera at `eye` (3,) to points (n, 3) that pass each voxel, to at most `_PASSED`."""
    nx, ny, nz = out.shape
    for n in range(points.shape[0]):
        dx, dy, dz = eye[0] - points[n, 0], eye[1] - points[n, 1], eye[2] - points[n, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length < _NEAR_END:
            continue
        dx, dy, dz = dx / length, dy / length, dz / length
        x, y, z = points[n, 0] + _NEAR_END * dx, points[n, 1] + _NEAR_END * dy, points[n, 2] + _NEAR_END * dz
        entered = False
        li = lj = lk = -1
        for _ in range(int(length)):
            i, j, k = math.floor(x), math.floor(y), math.floor(z)
            if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                entered = True
                if (i != li or j != lj or k != lk) and out[i, j, k] < _PASSED:
                    out[i, j, k] += 1
                li, lj, lk = i, j, k
            elif entered or k >= nz:
                break
            x, y, z = x + dx, y + dy, z + dz


@kernel
def carve(rays: Bytes, around: Counts, cells: Bytes) -> None:
    """Free what rays have passed: guesses below what was seen, and shadows that another view looks into."""
    nx, ny, nz = cells.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                what = cells[i, j, k]
                guess = what in (FILLED, SHADOW, HIDDEN) or (what == OTHER and not around[i, j, k])
                if guess and rays[i, j, k] >= _PASSED:
                    cells[i, j, k] = FREE


@kernel
def grow(cells: Bytes, out: Bytes) -> None:
    """Mark obstacles of the hand in `out`: 1 within a voxel of target or others, 3 hidden by others, 2 the shadow.

    Args:
        cells: (nx, ny, nz).
        out: (nx, ny, nz), zero, filled.
    """
    nx, ny, nz = cells.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                what = cells[i, j, k]
                if what == FREE:
                    continue
                if what in (SHADOW, HIDDEN):
                    if out[i, j, k] != 1:
                        out[i, j, k] = 2 if what == SHADOW else 3
                    continue
                if (
                    0 < i < nx - 1 and 0 < j < ny - 1 and 0 < k < nz - 1
                    and 0 < cells[i - 1, j, k] < SHADOW and 0 < cells[i + 1, j, k] < SHADOW
                    and 0 < cells[i, j - 1, k] < SHADOW and 0 < cells[i, j + 1, k] < SHADOW
                    and 0 < cells[i, j, k - 1] < SHADOW and 0 < cells[i, j, k + 1] < SHADOW
                ):  # fmt: skip
                    out[i, j, k] = 1  # inside: its neighbours mark what is around
                    continue
                for a in range(max(i - 1, 0), min(i + 2, nx)):
                    for b in range(max(j - 1, 0), min(j + 2, ny)):
                        for c in range(max(k - 1, 0), min(k + 2, nz)):
                            out[a, b, c] = 1


@kernel
def boundary(cells: Bytes) -> Ints:
    """Return the indices (n, 3) of voxels of the target that have a neighbour which is not, the table left out."""
    nx, ny, nz = cells.shape
    found = np.empty((nx * ny * nz, 3), np.int64)
    n = 0
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(nz - 1):
                if not _is_target(cells[i, j, k]):
                    continue
                inside = (
                    _is_target(cells[i - 1, j, k]) and _is_target(cells[i + 1, j, k])
                    and _is_target(cells[i, j - 1, k]) and _is_target(cells[i, j + 1, k])
                    and _is_target(cells[i, j, k + 1]) and (k == 0 or _is_target(cells[i, j, k - 1]))
                )  # fmt: skip
                if not inside:
                    found[n] = i, j, k
                    n += 1
    return found[:n].copy()


@kernel
def _is_target(cell: int) -> bool:
    return cell in (SEEN, FILLED)
