# SPDX-License-Identifier: Apache-2.0
"""The distortion of lenses on topics: what camera nodes publish, and what is made of topics of others, to 0.05 px."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from openarm_bringup.ros.camera_frame import frame_of_graph
from openarm_common.camera.cameras import Intrinsics, load_cameras
from openarm_common.ros.convert import info_from_intrinsics
from openarm_common.ros.images import array_to_image, image_to_array, lens_from_info
from openarm_common.ros.node import QOS_SENSOR
from openarm_hardware.cameras.config import RealsenseConfig
from openarm_hardware.cameras.realsense import RealSense
from openarm_hardware.ros.camera_node import CameraNode
from openarm_perception.ros.cloud_node import CloudNode
from openarm_perception.ros.frames import CameraChoice
from tests.lens_grid import LIBRARY, MODELS, RAYS, SIZE, STRAIGHT, K, drawn, librealsense, off, shown, shown_by_library
from tests.openarm_hardware.realsense_device import RATE, SoftwareRealSense

pytestmark = pytest.mark.requirement("M-01")

MOST = 0.05
CAMERA = load_cameras()["overhead"]
WALL = np.full(SIZE[::-1], 700, np.uint16)


def grid(pixels: np.ndarray) -> np.ndarray:
    return np.repeat(drawn(pixels)[..., None], 3, axis=2)


@pytest.mark.parametrize("model", LIBRARY)
def test_a_realsense_publishes_a_grid_without_the_distortion_of_its_lens(ros, model: str) -> None:
    _, optics = librealsense(model)
    rgb, device = grid(shown_by_library(model)), SoftwareRealSense(optics=optics)
    assert (off(rgb[..., 0]) > 1.0) == (model != "none")
    images = ros.hear(Image, "/overhead/color/image_raw", QOS_SENSOR)
    infos = ros.hear(CameraInfo, "/overhead/color/camera_info", QOS_SENSOR)
    node = partial(
        CameraNode, "realsense_camera", RealsenseConfig, lambda config: RealSense(config, lambda: [device.device])
    )
    ros.start(node, camera="overhead", width=SIZE[0], height=SIZE[1], rate=float(RATE))

    def published() -> bool:
        device.show(rgb, WALL)
        return bool(images and infos)

    ros.spin_until(published, what="a picture and its CameraInfo")
    assert not any(infos[0].d)
    said = lens_from_info(infos[0]).intrinsics
    assert said.matrix == pytest.approx(K, abs=1e-3)
    points = np.column_stack([RAYS, np.ones(len(RAYS))])
    assert off(image_to_array(images[0])[..., 0], said.project(points)) < MOST


@pytest.mark.parametrize(("model", "end"), [*((model, "image_raw") for model in MODELS), ("plumb_bob", "image_rect")])
def test_topics_of_a_lens_give_its_grid_to_a_frame_and_to_a_cloud(ros, model: str, end: str) -> None:
    """The frame that `perceive` takes, and the colours of the node `cloud`; a rectified image is left as it is."""
    rgb = grid(STRAIGHT if end == "image_rect" else shown(model))
    topics = [f"/overhead/color/{end}", f"/overhead/depth/{end}"]
    topics += [f"/overhead/{kind}/camera_info" for kind in ("color", "depth")]
    senders = [ros.node.create_publisher(kind, topic, QOS_SENSOR)
               for kind, topic in zip((Image, Image, CameraInfo, CameraInfo), topics, strict=True)]  # fmt: skip
    ros.start(
        CloudNode, cameras=["overhead"], color=True, color_topic=topics[0], depth_topic=topics[1], info_topic=topics[3]
    )
    clouds = ros.hear(PointCloud2, "/overhead/depth/points", QOS_SENSOR)
    t_ns = 0

    def send() -> None:
        nonlocal t_ns
        t_ns += 33_000_000
        info = info_from_intrinsics(Intrinsics(*SIZE, K[0, 0], K[1, 1], K[0, 2], K[1, 2]), CAMERA.optical_frame, t_ns)
        info.distortion_model, info.d = model, list(MODELS[model])
        color, depth = (
            array_to_image(pixels, encoding, CAMERA.optical_frame, t_ns)
            for pixels, encoding in ((rgb, "rgb8"), (WALL, "16UC1"))
        )
        for sender, message in zip(senders, (color, depth, info, info), strict=True):
            sender.publish(message)

    with ThreadPoolExecutor(1) as pool:
        frame = pool.submit(frame_of_graph, CameraChoice("overhead"), 20.0)
        ros.send_until(send, 0.25, lambda: frame.done() and clouds, "a frame and a cloud")
    seen = frame.result().rgb
    assert seen is not None
    assert off(seen[..., 0]) < MOST
    cloud = np.frombuffer(clouds[0].data, np.uint32).reshape(*SIZE[::-1], 4)[..., 3]
    assert off((cloud >> 16).astype(np.uint8)) < MOST
