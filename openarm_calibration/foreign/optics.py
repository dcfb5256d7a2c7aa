# SPDX-License-Identifier: Apache-2.0
"""Intrinsics with distortion, as CameraInfo and the YAML of camera_calibration_parsers have them.

The solver's cameras have no distortion: marks are found in the image as it is, and then moved to where a camera with
the same K and no distortion shows them. Images that are kept are rectified to that camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from openarm_calibration.foreign.documents import read_document
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.types import Array

#: Distortion models, and how many coefficients each may have.
MODELS: dict[str, tuple[int, ...]] = {
    "": (0,), "none": (0,), "plumb_bob": (0, 4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,),
    "fisheye": (4,),
}  # fmt: skip
#: Marks that were moved and then distorted again must come back to this, px.
_MOST_LOST = 0.02
_STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)


@dataclass(frozen=True)
class Lens:
    """Intrinsics and distortion of a camera.

    Args:
        intrinsics: K and the size of the image.
        model: Of `MODELS`.
        coefficients: In OpenCV's order.
    """

    intrinsics: Intrinsics
    model: str = "none"
    coefficients: tuple[float, ...] = ()

    @property
    def straight(self) -> bool:
        """Whether there is no distortion."""
        return not any(self.coefficients)

    @property
    def _fisheye(self) -> bool:
        return self.model in ("equidistant", "fisheye")

    def undistorted(self, pixels: Array) -> Array:
        """Return pixels (n, 2) where a camera with the same K and no distortion shows them.

        Raises:
            OpenArmError: BAD_IMAGE, where the distortion can't be inverted.
        """
        if self.straight:
            return pixels
        K, d, raw = self.intrinsics.matrix, np.array(self.coefficients), pixels.reshape(-1, 1, 2)
        if self._fisheye:
            rays = cv2.fisheye.undistortPoints(raw, K, d)
            again = cv2.fisheye.distortPoints(rays, K, d).reshape(-1, 2)
        else:
            rays = cv2.undistortPointsIter(raw, K, d, np.eye(3), np.eye(3), _STOP)
            whole = np.column_stack([rays.reshape(-1, 2), np.ones(len(pixels))])
            again = cv2.projectPoints(whole, np.zeros(3), np.zeros(3), K, d)[0].reshape(-1, 2)
        lost = float(np.abs(again - pixels).max())
        if not lost < _MOST_LOST:
            raise OpenArmError(
                Code.BAD_IMAGE,
                f"the distortion {brief(list(self.coefficients))} ({self.model}) can't be inverted at the marks: they"
                f" come back {lost:.2f} px off; are these the coefficients of this camera?",
            )
        k = self.intrinsics
        return rays.reshape(-1, 2).astype(np.float64) * (k.fx, k.fy) + (k.cx, k.cy)

    def rectified(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the image (h, w) as a camera with the same K and no distortion shows it."""
        if self.straight:
            return image
        K, d, size = self.intrinsics.matrix, np.array(self.coefficients), (image.shape[1], image.shape[0])
        if self._fisheye:
            maps = cv2.fisheye.initUndistortRectifyMap(K, d, np.eye(3), K, size, cv2.CV_32FC1)
        else:
            maps = cv2.initUndistortRectifyMap(K, d, np.eye(3), K, size, cv2.CV_32FC1)
        return cv2.remap(image, *maps, cv2.INTER_LINEAR).astype(np.uint8)


def lens_of(
    size: tuple[int, int], k: Sequence[float], model: str, coefficients: Sequence[float], where: str
) -> Lens:  # fmt: skip
    """Make a lens of the fields of a CameraInfo.

    Args:
        size: Width and height of the image.
        k: Nine numbers of K, by rows; by columns where only that can be.
        model: Distortion model.
        coefficients: Of it.
        where: Begins the error.

    Raises:
        OpenArmError: BAD_IMAGE, naming what is wrong.
    """
    if k[2] == 0.0 == k[5] and k[6] != 0.0 != k[7]:
        k = [k[j] for j in (0, 3, 6, 1, 4, 7, 2, 5, 8)]  # by columns
    optics = Intrinsics(int(size[0]), int(size[1]), float(k[0]), float(k[4]), float(k[2]), float(k[5]))
    if fault := optics.fault():
        raise OpenArmError(Code.BAD_IMAGE, f"{where} is not calibrated: {fault}")
    if abs(float(k[1])) > 1e-6 * optics.fx:
        raise OpenArmError(Code.BAD_IMAGE, f"{where} has a skew of {float(k[1]):g} px, expected 0")
    values = tuple(float(value) for value in coefficients)
    if not np.isfinite(values).all():
        raise OpenArmError(Code.BAD_IMAGE, f"{where} has distortion coefficients that are not finite")
    if not any(values):
        return Lens(optics)
    if model not in MODELS or len(values) not in MODELS[model]:
        listed = ", ".join(f"{name} ({' or '.join(str(n) for n in counts)})" for name, counts in MODELS.items() if name)
        raise OpenArmError(
            Code.BAD_IMAGE, f"{where} has {len(values)} coefficients of the model {brief(model)}; models: {listed}"
        )
    return Lens(optics, model, values)


