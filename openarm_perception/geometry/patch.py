# SPDX-License-Identifier: Apache-2.0
"""The neighbourhood of a detection as points of the base frame, m, without the noise of a real sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import check_size, unit_scale
from openarm_common.types import Array, Floats
from openarm_perception.detection.detector import Detection2D, Mask
from openarm_perception.geometry.depth import DepthLimits, View

#: Depth with less noise than this is used as it is, m; 16UC1 alone rounds by 0.3 mm (1 sigma).
_CLEAN = 0.0006
#: Or with less than so many pixels across.
_COARSE = 0.75
#: More pixels without depth than this share, and it is used as it is no more.
_FEW_HOLES = 0.001
#: Stands for no depth among depths, m.
_FAR = 100.0
#: Pixels that the noise is measured at.
_ASKED = 20_000
#: A median that is farther from what was measured lies between two surfaces: in what is left of the noise (four times
#: that of a pixel), and in pixels of a slanted surface.
_BETWEEN, _STEEP = 16.0, 4.0
#: Pixels around a detection that belong to its patch.
_MARGIN = 4


@dataclass(frozen=True)
class Patch:
    """The neighbourhood of a detection: pixel rays and points, all (h, w, ...)."""

    found: Detection2D
    intrinsics: Intrinsics
    T_base_camera: Array  # (4, 4)
    rays: Array  # directions in the base frame, of unit depth
    z: Array  # planar depth, m, NaN where invalid
    points: Array  # base frame, m
    coloured: Mask  # the object by colour
    robot: Mask  # the robot and what it holds
    band: float  # heights within this of the top are top, m
    floor: float  # height of the surface under the object, base frame, m

    @property
    def mask(self) -> Mask:
        """The object: what has its colour and is not the robot."""
        return self.coloured & ~self.robot


def cut(found: Detection2D, view: View, limits: DepthLimits, top_band: float, table: float) -> Patch:
    """Return the patch of a detection, without what stands on it.

    Args:
        found: Detection in the colour image.
        view: The frame; what is the robot is no part of the object, but may hide it.
        limits: Depths that count.
        top_band: Heights within this of the top are top where the depth is clean, m.
        table: Height of the table, m.

    Raises:
        OpenArmError: BAD_IMAGE, when image and intrinsics disagree.
    """
    intrinsics, T_base_camera = view.intrinsics, view.T_base_camera
    scale = unit_scale(view.depth)
    check_size("depth image", view.depth.shape, intrinsics)
    # with a margin: edges are found between a pixel of the object and one that is not
    (u, v), (w, h) = found.origin, found.size
    u0, u1 = max(u - _MARGIN, 0), min(u + w + _MARGIN, intrinsics.width)
    v0, v1 = max(v - _MARGIN, 0), min(v + h + _MARGIN, intrinsics.height)
    z = view.depth[v0:v1, u0:u1] * scale
    z = np.where((z >= limits.near) & (z <= limits.far), z, np.nan)
    z, noise = denoise(z, 2.0 / (intrinsics.fx + intrinsics.fy))
    x = (np.arange(u0, u1) - intrinsics.cx) / intrinsics.fx
    y = (np.arange(v0, v1) - intrinsics.cy) / intrinsics.fy
    in_camera = np.stack([*np.meshgrid(x, y), np.ones(z.shape)], axis=-1)
    rays = in_camera @ T_base_camera[:3, :3].T
    coloured = np.zeros(z.shape, np.bool_)
    coloured[v - v0 : v - v0 + h, u - u0 : u - u0 + w] = found.mask
    if view.levels is not None:
        levels, window = view.levels, (slice(v0, v1), slice(u0, u1))
        number = levels.of(window, coloured)
        coloured &= levels.height[levels.under[window]] <= levels.height[number]
        table += float(levels.height[number])
    hidden = np.zeros(z.shape, np.bool_) if view.robot is None else view.robot[v0:v1, u0:u1]
    band = max(top_band, 3.0 * noise)
    points = rays * z[..., None] + T_base_camera[:3, 3]
    return Patch(found, intrinsics, T_base_camera, rays, z, points, coloured, hidden, band, table)


def denoise(z: Array | NDArray[np.float32], pixel: float) -> tuple[Array, float]:
    """Depth without the noise and dropouts of a real sensor, and the noise that is left, m; clean depth stays.

    Args:
        z: (h, w) m, NaN where nothing was measured.
        pixel: Metres across of a pixel at 1 m; a median over coarse ones would round off more than noise does.
    """
    holes = np.isnan(z)
    noise, depth = _noise(z), z[~holes]
    middle = float(np.median(depth[:: max(1, len(depth) // _ASKED)])) if len(depth) else 0.0
    coarse = _COARSE * pixel * middle
    clean = noise < max(_CLEAN, coarse)
    if clean and np.count_nonzero(holes) < _FEW_HOLES * z.size:
        return z.astype(np.float64), noise
    # the median keeps edges where they are; a hole counts as far away, as what lies behind the object
    smooth = cv2.medianBlur(np.where(holes, np.float32(_FAR), z).astype(np.float32), 5).astype(np.float64)
    smooth[smooth > 0.99 * _FAR] = np.nan
    # a median of 25 leaves a quarter of the noise (sqrt(pi / 2 / 25))
    return (np.where(holes, smooth, z), noise) if clean and coarse > _CLEAN else (smooth, 0.25 * noise)


def smoothed(z: NDArray[np.float32], intrinsics: Intrinsics) -> Floats:
    """Return the depth (h, w) of an image, m, NaN where nothing was measured, without noise, and with its edges."""
    pixel = 2.0 / (intrinsics.fx + intrinsics.fy)
    return keep_edges(z, *denoise(z, pixel), pixel).astype(np.float32)


def _noise(z: Array | NDArray[np.float32]) -> float:
    """Return the noise of depths (h, w), m, by the smaller half of their second differences: without edges."""
    bends = np.concatenate([np.abs(np.diff(z, 2, axis=axis)).ravel() for axis in (0, 1)])
    bends = bends[np.isfinite(bends)]
    bends = np.sort(bends[:: max(1, len(bends) // _ASKED)])
    inner = bends[: len(bends) // 2]
    # sqrt(6) times the noise is theirs, of which the smaller half has 0.378
    return float(np.sqrt(np.mean(inner.astype(np.float64) ** 2))) / (0.378 * math.sqrt(6.0)) if len(inner) else 0.0


def keep_edges(z: Array | NDArray[np.float32], smooth: Array, noise: float, pixel: float) -> Array:
    """Return smooth depth with the measured one at edges, where the median lies between two surfaces.

    Args:
        z: Depth as measured, m.
        smooth: Result of `denoise`.
        noise: Noise that is left, m.
        pixel: Metres across of a pixel at 1 m.
    """
    with np.errstate(invalid="ignore"):
        between = np.abs(smooth - z) > _BETWEEN * noise + _STEEP * pixel * z
    return np.where(between, z, smooth)
