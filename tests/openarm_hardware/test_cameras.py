# SPDX-License-Identifier: Apache-2.0
"""Cameras by OpenCV, their distortion, and the thread that opens a camera again."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_hardware.cameras import feed as feeds
from openarm_hardware.cameras.config import UsbConfig
from openarm_hardware.cameras.feed import CameraFeed
from openarm_hardware.cameras.source import CameraFrame
from openarm_hardware.cameras.usb import UsbCamera

pytestmark = pytest.mark.requirement("R-09")
WIDTH, HEIGHT = 96, 64
OPTICS = Intrinsics(WIDTH, HEIGHT, 90.0, 91.0, 47.0, 31.0)


def calibration(folder: Path, distortion: tuple[float, ...] = (0.0,) * 5, **changes: object) -> Path:
    """A file as camera_calibration writes it."""
    info = {
        "image_width": WIDTH,
        "image_height": HEIGHT,
        "camera_name": "desk",
        "camera_matrix": {"rows": 3, "cols": 3, "data": OPTICS.matrix.ravel().tolist()},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": list(distortion)},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": [0.0] * 12},
    }
    path = folder / "camera.yaml"
    path.write_text(yaml.safe_dump({**info, **changes}), encoding="utf-8")
    return path


def film(folder: Path, frames: int = 3) -> Path:
    """A film whose pictures are blue on the left and red on the right."""
    path = folder / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (WIDTH, HEIGHT))
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[:, : WIDTH // 2, 0] = picture[:, WIDTH // 2 :, 2] = 250  # BGR
    for _ in range(frames):
        writer.write(picture)
    writer.release()
    return path


def usb(folder: Path, **values: object) -> UsbConfig:
    return UsbConfig.model_validate(
        {"width": WIDTH, "height": HEIGHT, "calibration": str(folder / "camera.yaml"), **values}
    )


def test_a_camera_is_read_in_rgb_with_the_optics_of_its_file_until_it_is_gone(tmp_path: Path) -> None:
    calibration(tmp_path)
    camera = UsbCamera(usb(tmp_path, device=str(film(tmp_path))))
    camera.open()
    assert camera.intrinsics == OPTICS
    frame = camera.read(1.0)
    assert frame is not None
    assert frame.depth is None
    assert frame.color[30, 10, 2] > 200 > 60 > frame.color[30, 10, 0]
    assert frame.color[30, 80, 0] > 200 > 60 > frame.color[30, 80, 2]
    camera.read(1.0)
    camera.read(1.0)
    with pytest.raises(OpenArmError, match="was it unplugged"):
        camera.read(1.0)
    camera.close()


@pytest.mark.parametrize(
    ("changes", "values", "text"),
    [
        ({}, {"calibration": ""}, "calibration is empty"),
        ({}, {"width": 640}, "is of images of 96x64 pixels; expected 640x64"),
        ({"distortion_model": "ftheta", "distortion": (0.1, 0.0, 0.0, 0.0, 0.0)}, {}, "distortion model 'ftheta'"),
        ({"camera_matrix": {"rows": 1, "cols": 1, "data": [1.0]}}, {}, "the matrix has 1 numbers"),
        ({"camera_matrix": {"rows": 3, "cols": 3, "data": [0.0] * 9}}, {}, "is not calibrated"),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused(
    tmp_path: Path, changes: dict[str, object], values: dict[str, object], text: str
) -> None:
    calibration(tmp_path, **changes)
    with pytest.raises(OpenArmError, match=text) as refused:
        UsbCamera(usb(tmp_path, **values))
    assert refused.value.code in (Code.CONFIG_INVALID, Code.BAD_IMAGE)


def test_a_camera_that_is_not_there_is_refused_with_what_to_look_at(tmp_path: Path) -> None:
    calibration(tmp_path)
    with pytest.raises(OpenArmError, match=r"can't open the camera /dev/video77.*group video"):
        UsbCamera(usb(tmp_path, device="77")).open()


class Scripted:
    """A camera that fails as a list says: at `open`, or after some pictures, or falls silent."""

    has_depth = False
    intrinsics = OPTICS

    def __init__(self, script: list[str]) -> None:
        self.script, self.left, self.closed = script, 0, 0
        self.now = ""

    def open(self) -> str:
        self.now = self.script.pop(0) if self.script else "good"
        if self.now == "absent":
            raise OpenArmError(Code.NOT_READY, "no camera is plugged in")
        self.left = 2
        return "scripted"

    def read(self, seconds: float) -> CameraFrame | None:
        if self.now == "good" or self.left > 0:
            self.left -= 1
            return CameraFrame(1, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        if self.now == "broken":
            raise RuntimeError("of a library")
        if self.now == "silent":
            return None
        raise OpenArmError(Code.NOT_READY, "unplugged")

    def close(self) -> None:
        self.closed += 1


def test_a_camera_that_is_absent_unplugged_or_silent_is_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feeds, "_RETRY_S", 0.01)
    came, enough = [], threading.Event()
    camera = Scripted(["absent", "broken", "unplugged", "silent"])
    faults = set[str]()

    def take(frame: CameraFrame) -> None:
        came.append(frame)
        faults.add(feed.fault)
        if feed.opened == 4 and len(came) > 8:
            enough.set()

    feed = CameraFeed(camera, take, silent_s=0.5)
    feed.start()
    try:
        assert enough.wait(60.0)
        assert feed.device == "scripted"
        assert feed.fault == ""
        assert faults == {""}
    finally:
        feed.close()
    assert camera.closed == 5
    assert not feed.device
