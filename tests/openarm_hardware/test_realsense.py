# SPDX-License-Identifier: Apache-2.0
"""A RealSense before the library's software device: pictures, alignment, units, IMU, what is refused."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_hardware.cameras.config import RealsenseConfig
from openarm_hardware.cameras.realsense import RealSense, lens_of_librealsense, library
from openarm_hardware.cameras.source import CameraFrame
from openarm_perception.geometry.align import aligned
from tests.conftest import DEADLINE_S
from tests.openarm_hardware.realsense_device import COLOR_F, HEIGHT, RATE, WIDTH, SoftwareRealSense

try:
    library()
except OpenArmError as error:
    pytest.skip(error.message, allow_module_level=True)

pytestmark = pytest.mark.requirement("R-09")
COLOR = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)


def config(**values: object) -> RealsenseConfig:
    return RealsenseConfig.model_validate({"width": WIDTH, "height": HEIGHT, "rate": RATE, **values})


def camera_of(device: SoftwareRealSense, **values: object) -> RealSense:
    return RealSense(config(**values), lambda: [device.device])


def seen(camera: RealSense, show: Callable[[], None]) -> CameraFrame:
    """The first picture of what is shown."""
    end = time.monotonic() + DEADLINE_S
    while time.monotonic() < end:
        show()
        if (frame := camera.read(0.2)) is not None:
            return frame
    raise AssertionError("no picture")


def test_colour_depth_and_stamp_are_those_of_the_frames() -> None:
    device = SoftwareRealSense()
    camera = camera_of(device, serial="123456")
    assert "Software D435I 123456" in camera.open()
    depth = np.full((HEIGHT, WIDTH), 730, np.uint16)
    stamps = itertools.count(1_700_000_000_123_000_000, 33_000_000)
    frame = seen(camera, lambda: device.show(COLOR, depth, next(stamps)))
    np.testing.assert_array_equal(frame.color, COLOR)
    assert (frame.t_ns - 1_700_000_000_123_000_000) % 33_000_000 < 1_000
    assert (camera.intrinsics.fx, camera.intrinsics.width) == (COLOR_F, WIDTH)
    assert frame.depth is not None
    assert frame.depth[HEIGHT // 2, WIDTH // 2] == 730
    camera.close()


def test_depth_is_aligned_to_colour() -> None:
    device = SoftwareRealSense()
    camera = camera_of(device)
    camera.open()
    depth = np.full((HEIGHT, WIDTH), 500, np.uint16)
    depth[:, WIDTH // 2 + 8 :] = 900  # 8 pixels right of the middle by depth: 6 by colour
    frame = seen(camera, lambda: device.show(COLOR, depth))
    assert frame.depth is not None
    row = frame.depth[HEIGHT // 2]
    step = int(np.flatnonzero(row == 900)[0])
    assert step == pytest.approx(WIDTH / 2 + 6, abs=1)
    assert row[0] == 0, "the depth camera does not see so far to the left"
    camera.close()


@pytest.mark.requirement("M-02")
def test_depth_is_aligned_by_us_as_by_the_library() -> None:
    """`perceive` aligns depth of drivers that do not: with this device's optics, 55 mm from the colour camera."""
    place = (0.055, 0.004, 0.0)
    device = SoftwareRealSense(place=place)
    camera = camera_of(device)
    camera.open()
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    depth = (500 + 3 * row + 400 * ((np.abs(row - 20) > 8) | (np.abs(column - 25) > 9))).astype(np.uint16)
    frame = seen(camera, lambda: device.show(COLOR, depth))
    camera.close()
    assert frame.depth is not None
    lenses = [lens_of_librealsense(profile.get_intrinsics()).intrinsics for profile in (device.depth, device.color)]
    ours = aligned(depth * np.float32(0.001), lenses[0], se3.make(None, place), lenses[1])
    apart = np.abs(ours * 1000.0 - frame.depth) > 3.1  # they round to pixels differently; a row has 3 mm
    jumps = (np.abs(cv2.Laplacian(frame.depth.astype(np.float64), -1)) > 50.0).astype(np.uint8)
    assert apart.mean() < 0.05
    assert not (apart & (cv2.dilate(jumps, np.ones((3, 3))) == 0)).any()


def test_depth_in_other_units_is_in_millimetres() -> None:
    device = SoftwareRealSense(unit=0.0001)
    camera = camera_of(device)
    camera.open()
    frame = seen(camera, lambda: device.show(COLOR, np.full((HEIGHT, WIDTH), 7304, np.uint16)))
    assert frame.depth is not None
    assert frame.depth[HEIGHT // 2, WIDTH // 2] == 730
    camera.close()


def test_distortion_is_taken_out() -> None:
    device = SoftwareRealSense(coefficients=(0.3, 0.0, 0.0, 0.0, 0.0))
    camera = camera_of(device)
    camera.open()
    ramp = np.repeat(np.arange(WIDTH, dtype=np.uint8)[None, :, None] * 3, HEIGHT, axis=0).repeat(3, axis=2)
    frame = seen(camera, lambda: device.show(ramp, np.full((HEIGHT, WIDTH), 500, np.uint16)))
    row, optics = HEIGHT // 2, device.color.get_intrinsics()
    for column in (10, 32, 50):  # the ramp says at which column the lens shows what a pinhole shows here
        ray = [(column - optics.ppx) / optics.fx, (row - optics.ppy) / optics.fy, 1.0]
        expected, _ = device.rs.rs2_project_point_to_pixel(optics, ray)
        assert frame.color[row, column, 0] / 3.0 == pytest.approx(expected, abs=0.2)
    assert abs(int(frame.color[row, 10, 0]) - int(ramp[row, 10, 0])) > 1
    camera.close()


def test_the_imu_is_read_with_the_pictures() -> None:
    device = SoftwareRealSense()
    camera = camera_of(device)
    camera.open()
    imu = []
    depth = np.full((HEIGHT, WIDTH), 500, np.uint16)

    def show() -> None:
        device.turn((0.1, 0.2, 0.3), (0.0, -9.8, 0.1))
        device.show(COLOR, depth)

    end = time.monotonic() + DEADLINE_S
    while not imu and time.monotonic() < end:
        imu += seen(camera, show).imu
    np.testing.assert_allclose(imu[0].gyro, (0.1, 0.2, 0.3), atol=1e-6)
    np.testing.assert_allclose(imu[0].acceleration, (0.0, -9.8, 0.1), atol=1e-6)
    camera.close()


@pytest.mark.parametrize(
    ("values", "code", "text"),
    [
        ({"serial": "999"}, Code.NOT_READY, "999.*there are: Software D435I 123456"),
        ({"width": 640, "height": 480}, Code.CONFIG_INVALID, f"it gives {WIDTH}x{HEIGHT} at {RATE} Hz"),
    ],
)
def test_what_is_not_there_is_refused_with_what_is(values: dict[str, object], code: Code, text: str) -> None:
    device = SoftwareRealSense()
    with pytest.raises(OpenArmError, match=text) as refused:
        camera_of(device, **values).open()
    assert refused.value.code is code


def test_without_a_camera_it_says_so() -> None:
    with pytest.raises(OpenArmError, match="no RealSense is plugged in"):
        RealSense(config(), list).open()
