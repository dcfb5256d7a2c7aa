# SPDX-License-Identifier: Apache-2.0
"""A grid of 9x9 blobs as lenses show it, and where it is without their distortion; OpenCV and librealsense say both."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from openarm_common.errors import OpenArmError

#: Intrinsics of a D455's colour camera.
SIZE, K = (1280, 720), np.array([[653.8315, 0.0, 652.3585], [0.0, 653.0682, 361.8429], [0.0, 0.0, 1.0]])
D455 = (-0.0517636, 0.0564384, -0.00080565, 0.00136857, -0.0187142)
#: Coefficients by model.
MODELS: dict[str, tuple[float, ...]] = {
    "plumb_bob": (-0.17, 0.05, 0.0006, -0.0004, -0.005),
    "rational_polynomial": (0.35, -0.2, 0.0005, -0.0003, 0.01, 0.5, -0.25, 0.02),
    "thin_prism": (-0.1, 0.03, 0.0, 0.0, 0.0, 0.02, 0.0, 0.0, 0.001, -0.0005, 0.0008, 0.0003),
    "equidistant": (-0.02, 0.004, -0.003, 0.001),
    "inverse_brown_conrady": D455,
}
#: Coefficients by model of librealsense.
LIBRARY: dict[str, tuple[float, ...]] = {
    "none": (0.0,) * 5, "brown_conrady": MODELS["plumb_bob"], "modified_brown_conrady": D455,
    "inverse_brown_conrady": D455, "kannala_brandt4": (*MODELS["equidistant"], 0.0),
}  # fmt: skip
_STEPS = np.linspace(-0.8, 0.8, 9)
#: Rays (81, 2) to the blobs, and where a camera without distortion shows them, px.
RAYS = np.stack(np.meshgrid(_STEPS * 0.9, _STEPS * 0.5), axis=-1).reshape(-1, 2)
STRAIGHT = RAYS @ K[:2, :2] + K[:2, 2]
_WIDTH = 1.6


def shown(model: str) -> NDArray[np.float64]:
    """Return the pixels (81, 2) at which a lens shows the grid."""
    d = np.array(MODELS[model])
    if model == "inverse_brown_conrady":
        return shown_by_library(model)
    if model == "equidistant":
        return cv2.fisheye.distortPoints(RAYS[:, None], K, d).reshape(-1, 2)
    return cv2.projectPoints(_points(), np.zeros(3), np.zeros(3), K, d)[0].reshape(-1, 2)


def shown_by_library(model: str) -> NDArray[np.float64]:
    """Return the pixels (81, 2) at which librealsense shows the grid."""
    rs, optics = librealsense(model)
    return np.array([rs.rs2_project_point_to_pixel(optics, list(point)) for point in _points()])


def _points() -> NDArray[np.float64]:
    return np.column_stack([RAYS, np.ones(len(RAYS))])


def calibration(model: str) -> str:
    """Return the camera_info of a lens, as YAML."""
    k, d = K.ravel().tolist(), list(MODELS[model])
    return f"width: {SIZE[0]}\nheight: {SIZE[1]}\nk: {k}\ndistortion_model: {model}\nd: {d}\n"


def librealsense(model: str) -> tuple[Any, Any]:
    """Return the library and its intrinsics; skip the test where it is not installed."""
    from openarm_hardware.cameras.realsense import library

    try:
        rs = library()
    except OpenArmError as error:  # an extra
        pytest.skip(error.message)
    optics = rs.intrinsics()
    optics.width, optics.height = SIZE
    optics.fx, optics.fy, optics.ppx, optics.ppy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    optics.model, optics.coeffs = getattr(rs.distortion, model), list(LIBRARY[model])
    return rs, optics


def drawn(pixels: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Draw bright blobs (n, 2) on black: (h, w)."""
    out = np.zeros(SIZE[::-1])
    for u, v in pixels:
        left, top = max(0, round(u) - 15), max(0, round(v) - 15)
        row, column = np.mgrid[top : min(SIZE[1], top + 31), left : min(SIZE[0], left + 31)]
        out[top : top + 31, left : left + 31] += np.exp(-((column - u) ** 2 + (row - v) ** 2) / (2 * _WIDTH**2))
    return np.rint(255 * out.clip(0, 1)).astype(np.uint8)


def off(picture: NDArray[np.uint8], expected: NDArray[np.float64] = STRAIGHT) -> float:
    """Return the largest distance of a blob in a picture (h, w) from where it is without distortion (81, 2), px."""
    worst = 0.0
    for u, v in expected:
        left, top = round(u) - 15, round(v) - 15
        window = picture[top : top + 31, left : left + 31].astype(float)
        row, column = np.mgrid[top : top + 31, left : left + 31]
        if not window.any():
            return np.inf
        centre = np.array([(window * column).sum(), (window * row).sum()]) / window.sum()
        worst = max(worst, float(np.linalg.norm(centre - (u, v))))
    return worst
