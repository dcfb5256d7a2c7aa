# SPDX-License-Identifier: Apache-2.0
"""Depth images to points in the optical frame (z forward, x right, y down), metres.

Depth is planar: the distance along the optical axis, not along the ray. Encodings are those of the ROS images:
``uint16`` millimetres (16UC1) and ``float32`` metres (32FC1). Invalid are 0, NaN, infinity, and what lies outside the
limits of the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import DepthImage, check_size, unit_scale
from openarm_common.config import Config
from openarm_common.kernels import kernel
from openarm_common.types import Array, Bytes, Mask
from openarm_perception.geometry.levels import Levels

Points = NDArray[np.float32]


class DepthLimits(Config):
    """Depths that a camera can be trusted with."""

    near: float = Field(default=0.05, gt=0.0, description="nearest depth that counts, m")
    far: float = Field(default=3.0, gt=0.0, description="farthest depth that counts, m")

    @model_validator(mode="after")
    def _ordered(self) -> DepthLimits:
        if self.far <= self.near:
            raise ValueError(f"far must be larger than near, got near {self.near} and far {self.far}")
        return self


#: For whoever has to know all that was measured.
UNLIMITED = DepthLimits(near=1e-6, far=1e6)


@kernel
def _organise(
    depth: DepthImage, scale: np.float32, near: np.float32, far: np.float32, ray_x: Points, ray_y: Points, out: Points
) -> None:
    nan = np.float32(np.nan)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = np.float32(depth[v, u]) * scale
            # a comparison with NaN is false, so NaN falls out here too
            z = z if near <= z <= far else nan
            out[v, u, 0] = ray_x[u] * z
            out[v, u, 1] = ray_y[v] * z
            out[v, u, 2] = z


@kernel
def _count(depth: DepthImage, scale: np.float32, near: np.float32, far: np.float32) -> int:
    n = 0
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = np.float32(depth[v, u]) * scale
            if near <= z <= far:
                n += 1
    return n


@kernel
def _filter(
    depth: DepthImage, scale: np.float32, near: np.float32, far: np.float32, ray_x: Points, ray_y: Points, out: Points
) -> None:
    n = 0
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = np.float32(depth[v, u]) * scale
            if near <= z <= far:
                out[n, 0] = ray_x[u] * z
                out[n, 1] = ray_y[v] * z
                out[n, 2] = z
                n += 1


@dataclass(frozen=True)
class View:
    """Aligned images and where they were taken.

    Attributes:
        rgb: (h, w, 3) uint8.
        depth: (h, w) uint16 millimetres or float32 metres, planar.
        intrinsics: Intrinsics of both.
        T_base_camera: (4, 4) optical frame in the base frame.
        robot: (h, w) pixels that show the robot or what it holds; None when it was not searched for.
        levels: Surfaces over the table that things stand on; None: all stand on the table.
    """

    rgb: Bytes
    depth: DepthImage
    intrinsics: Intrinsics
    T_base_camera: Array
    robot: Mask | None = None
    levels: Levels | None = None

    def metres(self, limits: DepthLimits) -> NDArray[np.float32]:
        """Return the depth (h, w), m; NaN where none counts."""
        z = self.depth.astype(np.float32) * np.float32(unit_scale(self.depth))
        return np.where((z >= limits.near) & (z <= limits.far), z, np.float32(np.nan))

    def heights(self, limits: DepthLimits, window: tuple[slice, slice] | None = None) -> NDArray[np.float32]:
        """Return the heights (h, w) of the pixels in the base frame, m; NaN without a depth that counts.

        Args:
            limits: Depths that count.
            window: Rows and columns; all without it.
        """
        rows, columns = window or (slice(0, self.intrinsics.height), slice(0, self.intrinsics.width))
        z = self.metres(limits)[rows, columns]
        lens, up = self.intrinsics, self.T_base_camera[2]
        x = (np.arange(rows.start, rows.stop) - lens.cy) / lens.fy * up[1] + up[2]
        y = (np.arange(columns.start, columns.stop) - lens.cx) / lens.fx * up[0]
        return z * (x[:, None] + y).astype(np.float32) + np.float32(up[3])


class Deprojector:
    """Turns depth images into points.

    Args:
        limits: Depths that count.
    """

    def __init__(self, limits: DepthLimits) -> None:
        self.limits = limits

    def organised(self, depth: DepthImage, intrinsics: Intrinsics, out: Points | None = None) -> Points:
        """Return points of every pixel.

        Args:
            depth: (h, w), uint16 millimetres or float32 metres.
            intrinsics: Intrinsics of the camera, from its CameraInfo.
            out: (h, w, 3) float32 to write to; a new array without it.

        Returns:
            (h, w, 3) float32 in the optical frame, m; NaN where the depth is invalid.

        Raises:
            OpenArmError: BAD_IMAGE, for an unknown encoding or a size other than the intrinsics'.
        """
        pixels = self._pixels(depth, intrinsics)
        if out is None:
            out = np.empty((*depth.shape, 3), np.float32)
        _organise(*pixels, *intrinsics.rays, out)
        return out

    def valid_points(self, depth: DepthImage, intrinsics: Intrinsics) -> Points:
        """Points (n, 3) float32 of the pixels with a valid depth, in row order; arguments and errors as `organised`."""
        pixels = self._pixels(depth, intrinsics)
        # counting first costs 0.1 ms; a buffer for all pixels and a copy of its head cost up to 3 ms in page faults
        out = np.empty((_count(*pixels), 3), np.float32)
        _filter(*pixels, *intrinsics.rays, out)
        return out

    def _pixels(
        self, depth: DepthImage, intrinsics: Intrinsics
    ) -> tuple[NDArray[np.uint16 | np.float32], np.float32, np.float32, np.float32]:
        """Return what the kernels take of an image: depth, scale, limits."""
        scale = unit_scale(depth)
        check_size("depth image", depth.shape, intrinsics)
        # contiguous and read-only, as what a message gives, so that kernels are compiled once
        pixels = np.ascontiguousarray(depth).view()
        pixels.flags.writeable = False
        return pixels, np.float32(scale), np.float32(self.limits.near), np.float32(self.limits.far)
