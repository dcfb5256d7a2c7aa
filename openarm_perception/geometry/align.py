# SPDX-License-Identifier: Apache-2.0
"""Depth of one camera as another one next to it sees it; planar depth, m."""

from __future__ import annotations

import math

import numpy as np

from openarm_common.camera.cameras import Intrinsics
from openarm_common.kernels import kernel
from openarm_common.types import Array, Floats


@kernel
def _align(
    z: Floats, rays_x: Floats, rays_y: Floats, half: Array, T: Array, fx: float, fy: float, cx: float, cy: float,
    out: Floats,
) -> None:  # fmt: skip
    pixel = np.empty((2, 2))
    for v in range(z.shape[0]):
        for u in range(z.shape[1]):
            depth = z[v, u]
            if not (np.isfinite(depth) and depth > 0.0):
                continue
            near = 0.0
            for corner in range(2):
                side = 2.0 * corner - 1.0
                x, y = (rays_x[u] + side * half[0]) * depth, (rays_y[v] + side * half[1]) * depth
                near = T[2, 0] * x + T[2, 1] * y + T[2, 2] * depth + T[2, 3]
                if near <= 0.0:
                    break
                pixel[corner, 0] = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * depth + T[0, 3]) / near * fx + cx
                pixel[corner, 1] = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * depth + T[1, 3]) / near * fy + cy
            if near <= 0.0:
                continue
            near = T[2, 0] * rays_x[u] * depth + T[2, 1] * rays_y[v] * depth + T[2, 2] * depth + T[2, 3]
            top, bottom = min(pixel[0, 1], pixel[1, 1]), max(pixel[0, 1], pixel[1, 1])
            left, right = min(pixel[0, 0], pixel[1, 0]), max(pixel[0, 0], pixel[1, 0])
            for row in range(max(0, math.ceil(top)), min(out.shape[0] - 1, math.floor(bottom)) + 1):
                for column in range(max(0, math.ceil(left)), min(out.shape[1] - 1, math.floor(right)) + 1):
                    if out[row, column] == 0.0 or near < out[row, column]:
                        out[row, column] = near


def aligned(z: Floats, lens: Intrinsics, T_color_depth: Array, color: Intrinsics) -> Floats:
    """Return the depth image that a colour camera would see, 0 where the depth camera saw nothing of it.

    A pixel of depth covers what its corners span in the colour image; where several do, the nearest counts.

    Args:
        z: (h, w) depth, m; not positive or NaN where nothing was measured.
        lens: Intrinsics of the depth camera, without distortion.
        T_color_depth: (4, 4) pose of the depth camera's optical frame in that of the colour camera.
        color: Intrinsics of the colour camera, without distortion.

    Returns:
        (height, width) float32 of the colour image.
    """
    out = np.zeros((color.height, color.width), np.float32)
    T = np.ascontiguousarray(T_color_depth, np.float64)
    z = np.ascontiguousarray(z, np.float32)
    half = np.array([0.5 / lens.fx, 0.5 / lens.fy])
    _align(z, *lens.rays, half, T, color.fx, color.fy, color.cx, color.cy, out)
    return out
