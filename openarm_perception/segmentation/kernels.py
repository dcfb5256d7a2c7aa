# SPDX-License-Identifier: Apache-2.0
"""Loops over the pixels of an organised cloud: breaks in depth, normals, small patches of one surface.

Points are float32 (h, w, 3) in the optical frame, m, NaN where nothing was measured. Noise of a depth is `noise` · z².
"""

# pyright: reportUntypedFunctionDecorator=false, reportMissingTypeStubs=false, reportUnknownVariableType=false

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from openarm_common.kernels import inlined_kernel, kernel
from openarm_common.types import Array, Bytes, Mask
from openarm_perception.geometry.depth import Points

Labels = NDArray[np.int32]
Real = float | np.float32

#: A surface may be slanted so much (tangent) before a step between pixels is a break in depth.
SLANT = 4.0
#: Bend beyond that of the surface around that is an edge, deg.
EDGE = 8.0
#: Of levels by which patches grow.
_LEVELS = 64


@inlined_kernel
def _together(z: float, other: float, distance: float, noise: Real) -> bool:
    """Return whether two depths, so far apart in the image (as a tangent), may be of one surface."""
    near = min(z, other)
    return bool(abs(z - other) <= SLANT * distance * near + 4.0 * noise * near * near)


@kernel
def _smallest_axis(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> tuple[float, float, float]:
    """Return the direction in which a symmetric matrix is smallest: inverse iteration by its adjugate."""
    trace = xx + yy + zz
    # a little of the identity makes the matrix regular; it does not turn the axes
    e = 1e-4 * trace + 1e-15
    a, b, c = xx + e, yy + e, zz + e
    ixx, iyy, izz = b * c - yz * yz, a * c - xz * xz, a * b - xy * xy
    ixy, ixz, iyz = xz * yz - xy * c, xy * yz - xz * b, xy * xz - yz * a
    nx, ny, nz = ixx, ixy, ixz
    if iyy >= ixx and iyy >= izz:
        nx, ny, nz = ixy, iyy, iyz
    elif izz >= ixx:
        nx, ny, nz = ixz, iyz, izz
    for _ in range(4):
        x, y, z = ixx * nx + ixy * ny + ixz * nz, ixy * nx + iyy * ny + iyz * nz, ixz * nx + iyz * ny + izz * nz
        length = math.sqrt(x * x + y * y + z * z)
        if length <= 0.0:
            return 0.0, 0.0, 0.0
        nx, ny, nz = x / length, y / length, z / length
    return nx, ny, nz


@kernel
def _normal_at(points: Points, v: int, u: int, reach: int, noise: Real, out: Points) -> None:
    """Write the normal (3,) of the surface at a pixel, towards the camera, NaN of fewer than six points."""
    h, w, _ = points.shape
    out[:] = np.nan
    z0 = points[v, u, 2]
    if not z0 > 0.0:
        return
    # tangent of the distance of neighbouring pixels, from any of them
    pixel = 0.0
    for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        if 0 <= v + dv < h and 0 <= u + du < w and points[v + dv, u + du, 2] > 0.0:
            z1 = points[v + dv, u + du, 2]
            pixel = max(abs(points[v + dv, u + du, 0] / z1 - points[v, u, 0] / z0), pixel)
            pixel = max(abs(points[v + dv, u + du, 1] / z1 - points[v, u, 1] / z0), pixel)
    n = 0
    sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    for j in range(max(v - reach, 0), min(v + reach + 1, h)):
        for i in range(max(u - reach, 0), min(u + reach + 1, w)):
            z = points[j, i, 2]
            if not z > 0.0 or not _together(z0, z, pixel * max(abs(j - v), abs(i - u)), noise):
                continue
            x, y, d = points[j, i, 0] - points[v, u, 0], points[j, i, 1] - points[v, u, 1], z - z0
            n += 1
            sx += x
            sy += y
            sz += d
            sxx += x * x
            sxy += x * y
            sxz += x * d
            syy += y * y
            syz += y * d
            szz += d * d
    if n < 6:
        return
    mx, my, mz = sx / n, sy / n, sz / n
    nx, ny, nz = _smallest_axis(
        sxx / n - mx * mx, sxy / n - mx * my, sxz / n - mx * mz, syy / n - my * my, syz / n - my * mz, szz / n - mz * mz
    )
    if nx == 0.0 and ny == 0.0 and nz == 0.0:
        return
    if nx * points[v, u, 0] + ny * points[v, u, 1] + nz * z0 > 0.0:
        nx, ny, nz = -nx, -ny, -nz
    out[0], out[1], out[2] = nx, ny, nz


@kernel
def local_normals(points: Points, step: int, reach: int, noise: np.float32) -> Points:
    """Return normals of every `step`-th pixel by a plane through the window around it, without what is beyond a break.

    Args:
        points: (h, w, 3).
        step: Rows and columns from one normal to the next.
        reach: The window is 2 · reach + 1 pixels wide.
        noise: Noise of a depth at 1 m, m.

    Returns:
        (ceil(h / step), ceil(w / step), 3) unit vectors towards the camera; NaN where there are too few points.
    """
    h, w, _ = points.shape
    out = np.empty(((h + step - 1) // step, (w + step - 1) // step, 3), np.float32)
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            _normal_at(points, j * step, i * step, reach, noise, out[j, i])
    return out


@kernel
def masked_normals(points: Points, wanted: Mask, reach: int, noise: np.float32) -> Points:
    """Return normals (h, w, 3) of the pixels that are wanted, as `local_normals`; NaN of the others."""
    h, w, _ = points.shape
    out = np.empty((h, w, 3), np.float32)
    for v in range(h):
        for u in range(w):
            if wanted[v, u]:
                _normal_at(points, v, u, reach, noise, out[v, u])
            else:
                out[v, u] = np.nan
    return out


@kernel
def breaks(points: Points, wanted: Mask, pixel: float, noise: np.float32) -> Bytes:
    """Return where depth breaks: (h, w), 1: to the right neighbour, 2: to the lower one, 3: to both.

    Args:
        points: (h, w, 3).
        wanted: (h, w); to what is not wanted, depth breaks.
        pixel: Tangent of the angle between neighbouring pixels.
        noise: Noise of a depth at 1 m, m.
    """
    h, w, _ = points.shape
    out = np.zeros((h, w), np.uint8)
    for v in range(h):
        for u in range(w):
            z = points[v, u, 2]
            on = wanted[v, u]
            if u + 1 == w or not on or not wanted[v, u + 1] or not _together(z, points[v, u + 1, 2], pixel, noise):
                out[v, u] |= 1
            if v + 1 == h or not on or not wanted[v + 1, u] or not _together(z, points[v + 1, u, 2], pixel, noise):
                out[v, u] |= 2
    return out


@kernel
def edge_strength(normals: Points, wanted: Mask, reach: int) -> Bytes:
    """Return how much the surface bends at pixels (h, w): the angle of normals left and right, above and below, deg."""
    h, w, _ = normals.shape
    out = np.zeros((h, w), np.uint8)
    for v in range(h):
        for u in range(w):
            if not wanted[v, u]:
                continue
            least = 1.0
            for dv, du in ((0, reach), (reach, 0)):
                v0, v1, u0, u1 = max(v - dv, 0), min(v + dv, h - 1), max(u - du, 0), min(u + du, w - 1)
                if wanted[v0, u0] and wanted[v1, u1]:
                    c = 0.0
                    for i in range(3):
                        c += normals[v0, u0, i] * normals[v1, u1, i]
                    if c < least:  # NaN is not
                        least = c
            out[v, u] = min(int(math.degrees(math.acos(max(least, -1.0)))), 90)
    return out


@kernel
def grow_patches(strength: Bytes, broken: Bytes, wanted: Mask, size: int) -> Labels:
    """Divide pixels into patches of about `size` pixels across that end where the surface bends or depth breaks.

    Patches grow from the flattest pixel of each cell of a grid, flat places first (a watershed with markers: Meyer
    1991); what no patch reaches gets patches of its own.

    Args:
        strength: (h, w) how much the surface bends.
        broken: (h, w) as from `breaks`.
        wanted: (h, w).
        size: Size of a cell, pixels.

    Returns:
        (h, w) patch of every pixel that is wanted, from 1 on; 0 of the others.
    """
    h, w = strength.shape
    label = np.zeros((h, w), np.int32)
    # a list of waiting pixels for each level of strength; each pixel may wait once for each of its neighbours
    following = np.full(4 * h * w + 1, -1, np.int32)
    place = np.empty(4 * h * w + 1, np.int32)
    owner = np.empty(4 * h * w + 1, np.int32)
    first = np.full(_LEVELS, -1, np.int32)
    last = np.full(_LEVELS, -1, np.int32)
    waiting = count = 0
    for at in _seeds(strength, wanted, size):
        count += 1
        place[waiting], owner[waiting] = at, count
        waiting = _wait(waiting, 0, following, first, last)
    waiting = _flood(label, strength, broken, wanted, following, place, owner, first, last, waiting)
    for v in range(h):
        for u in range(w):
            if wanted[v, u] and label[v, u] == 0:
                count += 1
                place[waiting], owner[waiting] = v * w + u, count
                waiting = _wait(waiting, 0, following, first, last)
                waiting = _flood(label, strength, broken, wanted, following, place, owner, first, last, waiting)
    return label


@kernel
def _seeds(strength: Bytes, wanted: Mask, size: int) -> Labels:
    """Return the flattest pixel of each cell, as row · width + column; none where the cells around are much flatter.

    There runs an edge, and no patch may lie across it.
    """
    h, w = strength.shape
    rows, columns = (h + size - 1) // size, (w + size - 1) // size
    flattest = np.full((rows, columns), 255, np.int64)
    at = np.full((rows, columns), -1, np.int64)
    for j in range(rows):
        for i in range(columns):
            best = 100_000
            for v in range(j * size, min(j * size + size, h)):
                for u in range(i * size, min(i * size + size, w)):
                    if wanted[v, u]:
                        # of equally flat ones the one nearest to the middle
                        off = abs(v - j * size - size // 2) + abs(u - i * size - size // 2)
                        worth = 2 * size * int(strength[v, u]) + off
                        if worth < best:
                            best, at[j, i], flattest[j, i] = worth, v * w + u, strength[v, u]
    out = np.empty(rows * columns, np.int32)
    around = np.empty(9, np.int64)
    n = 0
    for j in range(rows):
        for i in range(columns):
            if at[j, i] < 0:
                continue
            k = 0
            for y in range(max(j - 1, 0), min(j + 2, rows)):
                for x in range(max(i - 1, 0), min(i + 2, columns)):
                    if at[y, x] >= 0:
                        around[k] = flattest[y, x]
                        k += 1
            if flattest[j, i] <= 1.5 * np.median(around[:k]) + EDGE:
                out[n] = at[j, i]
                n += 1
    return out[:n]


@inlined_kernel
def _wait(entry: int, level: int, following: Labels, first: Labels, last: Labels) -> int:
    following[entry] = -1
    if first[level] < 0:
        first[level] = entry
    else:
        following[last[level]] = entry
    last[level] = entry
    return entry + 1


@kernel
def _flood(
    label: Labels, strength: Bytes, broken: Bytes, wanted: Mask, following: Labels, place: Labels, owner: Labels,
    first: Labels, last: Labels, waiting: int,
) -> int:  # fmt: skip
    """Grow the patches that wait; return how many entries of the lists are in use, none afterwards."""
    w = label.shape[1]
    level = 0
    while level < _LEVELS:
        entry = first[level]
        if entry < 0:
            level += 1
            continue
        first[level] = following[entry]
        v, u = place[entry] // w, place[entry] % w
        if label[v, u] != 0:
            continue
        label[v, u] = owner[entry]
        for side in range(4):
            if side == 0:
                j, i, shut = v, u + 1, broken[v, u] & 1
            elif side == 1:
                j, i, shut = v + 1, u, broken[v, u] & 2
            elif side == 2:
                j, i, shut = v, u - 1, 1 if u == 0 else broken[v, u - 1] & 1
            else:
                j, i, shut = v - 1, u, 2 if v == 0 else broken[v - 1, u] & 2
            if shut == 0 and label[j, i] == 0 and wanted[j, i]:
                to = max(level, min(int(strength[j, i]), _LEVELS - 1))
                place[waiting], owner[waiting] = j * w + i, owner[entry]
                waiting = _wait(waiting, to, following, first, last)
        level = 0 if level == 0 else level
    return 0


@kernel
def patch_moments(points: Points, label: Labels, count: int) -> Array:
    """Return sums (count, 10) over the points of each patch: 1, x, y, z, xx, xy, xz, yy, yz, zz; patch 0 is none."""
    out = np.zeros((count, 10))
    h, w = label.shape
    for v in range(h):
        for u in range(w):
            k = label[v, u]
            if k == 0:
                continue
            x, y, z = float(points[v, u, 0]), float(points[v, u, 1]), float(points[v, u, 2])
            out[k, 0] += 1.0
            out[k, 1] += x
            out[k, 2] += y
            out[k, 3] += z
            out[k, 4] += x * x
            out[k, 5] += x * y
            out[k, 6] += x * z
            out[k, 7] += y * y
            out[k, 8] += y * z
            out[k, 9] += z * z
    return out


@kernel
def borders(label: Labels, broken: Bytes, points: Points) -> Labels:
    """Return (n, 3) a row per pair of neighbours with other labels: both, smaller first; break in depth, mm, or 0."""
    h, w = label.shape
    out = np.empty((2 * h * w, 3), np.int32)
    n = 0
    for v in range(h):
        for u in range(w):
            a = label[v, u]
            if a == 0:
                continue
            for side in range(2):
                j, i = (v, u + 1) if side == 0 else (v + 1, u)
                if j >= h or i >= w:
                    continue
                b = label[j, i]
                if b == 0 or b == a:
                    continue
                out[n, 0], out[n, 1] = min(a, b), max(a, b)
                if broken[v, u] & (1 << side):
                    out[n, 2] = max(1, int(1000.0 * abs(points[v, u, 2] - points[j, i, 2])))
                else:
                    out[n, 2] = 0
                n += 1
    return out[:n].copy()
