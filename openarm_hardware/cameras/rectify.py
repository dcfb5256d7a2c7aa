# SPDX-License-Identifier: Apache-2.0
"""Pictures without distortion, since nodes of the suite compute with pinholes."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import Intrinsics
from openarm_common.types import Array, Bytes

#: `brown` distorts what a pinhole would see (OpenCV's plumb_bob); `inverse` undistorts what the camera sees, as
#: librealsense says of most of its colour cameras.
DistortionModel = Literal["brown", "inverse"]


class Rectifier:
    """Takes the distortion of a camera out of its pictures, which keep their pinhole.

    Args:
        intrinsics: Of the camera.
        coefficients: k1, k2, p1, p2, k3, and more for `brown` as OpenCV takes them.
        model: What they are of.
    """

    def __init__(self, intrinsics: Intrinsics, coefficients: Array, model: DistortionModel = "brown") -> None:
        self._maps: tuple[NDArray[np.floating], NDArray[np.floating]] | None = None
        if not np.any(coefficients):
            return
        size, K = (intrinsics.width, intrinsics.height), intrinsics.matrix
        if model == "brown":
            self._maps = cv2.initUndistortRectifyMap(K, coefficients, None, K, size, cv2.CV_32FC1)  # pyright: ignore
            return
        v, u = np.indices((intrinsics.height, intrinsics.width), np.float64)
        pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
        seen = cv2.undistortPoints(pixels, K, coefficients, P=K).reshape(intrinsics.height, intrinsics.width, 2)
        self._maps = seen[..., 0].astype(np.float32), seen[..., 1].astype(np.float32)

    def color(self, picture: Bytes) -> Bytes:
        """Return a picture (h, w, 3) without distortion."""
        return picture if self._maps is None else cv2.remap(picture, *self._maps, cv2.INTER_LINEAR)  # pyright: ignore

    def depth(self, picture: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return a depth image (h, w) without distortion; depths are not mixed."""
        return picture if self._maps is None else cv2.remap(picture, *self._maps, cv2.INTER_NEAREST)  # pyright: ignore
