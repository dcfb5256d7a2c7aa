# SPDX-License-Identifier: Apache-2.0
"""Pixels of the marks of a board, exact, with derivatives; compiled.

The centre of the image of a circle is not the image of its centre. With `o` the circle's centre and `n` the board's
normal in the optical frame (m), `r` its radius, the image ellipse has in normalised coordinates the dual conic
`r² (I - n nᵀ) - o oᵀ`, whose centre is the quotient used below; `r = 0` is a plain point. Derivatives are taken by a
camera-frame twist (translation, rotation) of the board, then by the scale of the board, then by fx, fy, cx, cy, and,
where the camera has distortion, by k1, k2 of the radial polynomial `1 + k1 ρ² + k2 ρ⁴` (as in OpenCV).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from openarm_common.kernels import kernel
from openarm_common.types import Array

Indices = NDArray[np.int64]

#: Columns of the derivatives before those of the intrinsics: twist (6), scale (1).
BEFORE_OPTICS = 7
#: Nearer than this in front of the camera a mark has no image, m.
_NEAR = 1e-3


@kernel
def _mark(
    p: Array, radius: float, T: Array, intrinsics: Array, scale: float, rows: Array, pixel: Array
) -> bool:  # pragma: no cover - compiled
    """Return the pixel (2,) and derivative rows (2, columns) of one mark; False behind the camera."""
    o = np.empty(3)
    arm = np.empty(3)
    for k in range(3):
        arm[k] = T[k, 0] * p[0] + T[k, 1] * p[1] + T[k, 2] * p[2]
        o[k] = scale * arm[k] + T[k, 3]
    if not o[2] > _NEAR:
        return False
    nx, ny, nz = T[0, 2], T[1, 2], T[2, 2]
    rr = radius * radius * scale * scale
    den = o[2] * o[2] - rr * (1.0 - nz * nz)
    if not den > 0.0:
        return False
    n = np.empty(3)
    n[0], n[1], n[2] = nx, ny, nz
    g = np.empty(3)
    h = np.empty(3)
    x = np.empty(2)
    for axis in range(2):
        other = 1 - axis
        value = (o[axis] * o[2] + rr * n[axis] * nz) / den
        g[axis] = o[2] / den
        g[other] = 0.0
        g[2] = (o[axis] - 2.0 * value * o[2]) / den
        h[axis] = rr * nz / den
        h[other] = 0.0
        h[2] = rr * (n[axis] - 2.0 * value * nz) / den
        by_rr = (n[axis] * nz + value * (1.0 - nz * nz)) / den
        x[axis] = value
        rows[axis, 0], rows[axis, 1], rows[axis, 2] = g[0], g[1], g[2]
        rows[axis, 3] = o[1] * g[2] - o[2] * g[1] + n[1] * h[2] - n[2] * h[1]
        rows[axis, 4] = o[2] * g[0] - o[0] * g[2] + n[2] * h[0] - n[0] * h[2]
        rows[axis, 5] = o[0] * g[1] - o[1] * g[0] + n[0] * h[1] - n[1] * h[0]
        rows[axis, 6] = g[0] * arm[0] + g[1] * arm[1] + g[2] * arm[2] + by_rr * 2.0 * radius * radius * scale
    square = x[0] * x[0] + x[1] * x[1]
    factor, slope = 1.0, 0.0
    distorted = len(intrinsics) > 4
    if distorted:
        factor = 1.0 + square * (intrinsics[4] + square * intrinsics[5])
        slope = 2.0 * intrinsics[4] + 4.0 * intrinsics[5] * square
    for column in range(BEFORE_OPTICS):
        by_x, by_y = rows[0, column], rows[1, column]
        along = slope * (x[0] * by_x + x[1] * by_y)
        rows[0, column] = intrinsics[0] * (factor * by_x + along * x[0])
        rows[1, column] = intrinsics[1] * (factor * by_y + along * x[1])
    for axis in range(2):
        other = 1 - axis
        f = intrinsics[axis]
        pixel[axis] = f * factor * x[axis] + intrinsics[2 + axis]
        rows[axis, 7 + axis] = factor * x[axis]
        rows[axis, 7 + other] = 0.0
        rows[axis, 9 + axis] = 1.0
        rows[axis, 9 + other] = 0.0
        if distorted:
            rows[axis, 11] = f * x[axis] * square
            rows[axis, 12] = f * x[axis] * square * square
    return True


@kernel
def normal_equations(
    points: Array,
    pixels: Array,
    offsets: Indices,
    radii: Array,
    poses: Array,
    intrinsics: Array,
    scale: float,
) -> tuple[Array, Array, Array]:  # pragma: no cover - compiled
    """Return the normal equations of each view, in px².

    Args:
        points: (marks, 3) of all views, board frame, m.
        pixels: (marks, 2) measured.
        offsets: (views + 1,) first mark of each view.
        radii: (views,) radius of the circles, m; 0 for points.
        poses: (views, 4, 4) T_camera_board.
        intrinsics: (views, 4) fx, fy, cx, cy, or (views, 6) with k1, k2.
        scale: Scale of the board.

    Returns:
        (views, c, c) JᵀJ, (views, c) Jᵀr and (views,) rᵀr, with c = 11 columns, 13 with distortion; the last is
        infinite with a mark behind the camera.
    """
    count = len(offsets) - 1
    columns = BEFORE_OPTICS + intrinsics.shape[1]
    squares = np.zeros((count, columns, columns))
    slopes = np.zeros((count, columns))
    costs = np.zeros(count)
    rows = np.zeros((2, columns))
    pixel = np.zeros(2)
    for view in range(count):
        for mark in range(offsets[view], offsets[view + 1]):
            if not _mark(points[mark], radii[view], poses[view], intrinsics[view], scale, rows, pixel):
                costs[view] = np.inf
                break
            for axis in range(2):
                residual = pixels[mark, axis] - pixel[axis]
                costs[view] += residual * residual
                for i in range(columns):
                    slopes[view, i] += rows[axis, i] * residual
                    for j in range(i + 1):
                        squares[view, i, j] += rows[axis, i] * rows[axis, j]
        for i in range(columns):
            for j in range(i):
                squares[view, j, i] = squares[view, i, j]
    return squares, slopes, costs


@kernel
def project(
    points: Array, radius: float, pose: Array, intrinsics: Array, scale: float = 1.0
) -> Array:  # pragma: no cover - compiled
    """Return pixels (n, 2) of marks (n, 3); NaN behind the camera.

    Args:
        points: (n, 3) marks in the board frame, m.
        radius: Radius of the circles, m; 0 for points.
        pose: (4, 4).
        intrinsics: (4,) fx, fy, cx, cy, or (6,) with k1, k2.
        scale: Scale of the board.
    """
    out = np.full((len(points), 2), np.nan)
    rows = np.zeros((2, BEFORE_OPTICS + len(intrinsics)))
    pixel = np.zeros(2)
    for mark in range(len(points)):
        if _mark(points[mark], radius, pose, intrinsics, scale, rows, pixel):
            out[mark] = pixel
    return out


@kernel
def turned(R: Array, w: Array) -> Array:  # pragma: no cover - compiled
    """Return `exp(w) R` for a rotation vector w (3,)."""
    angle = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    K = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    if angle < 1e-9:
        E = np.eye(3) + K
    else:
        E = np.eye(3) + np.sin(angle) / angle * K + (1.0 - np.cos(angle)) / (angle * angle) * (K @ K)
    return E @ R


@kernel
def fit_poses(
    points: Array,
    pixels: Array,
    offsets: Indices,
    radii: Array,
    poses: Array,
    intrinsics: Array,
    iterations: int = 12,
) -> tuple[Array, Array]:  # pragma: no cover - compiled
    """Return the least-squares pose of the board in each view by itself.

    Args:
        points: (marks, 3).
        pixels: (marks, 2).
        offsets: (views + 1,).
        radii: (views,).
        poses: (views, 4, 4) to start from; kept where no step makes the residual smaller.
        intrinsics: (views, 4) or (views, 6).
        iterations: Most iterations.

    Returns:
        (views, 4, 4) T_camera_board and (views,) sums of squared residuals, px².
    """
    out = poses.copy()
    _, _, first = normal_equations(points, pixels, offsets, radii, out, intrinsics, 1.0)
    final = first.copy()
    for view in range(len(offsets) - 1):
        marks = slice(offsets[view], offsets[view + 1])
        own_points, own_pixels = points[marks], pixels[marks]
        own_offsets = np.array([0, offsets[view + 1] - offsets[view]])
        own_radii, own_intrinsics = radii[view : view + 1], intrinsics[view : view + 1]
        pose = out[view : view + 1].copy()
        damping = 1e-9
        for _ in range(iterations):
            A, b, cost = normal_equations(own_points, own_pixels, own_offsets, own_radii, pose, own_intrinsics, 1.0)
            H = A[0, :6, :6].copy()
            for k in range(6):
                H[k, k] *= 1.0 + damping
            step = np.linalg.solve(H, b[0, :6].copy())
            trial = pose.copy()
            trial[0, :3, :3] = turned(np.ascontiguousarray(pose[0, :3, :3]), step[3:])  # pyright: ignore[reportArgumentType]
            w = step[3:]
            t = pose[0, :3, 3]
            trial[0, 0, 3] = t[0] + step[0] + w[1] * t[2] - w[2] * t[1]
            trial[0, 1, 3] = t[1] + step[1] + w[2] * t[0] - w[0] * t[2]
            trial[0, 2, 3] = t[2] + step[2] + w[0] * t[1] - w[1] * t[0]
            _, _, reached = normal_equations(own_points, own_pixels, own_offsets, own_radii, trial, own_intrinsics, 1.0)
            if reached[0] <= cost[0]:
                pose = trial
                final[view] = reached[0]
                damping = max(damping * 0.1, 1e-12)
                if cost[0] - reached[0] <= 1e-12 * cost[0]:
                    break
            else:
                damping = max(damping, 1e-6) * 30.0
                if damping > 1e6:
                    break
        out[view] = pose[0]
    return out, final
