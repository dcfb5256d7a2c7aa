# SPDX-License-Identifier: Apache-2.0
"""A camera without depth by OpenCV: V4L2 devices, and whatever else OpenCV opens."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from pydantic import Field

from openarm_common.camera.cameras import Intrinsics
from openarm_common.config import Config, load_yaml, validate
from openarm_common.errors import Code, OpenArmError
from openarm_hardware.cameras.config import UsbConfig
from openarm_hardware.cameras.rectify import Rectifier
from openarm_hardware.cameras.source import CameraFrame


class _Matrix(Config):
    rows: int
    cols: int
    data: tuple[float, ...]


class _CameraInfo(Config):
    image_width: Annotated[int, Field(gt=0)]
    image_height: Annotated[int, Field(gt=0)]
    camera_name: str = ""
    camera_matrix: _Matrix
    distortion_model: str = "plumb_bob"
    distortion_coefficients: _Matrix
    rectification_matrix: _Matrix | None = None
    projection_matrix: _Matrix | None = None


def read_camera_info(path: Path) -> tuple[Intrinsics, Rectifier]:
    """Read intrinsics from the file that `camera_calibration` and `camera_info_manager` write.

    Raises:
        OpenArmError: CONFIG_INVALID, naming file and key.
    """
    info = validate(_CameraInfo, load_yaml(path), str(path))
    if info.distortion_model not in ("plumb_bob", "rational_polynomial"):
        text = f"{path}:distortion_model: {info.distortion_model!r}, expected plumb_bob or rational_polynomial"
        raise OpenArmError(Code.CONFIG_INVALID, text)
    if len(k := info.camera_matrix.data) != 9:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path}:camera_matrix.data: {len(k)} numbers, expected 9")
    intrinsics = Intrinsics(info.image_width, info.image_height, k[0], k[4], k[2], k[5])
    if fault := intrinsics.fault():
        raise OpenArmError(Code.CONFIG_INVALID, f"{path}:camera_matrix: {fault}")
    return intrinsics, Rectifier(intrinsics, np.array(info.distortion_coefficients.data))


class UsbCamera:
    """See `CameraSource`.

    Args:
        config: Which, and how.

    Raises:
        OpenArmError: CONFIG_INVALID, without a calibration that fits: pixels alone say nothing of directions.
    """

    has_depth = False

    def __init__(self, config: UsbConfig) -> None:
        if not config.calibration:
            text = "the parameter calibration is empty; it names the file of the camera's intrinsics (docs/hardware.md)"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        self._config, path = config, Path(config.calibration)
        self._intrinsics, self._rectifier = read_camera_info(path)
        got, asked = (self._intrinsics.width, self._intrinsics.height), (config.width, config.height)
        if got != asked:
            text = f"{path} is of pictures of {got[0]}x{got[1]}, the camera is asked for {asked[0]}x{asked[1]}"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        self._capture: Any = None

    @property
    def intrinsics(self) -> Intrinsics:
        """See `CameraSource.intrinsics`."""
        return self._intrinsics

    def open(self) -> str:
        """See `CameraSource.open`."""
        config = self._config
        numbered = config.device.isdecimal()
        live = numbered or config.device.startswith("/dev/")
        device = f"/dev/video{config.device}" if numbered else config.device
        self._capture = cv2.VideoCapture(device, cv2.CAP_V4L2 if live else cv2.CAP_ANY)
        if not self._capture.isOpened():
            there = ", ".join(sorted(str(path) for path in Path("/dev").glob("video*"))) or "none"
            why = "is it plugged in, may this user read it (group video), has another program opened it?"
            raise OpenArmError(Code.NOT_READY, f"can't open the camera {device}; there are: {there}; {why}")
        if live:
            self._capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, config.width)
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, config.height)
            self._capture.set(cv2.CAP_PROP_FPS, config.rate)
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        got = tuple(int(self._capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if got != (config.width, config.height):
            text = f"{device} gives pictures of {got[0]}x{got[1]}, expected {config.width}x{config.height}"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        return device

    def read(self, seconds: float) -> CameraFrame | None:
        """See `CameraSource.read`; OpenCV waits for as long as its backend does."""
        if not self._capture.grab():
            raise OpenArmError(Code.NOT_READY, f"the camera {self._config.device} gives no picture; was it unplugged?")
        t_ns = time.time_ns()
        good, picture = self._capture.retrieve()
        if not good:
            return None
        return CameraFrame(t_ns, self._rectifier.color(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)))  # pyright: ignore

    def close(self) -> None:
        """See `CameraSource.close`."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None
