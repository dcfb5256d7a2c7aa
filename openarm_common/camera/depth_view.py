# SPDX-License-Identifier: Apache-2.0
"""A depth image with all that gives its pixels a place: intrinsics, pose of the camera, limits; base frame, m."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array, Floats

#: Planar depth (h, w): millimetres (16UC1) or metres (32FC1).
DepthImage = NDArray[np.uint16] | NDArray[np.float32] | NDArray[np.uint16 | np.float32]


def unit_scale(depth: DepthImage) -> float:
    """Return metres of one count of a depth image.

    Raises:
        OpenArmError: BAD_IMAGE, when the image is neither 16UC1 nor 32FC1.
    """
    if depth.ndim == 2 and depth.dtype == np.uint16:
        return 1e-3
    if depth.ndim == 2 and depth.dtype == np.float32:
        return 1.0
    raise OpenArmError(
        Code.BAD_IMAGE,
        f"depth image has shape {depth.shape} and type {depth.dtype}; expected (h, w) of uint16 millimetres (16UC1) or "
        "float32 metres (32FC1)",
    )


def millimetres(z: Floats) -> NDArray[np.uint16]:
    """Convert metres below 65 to whole millimetres, 0 for NaN; `z` is overwritten."""
    np.multiply(z, np.float32(1000.0), out=z)
    np.add(z, np.float32(0.5), out=z)
    return np.nan_to_num(z, copy=False, nan=0.0).astype(np.uint16)


def check_size(what: str, shape: tuple[int, ...], intrinsics: Intrinsics) -> None:
    """Refuse an image that does not belong to the intrinsics.

    Args:
        what: Name of the image.
        shape: Shape of the image.
        intrinsics: Those that are said to be its camera's.

    Raises:
        OpenArmError: BAD_IMAGE, naming the image and both sizes.
    """
    if shape[:2] != (intrinsics.height, intrinsics.width):
        raise OpenArmError(
            Code.BAD_IMAGE,
            f"{what} is {shape[1]}x{shape[0]} pixels, but its intrinsics (camera_info) are of"
            f" {intrinsics.width}x{intrinsics.height}; both must come from the same stream",
        )


@dataclass(frozen=True, eq=False)
class DepthView:
    """A depth image and where it was taken.

    Attributes:
        depth: (h, w) planar depth, uint16 mm or float32 m.
        intrinsics: Intrinsics of the camera.
        T_base_camera: Optical frame in the base frame, (4, 4).
        near: Nearest valid depth, m.
        far: Farthest valid depth, m.
    """

    depth: DepthImage
    intrinsics: Intrinsics
    T_base_camera: Array
    near: float
    far: float

    def __post_init__(self) -> None:
        """Refuse what does not fit together.

        Raises:
            OpenArmError: BAD_IMAGE, naming what does not.
        """
        unit_scale(self.depth)
        check_size("depth image", self.depth.shape, self.intrinsics)
        if not (self.intrinsics.fx > 0.0 and self.intrinsics.fy > 0.0):
            raise OpenArmError(
                Code.BAD_IMAGE, f"focal lengths are {self.intrinsics.fx}, {self.intrinsics.fy}; expected > 0"
            )
        if not np.isfinite(self.T_base_camera).all():
            raise OpenArmError(Code.NO_TRANSFORM, "the pose of the camera is not finite")

    @property
    def rays(self) -> tuple[Floats, Floats]:
        """Directions of columns (x over z) and of rows (y over z)."""
        return self.intrinsics.rays

    @property
    def scale(self) -> np.float32:
        """Metres of one count."""
        return np.float32(unit_scale(self.depth))
