# SPDX-License-Identifier: Apache-2.0
"""A camera without depth by OpenCV: V4L2 devices, and whatever else OpenCV opens."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.lens_files import read_lens
from openarm_common.errors import Code, OpenArmError
from openarm_hardware.cameras.config import UsbConfig
from openarm_hardware.cameras.source import CameraFrame


class UsbCamera:
    """See `CameraSource`.

    Args:
        config: Camera and its streams.

    Raises:
        OpenArmError: CONFIG_INVALID, without a calibration that fits: pixels alone say nothing of directions.
    """

    has_depth = False

    def __init__(self, config: UsbConfig) -> None:
        if not config.calibration:
            text = "the parameter calibration is empty; it names the file of the camera's intrinsics (docs/hardware.md)"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        self._config, path = config, Path(config.calibration)
        self._lens = read_lens(path, (config.width, config.height))
        self._capture: Any = None

    @property
    def intrinsics(self) -> Intrinsics:
        """See `CameraSource.intrinsics`."""
        return self._lens.intrinsics

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
        return CameraFrame(t_ns, self._lens.rectified(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)))  # pyright: ignore

    def close(self) -> None:
        """See `CameraSource.close`."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None
