# SPDX-License-Identifier: Apache-2.0
"""`openarm perceive` on the topics of a RealSense, of a graph and in a bag."""

from __future__ import annotations

from threading import Thread

import cv2
import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image

from openarm_bringup.bags.bag import BagWriter
from openarm_bringup.bags.ros.listener import from_profile
from openarm_bringup.commands.perceive import perceive
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code
from openarm_common.ros.convert import array_to_image, info_from_intrinsics
from openarm_common.ros.node import QOS_SENSOR
from openarm_perception.geometry.depth import DepthLimits
from openarm_perception.ros.frames import FrameBuilder, camera_topics, frame_of
from tests.refusals import refused

pytestmark = pytest.mark.requirement("R-19")

LENS = Intrinsics(160, 120, 140.0, 140.0, 79.5, 59.5)
#: Camera 0.7 m over the table, looking straight down; a red box of 80 x 60 x 50 mm.
DISTANCE, HALF, HEIGHT = 0.7, (0.04, 0.03), 0.05
TOPICS = tuple(f"/camera/camera/{end}" for end in (
    "color/image_raw", "aligned_depth_to_color/image_raw", "color/camera_info"))  # fmt: skip


def messages(t_ns: int, scale: float = 0.001) -> tuple[Image, Image, CameraInfo]:
    v, u = np.mgrid[:120, :160]
    x, y = (u - LENS.cx) / LENS.fx * (DISTANCE - HEIGHT), (v - LENS.cy) / LENS.fy * (DISTANCE - HEIGHT)
    on = (np.abs(x) < HALF[0]) & (np.abs(y) < HALF[1])
    rgb = np.full((120, 160, 3), 180, np.uint8)
    rgb[on] = (210, 20, 20)
    counts = np.round(np.where(on, DISTANCE - HEIGHT, DISTANCE) / scale).astype(np.uint16)
    frame = "camera_color_optical_frame"
    return (
        array_to_image(rgb, "rgb8", frame, t_ns),
        array_to_image(counts, "16UC1", frame, t_ns),
        info_from_intrinsics(LENS, frame, t_ns),
    )


def check(data: dict[str, object]) -> None:
    (one,) = data["clusters"]  # type: ignore[misc]
    assert (one["shape"], one["color"]) == ("box", "red")
    assert one["size"] == pytest.approx([0.06, 0.08, 0.05], abs=0.005)  # a pixel


def test_the_topics_of_a_running_camera_are_perceived(ros, tmp_path):
    kinds = (Image, Image, CameraInfo)
    senders = [ros.node.create_publisher(kind, topic, 5) for kind, topic in zip(kinds, TOPICS, strict=True)]
    found = []
    thread = Thread(target=lambda: found.append(perceive(out=tmp_path / "out", timeout=30.0)))
    thread.start()
    sent = 0

    def ended() -> bool:
        nonlocal sent
        sent += 1
        for sender, message in zip(senders, messages(sent * 33_000_000), strict=True):
            sender.publish(message)
        return not thread.is_alive()

    ros.spin_until(ended, what="the command")
    thread.join()
    (outcome,) = found
    check(outcome.data)
    assert (tmp_path / "out" / "index.html").exists()


def test_a_graph_without_a_camera_is_answered_with_what_is_expected(ros):
    assert refused("aligned_depth_to_color", perceive, timeout=0.2).code is Code.NOTHING_DETECTED


@pytest.fixture
def bag(tmp_path):
    path = tmp_path / "bag"
    with BagWriter(path, {}) as writer:
        for topic, kind in zip(TOPICS, ("Image", "Image", "CameraInfo"), strict=True):
            writer.add_topic(topic, f"sensor_msgs/msg/{kind}", from_profile(QOS_SENSOR))
        color, _, info = messages(1_000_000_000)
        late = messages(1_040_000_000)
        for topic, t_s, message in (
            (TOPICS[2], 0, info), (TOPICS[0], 1, color), (TOPICS[1], 2, late[1]), (TOPICS[0], 3, late[0]),
        ):  # fmt: skip
            writer.write(topic, t_s * 1_000_000_000, serialize_message(message))
    return path


