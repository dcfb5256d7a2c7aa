# SPDX-License-Identifier: Apache-2.0
"""Nodes of cameras: topics of the simulated ones, and what /diagnostics says while a camera is gone."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("openarm_interfaces")

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CameraInfo, Image, Imu

from openarm_common.errors import OpenArmError
from openarm_common.ros.node import QOS_COMMAND, QOS_SENSOR
from openarm_hardware.cameras.config import RealsenseConfig
from openarm_hardware.cameras.realsense import RealSense, library
from openarm_hardware.ros import usb_camera
from openarm_hardware.ros.camera_node import CameraNode
from tests.openarm_hardware import realsense_device
from tests.openarm_hardware.realsense_device import SoftwareRealSense
from tests.openarm_hardware.test_cameras import HEIGHT, WIDTH, calibration, film

pytestmark = pytest.mark.requirement("R-09", "P-27")


def messages_of(reports: list[DiagnosticArray], node: str) -> list[str]:
    return [status.message for report in reports for status in report.status if status.name.startswith(node)]


def test_a_usb_camera_has_the_topics_of_a_camera_without_depth_and_is_opened_again(ros: Any, tmp_path: Path) -> None:
    calibration(tmp_path)
    values = {"width": WIDTH, "height": HEIGHT, "calibration": str(tmp_path / "camera.yaml"), "camera": "desk"}
    images = ros.hear(Image, "/desk/color/image_raw", QOS_SENSOR)
    infos = ros.hear(CameraInfo, "/desk/color/camera_info", QOS_SENSOR)
    reports = ros.hear(DiagnosticArray, "/diagnostics", QOS_COMMAND)
    ros.start(usb_camera.make, **values, device=str(tmp_path / "film.avi"))
    ros.spin_until(lambda: any("can't open" in text for text in messages_of(reports, "usb_camera")), what="a refusal")
    film(tmp_path, 200)  # now it is plugged in
    ros.spin_until(lambda: any(i.header in [info.header for info in infos] for i in images), what="a picture, its info")
    assert (images[0].encoding, images[0].width, images[0].height) == ("rgb8", WIDTH, HEIGHT)
    assert images[0].header.frame_id == infos[0].header.frame_id == "desk_color_optical_frame"
    assert infos[0].k[0] == 90.0
    assert not any(infos[0].d)


@pytest.mark.long
def test_a_realsense_has_the_topics_of_the_simulated_cameras_and_is_opened_again_when_it_is_lost(ros: Any) -> None:
    try:
        library()
    except OpenArmError as error:
        pytest.skip(error.message)
    import numpy as np

    width, height = realsense_device.WIDTH, realsense_device.HEIGHT
    plugged: list[SoftwareRealSense] = []
    got = {
        topic: ros.hear(kind, f"/overhead/{topic}", QOS_SENSOR)
        for kind, topic in (
            (Image, "color/image_raw"),
            (CameraInfo, "color/camera_info"),
            (Image, "depth/image_raw"),
            (CameraInfo, "depth/camera_info"),
            (Imu, "imu"),
        )
    }
    reports = ros.hear(DiagnosticArray, "/diagnostics", QOS_COMMAND)
    values = {"camera": "overhead", "serial": "42", "width": width, "height": height, "rate": 30.0}

    def opened(config: RealsenseConfig) -> RealSense:
        return RealSense(config, lambda: [one.device for one in plugged])

    ros.start(partial(CameraNode, "realsense_camera", RealsenseConfig, opened, silent_s=0.5), **values)
    color, depth = np.full((height, width, 3), 90, np.uint8), np.full((height, width), 640, np.uint16)

    def streams(device: SoftwareRealSense) -> bool:
        device.turn((0.0, 0.1, 0.0), (0.0, 0.0, 9.8))
        device.show(color, depth)
        return all(got.values())

    ros.spin_until(
        lambda: any("no RealSense is plugged in" in text for text in messages_of(reports, "realsense_camera")),
        what="a refusal",
    )
    for _ in range(2):  # plugged in, lost, and plugged in again
        plugged[:] = [SoftwareRealSense("42")]
        ros.spin_until(lambda: streams(plugged[0]), what="pictures")
        image, info = got["depth/image_raw"][0], got["depth/camera_info"][0]
        assert image.encoding == "16UC1"
        assert image.header.frame_id == info.header.frame_id == "overhead_color_optical_frame"
        assert image.header.stamp == got["color/image_raw"][0].header.stamp
        assert info.k.tolist() == got["color/camera_info"][0].k.tolist()
        plugged.clear()
        lost = len(reports)
        ros.spin_until(
            lambda n=lost: any(
                "gave no picture" in text or "no RealSense" in text
                for text in messages_of(reports[n:], "realsense_camera")
            ),
            what="a fault",
        )
        for messages in got.values():
            messages.clear()