#: Names that files have for the matrix, the distortion, and the size of the image.
_MATRIX = ("camera_matrix", "cameramatrix", "k", "mtx", "intrinsic_matrix", "intrinsics", "matrix")
_DISTORTION = ("distortion_coefficients", "distortion", "distcoeffs", "dist_coeffs", "dist", "d", "coefficients")
_SIZES = (("image_width", "image_height"), ("width", "height"), ("w", "h"))


def read_camera_info(path: Path) -> Lens:
    """Read intrinsics: a camera_info YAML, what OpenCV's FileStorage writes, or JSON with a matrix and a size.

    Raises:
        OpenArmError: CONFIG_INVALID, naming the file and what is wrong; BAD_IMAGE, as `lens_of`.
    """
    document: Any = read_document(path)
    entries = {str(key).lower(): value for key, value in document.items()} if isinstance(document, dict) else {}  # pyright: ignore
    entries |= {str(key).lower(): one for key, one in _inner(entries).items()}
    try:
        size = _size(entries)
        k = _listed(next(entries[name] for name in _MATRIX if name in entries))
        d = _listed(next((entries[name] for name in _DISTORTION if name in entries), ()))
        model = str(entries.get("distortion_model", "plumb_bob" if len(d) <= 5 else "rational_polynomial"))
        if len(k) != 9:
            raise ValueError(f"the matrix has {len(k)} numbers, expected 9")
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, StopIteration) as error:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"{path} is no camera_info: {type(error).__name__}: {brief(str(error))}; expected image_width,"
            " image_height, camera_matrix (or K) and distortion_coefficients (or D), distortion_model",
        ) from error
    return lens_of(size, k, model, d, str(path))


def _inner(entries: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of a mapping within, such as `camera`, where the matrix is there."""
    every = (value for value in entries.values() if isinstance(value, dict))
    return next((one for one in every if {str(key).lower() for key in one} & {*_MATRIX} - {"matrix"}), {})  # pyright: ignore


def _size(entries: dict[str, Any]) -> tuple[int, int]:
    for width, height in _SIZES:
        if width in entries and height in entries:
            return int(entries[width]), int(entries[height])
    for name in ("image_size", "resolution", "size"):
        if name in entries:
            width, height = _listed(entries[name])
            return int(width), int(height)
    raise KeyError("image_width")


def _listed(value: Any) -> list[float]:
    """Return the numbers of a list, nested or not, of FileStorage's matrix, or of fx, fy, cx and cy."""
    if isinstance(value, dict):
        if "data" in value:
            return _listed(value["data"])  # pyright: ignore[reportUnknownArgumentType]
        fx, fy, cx, cy = (float(value[name]) for name in ("fx", "fy", "cx", "cy"))  # pyright: ignore
        return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    return np.array(value, dtype=np.float64).ravel().tolist()


def camera_info(name: str, lens: Lens) -> str:
    """Return the camera_info YAML of a camera, as camera_calibration_parsers reads it.

    Args:
        name: Of the camera.
        lens: Its intrinsics.
    """
    optics = lens.intrinsics
    d = list(lens.coefficients) or [0.0] * 5
    K: Any = optics.matrix.ravel().tolist()
    P: Any = np.hstack([optics.matrix, np.zeros((3, 1))]).ravel().tolist()
    document: dict[str, Any] = {
        "image_width": optics.width,
        "image_height": optics.height,
        "camera_name": name,
        "camera_matrix": {"rows": 3, "cols": 3, "data": K},
        "distortion_model": "plumb_bob" if lens.straight else lens.model,
        "distortion_coefficients": {"rows": 1, "cols": len(d), "data": d},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": P},
    }
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None)