def test_a_bag_gives_the_first_frame_whose_images_are_of_the_same_time(bag):
    check(perceive(bag).data)
    check(perceive(next(bag.glob("*.mcap")), camera="camera/camera").data)
    refused(r"from 2\.5 s on: nothing on /camera/camera/aligned_depth", perceive, bag, start=2.5)
    refused(r"no depth camera 'wrist'.*cameras: /camera/camera", perceive, bag, camera="wrist")


def test_cameras_are_chosen_by_their_namespace():
    two = [*TOPICS, *(f"/overhead/{end}" for end in ("color/image_raw", "color/camera_info", "depth/image_raw"))]
    assert camera_topics(two, "overhead").depth == "/overhead/depth/image_raw"
    assert camera_topics(two, "/camera/camera") == TOPICS
    refused("several cameras: /camera/camera, /overhead", camera_topics, two)


def test_counts_are_scaled_and_metres_are_not():
    color, depth, info = messages(0, scale=0.0001)
    near = frame_of(color, depth, info, DepthLimits(), 0.0001)
    assert np.nanmax(near.points[..., 2]) == pytest.approx(DISTANCE, abs=1e-4)
    metres = array_to_image(np.nan_to_num(near.points[..., 2]), "32FC1", "c", 0)
    again = frame_of(color, metres, info, DepthLimits(), 0.0001)
    np.testing.assert_allclose(again.points[..., 2], near.points[..., 2])


def test_the_distortion_of_a_lens_is_removed():
    color, depth, info = messages(0)
    d = np.array([-0.05, 0.06, 0.0005, -0.0003, -0.02])
    matrix = np.array([[LENS.fx, 0.0, LENS.cx], [0.0, LENS.fy, LENS.cy], [0.0, 0.0, 1.0]])
    v, u = np.mgrid[:120, :160].astype(np.float32)
    # what a lens with distortion shows at a pixel is what a pinhole shows elsewhere
    ideal = cv2.undistortPoints(np.stack([u, v], axis=-1).reshape(-1, 1, 2), matrix, d, P=matrix).reshape(120, 160, 2)
    z = np.frombuffer(depth.data, np.uint16).reshape(120, 160)
    bent = cv2.remap(z, ideal[..., 0], ideal[..., 1], cv2.INTER_NEAREST)
    info.d, info.distortion_model = d.tolist(), "plumb_bob"
    points = frame_of(color, array_to_image(bent, "16UC1", "c", 0), info, DepthLimits()).points
    straight = frame_of(*messages(0), DepthLimits()).points
    wrong = np.isfinite(points[..., 2]) & (np.abs(points[..., 2] - straight[..., 2]) > 0.01)
    assert np.count_nonzero(wrong) < 40  # at the outline of the box, a pixel wide
    info.distortion_model = "equidistant"
    refused("'equidistant' with 5 coefficients; expected plumb_bob", frame_of, color, depth, info, DepthLimits())


def test_what_does_not_belong_together_is_refused():
    color, depth, info = messages(0)
    info.width = 320
    refused("160x120 pixels, expected 320x120", frame_of, color, depth, info, DepthLimits())
    info.k = np.zeros(9)
    refused("is not calibrated", frame_of, color, depth, info, DepthLimits())
    builder = FrameBuilder(camera_topics(TOPICS), DepthLimits())
    assert builder.take(TOPICS[0], color) is None
    assert builder.missing() == f"nothing on {TOPICS[1]}, {TOPICS[2]}"


def test_colour_and_depth_of_different_times_make_no_frame():
    topics = camera_topics(TOPICS)
    (color, _, info), (_, late, _), (_, near, _) = messages(0), messages(100_000_000), messages(10_000_000)
    builder = FrameBuilder(topics, DepthLimits())
    for topic, message in ((topics.color, color), (topics.info, info), (topics.depth, late)):
        assert builder.take(topic, message) is None
    assert builder.missing() == "no colour and depth image of the same time"
    assert builder.take(topics.depth, near) is not None
