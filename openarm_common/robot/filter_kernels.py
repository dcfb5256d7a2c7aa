# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the self-filter: which pixels and points belong to a set of simple shapes.

A shape is a box, cylinder (axis z) or sphere: `kinds` (n,) 0, 1, 2; `halves` (n, 3) half edges, where a cylinder has
its radius twice and half its length, a sphere its radius three times; all with padding. Poses are given as
``T_shape_frame`` (n, 3, 4): they bring points of the frame in question to the shape. Metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from openarm_common.camera.depth_view import DepthImage
from openarm_common.kernels import inlined_kernel, kernel
from openarm_common.types import Array, Bytes, Floats, Ints

Real = float | np.floating[Any]
Whole = int | np.integer[Any]

BOX, CYLINDER, SPHERE = 0, 1, 2
#: What is nearer to the camera's plane than this is not projected, m.
_PLANE = 0.02


@inlined_kernel
def inside(kind: Whole, x: Real, y: Real, z: Real, hx: Real, hy: Real, hz: Real) -> bool | np.bool_:
    """Whether a point lies in a shape of half edges (hx, hy, hz), both in the frame of the shape."""
    if kind == 0:
        return abs(x) <= hx and abs(y) <= hy and abs(z) <= hz
    if kind == 1:
        return abs(z) <= hz and x * x + y * y <= hx * hx
    return x * x + y * y + z * z <= hx * hx


@kernel
def _window(
    T: Array, half: Array, fx: float, fy: float, cx: float, cy: float, width: int, height: int
) -> tuple[int, int, int, int]:
    """Return first and end of the columns and rows in which the box around a shape can appear; empty when behind."""
    corners = np.empty((8, 3))
    for i in range(8):
        # the inverse of a rigid transform: R^T (p - t)
        x = (half[0] if i & 1 else -half[0]) - T[0, 3]
        y = (half[1] if i & 2 else -half[1]) - T[1, 3]
        z = (half[2] if i & 4 else -half[2]) - T[2, 3]
        for k in range(3):
            corners[i, k] = T[0, k] * x + T[1, k] * y + T[2, k] * z
    u0, u1, v0, v1 = 1e9, -1e9, 1e9, -1e9
    for i in range(8):
        for k in range(3):
            j = i | 1 << k
            if j == i:
                continue
            za, zb = corners[i, 2], corners[j, 2]
            if za < _PLANE and zb < _PLANE:
                continue
            for end in range(2):
                p = i if end == 0 else j
                other = j if end == 0 else i
                x, y, z = corners[p, 0], corners[p, 1], corners[p, 2]
                if z < _PLANE:
                    s = (_PLANE - z) / (corners[other, 2] - z)
                    x += s * (corners[other, 0] - x)
                    y += s * (corners[other, 1] - y)
                    z = _PLANE
                u, v = x / z * fx + cx, y / z * fy + cy
                u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
    if u1 < u0:
        return 0, 0, 0, 0
    u0, u1 = min(max(u0, 0.0), 1.0 * width), min(max(u1, -1.0), width - 1.0)
    v0, v1 = min(max(v0, 0.0), 1.0 * height), min(max(v1, -1.0), height - 1.0)
    return int(u0), int(u1) + 1, int(v0), int(v1) + 1


@kernel
def label_image(
    depth: DepthImage, scale: np.float32, near: np.float32, far: np.float32,
    ray_x: Floats, ray_y: Floats, fx: float, fy: float, cx: float, cy: float,
    kinds: Ints, halves: Array, T_shape_camera: Array, owners: Ints, label: Bytes, counts: Ints,
) -> None:  # fmt: skip
    """Label the pixels that show a shape (1), and those without a return whose ray meets one (2).

    Args:
        depth: (h, w) planar depth in counts of `scale` metres.
        scale: Metres of a count.
        near: Nearest valid depth, m.
        far: Farthest valid depth, m.
        ray_x: (w,) x over z of each column.
        ray_y: (h,) y over z of each row.
        fx: Pixels, as are `fy`, `cx`, `cy`.
        fy: Pixels.
        cx: Pixels.
        cy: Pixels.
        kinds: (n,).
        halves: (n, 3).
        T_shape_camera: (n, 3, 4).
        owners: (n,) index in `counts`.
        label: (h, w), changed where a shape is.
        counts: Pixels with a return that were labelled, by owner; added to.
    """
    height, width = depth.shape
    for i in range(kinds.size):
        T, half = T_shape_camera[i], halves[i]
        u0, u1, v0, v1 = _window(T, half, fx, fy, cx, cy, width, height)
        kind = kinds[i]
        hx, hy, hz = np.float32(half[0]), np.float32(half[1]), np.float32(half[2])
        m00, m01, m02, t0 = np.float32(T[0, 0]), np.float32(T[0, 1]), np.float32(T[0, 2]), np.float32(T[0, 3])
        m10, m11, m12, t1 = np.float32(T[1, 0]), np.float32(T[1, 1]), np.float32(T[1, 2]), np.float32(T[1, 3])
        m20, m21, m22, t2 = np.float32(T[2, 0]), np.float32(T[2, 1]), np.float32(T[2, 2]), np.float32(T[2, 3])
        n = 0
        for v in range(v0, v1):
            b = ray_y[v]
            p0, p1, p2 = m01 * b + m02, m11 * b + m12, m21 * b + m22
            for u in range(u0, u1):
                if label[v, u] == 1:
                    continue
                a = ray_x[u]
                dx, dy, dz = m00 * a + p0, m10 * a + p1, m20 * a + p2
                z = np.float32(depth[v, u]) * scale
                if near <= z <= far:
                    if inside(kind, dx * z + t0, dy * z + t1, dz * z + t2, hx, hy, hz):
                        label[v, u] = 1
                        n += 1
                elif label[v, u] == 0 and _meets(dx, dy, dz, t0, t1, t2, hx, hy, hz):
                    label[v, u] = 2
        counts[owners[i]] += n


@kernel
def _meets(dx: Real, dy: Real, dz: Real, x: Real, y: Real, z: Real, hx: Real, hy: Real, hz: Real) -> bool | np.bool_:
    """Whether the half-line from (x, y, z) along (dx, dy, dz) meets the box of half edges (hx, hy, hz)."""
    low, high = 0.0, 1e9
    for axis in range(3):
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        p = x if axis == 0 else (y if axis == 1 else z)
        h = hx if axis == 0 else (hy if axis == 1 else hz)
        if abs(d) < 1e-9:
            if abs(p) > h:
                return False
            continue
        s, e = (-h - p) / d, (h - p) / d
        low, high = max(low, min(s, e)), min(high, max(s, e))
    return low <= high


@kernel
def label_points(
    points: Floats, kinds: Ints, halves: Array, T_shape_base: Array, owners: Ints, label: Bytes, counts: Ints
) -> None:
    """Label points (n, 3) of the base frame that lie in a shape (1); counts by owner are added to.

    Args:
        points: (n, 3), m.
        kinds: (m,).
        halves: (m, 3) half edges with padding, m.
        T_shape_base: (m, 3, 4).
        owners: (m,) index in `counts`.
        label: (n,), 1 is written where a point lies in a shape.
        counts: Labelled points by owner; added to.
    """
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        for k in range(kinds.size):
            T = T_shape_base[k]
            px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if inside(kinds[k], px, py, pz, halves[k, 0], halves[k, 1], halves[k, 2]):
                label[i] = 1
                counts[owners[k]] += 1
                break
