# SPDX-License-Identifier: Apache-2.0
"""Distortion of lenses, as CameraInfo describes it, and pictures without it.

A pinhole camera with the same K stands for a lens: marks are moved, and pictures resampled, to where it shows them.
What librealsense calls inverse Brown-Conrady distorts as OpenCV's `plumb_bob` does, but for its tangential part, which
is of rays that are scaled already: 0.06 px in the corner of a D455. Pixels.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import check_size
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.types import Array, Bytes, Floats

_POLYNOMIAL = (4, 5, 8, 12, 14)
#: Distortion models, and how many coefficients each may have. `radtan` is Kalibr's name.
MODELS: dict[str, tuple[int, ...]] = {
    "plumb_bob": _POLYNOMIAL, "rational_polynomial": _POLYNOMIAL, "thin_prism": (12,), "radtan": (4, 5),
    "brown_conrady": (5,), "inverse_brown_conrady": (5,), "modified_brown_conrady": (5,),
    "equidistant": (4,), "fisheye": (4,), "kannala_brandt4": (4, 5),
}  # fmt: skip
#: Margin of an image in which no principal point lies, as a share of its sides: K is of another resolution then.
_MARGIN = 0.05
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt4")
_LIBREALSENSE = ("inverse_brown_conrady", "modified_brown_conrady")
#: Marks that were moved and then distorted again must come back to this, px.
_MOST_LOST = 0.02
#: Rounds in which librealsense's model is inverted.
_ROUNDS = 20
_STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)


@dataclass(frozen=True)
class Lens:
    """Intrinsics and distortion of a camera.

    Args:
        intrinsics: K and the size of the image.
        model: Name in `MODELS`, or none.
        coefficients: Coefficients in OpenCV's order.
    """

    intrinsics: Intrinsics
    model: str = "none"
    coefficients: tuple[float, ...] = ()

    @property
    def straight(self) -> bool:
        """Whether there is no distortion."""
        return not any(self.coefficients)

    @property
    def fisheye(self) -> bool:
        """Whether the model is that of `cv2.fisheye`."""
        return self.model in _FISHEYE

    @property
    def d(self) -> Array:
        """The coefficients as OpenCV takes them: four of a fisheye, zeros where there are none."""
        return np.array(self.coefficients[: 4 if self.fisheye else None] or (0.0,) * 4)

    def undistorted(self, pixels: Array) -> Array:
        """Return pixels (n, 2) where a camera with the same K and no distortion shows them.

        Raises:
            OpenArmError: BAD_IMAGE, where the distortion can't be inverted.
        """
        if self.straight:
            return pixels
        K, d, raw = self.intrinsics.matrix, self.d, pixels.reshape(-1, 1, 2)
        if self.fisheye:
            rays = cv2.fisheye.undistortPoints(raw, K, d)
        else:
            rays = cv2.undistortPointsIter(raw, K, d, np.eye(3), np.eye(3), _STOP)
        rays = rays.reshape(-1, 2).astype(np.float64)
        if self.model in _LIBREALSENSE:
            seen = (pixels - K[:2, 2]) / np.diag(K)[:2]
            for _ in range(_ROUNDS):
                rays = rays + seen - _of_librealsense(rays, d)
        lost = float(np.abs(self.distorted(rays) - pixels).max())
        if not lost < _MOST_LOST:
            raise OpenArmError(
                Code.BAD_IMAGE,
                f"the distortion {brief(list(self.coefficients))} ({self.model}) can't be inverted at the marks: they"
                f" come back {lost:.2f} px off; are these the coefficients of this camera?",
            )
        return rays * np.diag(K)[:2] + K[:2, 2]

    def distorted(self, rays: Array) -> Array:
        """Return the pixels (n, 2) at which the lens shows rays (n, 2): x over z and y over z."""
        K, d = self.intrinsics.matrix, self.d
        if self.fisheye:
            return cv2.fisheye.distortPoints(rays[:, None], K, d).reshape(-1, 2).astype(np.float64)
        if self.model in _LIBREALSENSE:
            return _of_librealsense(rays, d) * np.diag(K)[:2] + K[:2, 2]
        whole = np.column_stack([rays, np.ones(len(rays))])
        return cv2.projectPoints(whole, np.zeros(3), np.zeros(3), K, d)[0].reshape(-1, 2).astype(np.float64)

    def rectified(self, picture: Bytes) -> Bytes:
        """Return a picture (h, w) or (h, w, channels) as a camera with the same K and no distortion shows it.

        Raises:
            OpenArmError: BAD_IMAGE, for a picture of another size.
        """
        check_size("colour image", picture.shape, self.intrinsics)
        if self.straight:
            return picture
        out = cv2.remap(picture, *_maps(self), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return out.astype(np.uint8, copy=False)

    def rectified_depth(self, depth: NDArray[Any]) -> NDArray[Any]:
        """Return a depth image (h, w) without distortion; depths are not mixed, and 0 where the lens sees nothing.

        Raises:
            OpenArmError: BAD_IMAGE, for an image of another size.
        """
        check_size("depth image", depth.shape, self.intrinsics)
        if self.straight:
            return depth
        return cv2.remap(depth, *_maps(self), cv2.INTER_NEAREST, borderValue=(0.0,)).astype(depth.dtype, copy=False)

    def maps(self, R: Array, P: Array) -> tuple[Floats, Floats]:
        """Return column and row (h, w) at which the lens shows each pixel of a camera without distortion.

        Args:
            R: (3, 3) rotation from the frame of the lens to that of the other camera.
            P: (3, 3) K of the other camera, of images of the same size.
        """
        k, d = self.intrinsics, self.d
        size = (k.width, k.height)
        if self.model in _LIBREALSENSE:
            v, u = np.indices(size[::-1]).reshape(2, -1)
            rays = np.column_stack([u, v, np.ones(len(u))]) @ np.linalg.inv(P @ R).T
            at = self.distorted(rays[:, :2] / rays[:, 2:]).astype(np.float32)
            return at[:, 0].reshape(size[::-1]), at[:, 1].reshape(size[::-1])
        if self.fisheye:
            maps = cv2.fisheye.initUndistortRectifyMap(k.matrix, d, R, P, size, cv2.CV_32FC1)
        else:
            maps = cv2.initUndistortRectifyMap(k.matrix, d, R, P, size, cv2.CV_32FC1)
        return maps[0].astype(np.float32, copy=False), maps[1].astype(np.float32, copy=False)


def _of_librealsense(rays: Array, d: Array) -> Array:
    """Return rays (n, 2) as `rs2_project_point_to_pixel` distorts them."""
    r2 = np.sum(rays**2, axis=1)
    x, y = (rays * (1.0 + r2 * (d[0] + r2 * (d[1] + r2 * d[4])))[:, None]).T
    return np.column_stack(
        [x + 2.0 * d[2] * x * y + d[3] * (r2 + 2.0 * x * x), y + 2.0 * d[3] * x * y + d[2] * (r2 + 2.0 * y * y)]
    )


@lru_cache(maxsize=8)
def _maps(lens: Lens) -> tuple[Floats, Floats]:
    """Return the maps to a pinhole camera with the same K."""
    return lens.maps(np.eye(3), lens.intrinsics.matrix)


def lens_of(size: Sequence[int], k: Sequence[float], model: str, coefficients: Sequence[float], where: str) -> Lens:
    """Make a lens of the fields of a CameraInfo.

    Args:
        size: Width and height of the image.
        k: Nine numbers of K, by rows; by columns where only that can be.
        model: Distortion model.
        coefficients: Coefficients of the model.
        where: Subject of the error.

    Raises:
        OpenArmError: BAD_IMAGE, naming what is wrong.
    """
    if k[2] == 0.0 == k[5] and k[6] != 0.0 != k[7]:
        k = [k[j] for j in (0, 3, 6, 1, 4, 7, 2, 5, 8)]  # by columns
    optics = Intrinsics(int(size[0]), int(size[1]), float(k[0]), float(k[4]), float(k[2]), float(k[5]))
    if fault := optics.fault():
        raise OpenArmError(Code.BAD_IMAGE, f"{where} is not calibrated: {fault}")
    for c, side, name in ((optics.cx, optics.width, "cx"), (optics.cy, optics.height, "cy")):
        if not _MARGIN < c / side < 1.0 - _MARGIN:
            raise OpenArmError(
                Code.BAD_IMAGE,
                f"{where} has {name} = {c:g} of {optics.width}x{optics.height} pixels, at the border or outside of the"
                f" image; expected about its middle. It would be of images of about {2 * optics.cx:.0f}x"
                f"{2 * optics.cy:.0f} pixels: give K of this resolution",
            )
    if abs(float(k[1])) > 1e-6 * optics.fx:
        raise OpenArmError(Code.BAD_IMAGE, f"{where} has a skew of {float(k[1]):g} px, expected 0")
    values = tuple(float(value) for value in coefficients)
    if not np.isfinite(values).all():
        raise OpenArmError(Code.BAD_IMAGE, f"{where} has distortion coefficients that are not finite")
    if not any(values):
        return Lens(optics)
    name = re.sub(r"[\s-]+", "_", model.strip().lower()) or "plumb_bob"
    if name not in MODELS or len(values) not in MODELS[name]:
        listed = ", ".join(f"{one} ({' or '.join(map(str, counts))})" for one, counts in MODELS.items())
        raise OpenArmError(
            Code.BAD_IMAGE,
            f"{where} has the distortion model {brief(model)} with {len(values)} coefficients; models, and their"
            f" coefficients: {listed}",
        )
    return Lens(optics, name, values)
