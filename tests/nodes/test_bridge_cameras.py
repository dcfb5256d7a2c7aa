# SPDX-License-Identifier: Apache-2.0
"""The node `mujoco_bridge` in process: images, CameraInfo, depth."""

from __future__ import annotations

import itertools
import math
import os
import signal

import cv2
import numpy as np
import pytest
from openarm_interfaces.msg import ObjectStateArray
from openarm_interfaces.srv import ResetWorld
from sensor_msgs.msg import CameraInfo, Image, JointState
from tf2_msgs.msg import TFMessage

from openarm_calibration.ros.publisher import PublisherNode
from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.ros.convert import (
    image_to_array,
    intrinsics_from_info,
    pose_to_matrix,
    stamp_to_ns,
    transform_to_matrix,
)
from openarm_common.ros.node import QOS_SENSOR, QOS_STATIC_TF, QOS_TF, reliable


def depth_to_metres(message: Image) -> np.ndarray:
    """Depth (height, width), m, NaN where invalid."""
    pixels = image_to_array(message)
    depth = pixels * np.float32(0.001) if message.encoding == "16UC1" else pixels.copy()
    depth[~(depth > 0.0)] = np.nan
    return depth


@pytest.mark.requirement("A-26", "A-28", "A-30")
def test_images_info_and_joint_states_belong_together(seeing) -> None:
    colour = seeing.collect(Image, "/overhead/color/image_raw", QOS_SENSOR)
    depth = seeing.collect(Image, "/overhead/depth/image_raw", QOS_SENSOR)
    infos = seeing.collect(CameraInfo, "/overhead/color/camera_info", QOS_SENSOR)
    depth_infos = seeing.collect(CameraInfo, "/overhead/depth/camera_info", QOS_SENSOR)
    seeing.ros.spin_until(
        lambda: len(colour) > 30 and len(depth) > 30 and infos and depth_infos, what="images and camera infos"
    )
    image, info = colour[-1], infos[-1]
    assert (image.width, image.height, image.encoding, image.header.frame_id) == (
        640,
        480,
        "rgb8",
        "overhead_color_optical_frame",
    )
    assert (depth[-1].encoding, depth[-1].header.frame_id) == ("16UC1", "overhead_color_optical_frame")
    assert info.k[4] == pytest.approx(240.0 / math.tan(math.radians(30.0)), abs=1e-6)
    assert info.k[0] == info.k[4]
    assert (info.k[2], info.k[5]) == (319.5, 239.5)
    assert list(info.k) == list(depth_infos[-1].k)
    # Best effort: a starved probe may miss the info of one image or another, but stamps that are near are equal.
    images, announced = (np.array([stamp_to_ns(m.header.stamp) for m in got]) for got in (colour + depth, infos))
    assert np.all(images % 10_000_000 == 0)  # of a tick
    for what, others in (("infos", infos), ("joint states", seeing.joints)):
        seeing.ros.spin_until(
            lambda others=others: (
                len({stamp_to_ns(m.header.stamp) for m in colour} & {stamp_to_ns(m.header.stamp) for m in others}) > 5
            ),
            what=f"{what} with the stamps of images",
        )
    distance = np.abs(images[:, None] - announced).min(axis=1)
    assert np.all((distance == 0) | (distance >= 30_000_000))
    pixels, z = image_to_array(image), depth_to_metres(depth[-1])
    assert pixels.std() > 10.0
    # The table top, seen by a camera whose mount is nominal: planar depth of a plane.
    T = load_cameras()["overhead"].T_parent_optical
    v, u = np.array([430, 430, 460]), np.array([320, 100, 550])
    rays = intrinsics_from_info(info)
    points = rays.deproject(np.stack([u, v], axis=-1), z[v, u].astype(float))
    heights = (points @ T[:3, :3].T + T[:3, 3])[:, 2]
    np.testing.assert_allclose(heights, 0.40, atol=1e-3)


@pytest.mark.parametrize(("camera", "keyframe"), [("overhead", "home"), ("wrist", "wrist_look")])
@pytest.mark.requirement("P-27", "A-30")
def test_a_cube_is_seen_where_camera_info_and_tf_say(bridge, camera: str, keyframe: str) -> None:
    """Its eight corners, from the world over /tf and /tf_static into the image, outline the red pixels."""
    bench = bridge()
    bench.ros.add(PublisherNode())
    assert bench.call(ResetWorld, "/sim/reset_world", keyframe=keyframe).success
    images = bench.collect(Image, f"/{camera}/color/image_raw", QOS_SENSOR)
    depths = bench.collect(Image, f"/{camera}/depth/image_raw", QOS_SENSOR)
    infos = bench.collect(CameraInfo, f"/{camera}/color/camera_info", QOS_SENSOR)
    truth = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)
    edges: dict[str, tuple[str, np.ndarray]] = {}

    def on_tf(message: TFMessage) -> None:
        for edge in message.transforms:
            edges[edge.child_frame_id] = edge.header.frame_id, transform_to_matrix(edge.transform)

    bench.ros.node.create_subscription(TFMessage, "/tf", on_tf, QOS_TF)
    bench.ros.node.create_subscription(TFMessage, "/tf_static", on_tf, QOS_STATIC_TF)
    bench.spin_sim(0.5)  # all is at rest, so that every stamp shows the same
    bench.fresh(images, 2), bench.fresh(depths, 1), bench.fresh(infos, 1), bench.fresh(truth, 1)

    T, frame = np.eye(4), images[-1].header.frame_id
    while frame in edges:
        frame, T_parent = edges[frame]
        T = T_parent @ T
    cube = next(o for o in truth[-1].objects if o.name == "red_cube")
    half = 0.5 * np.array([cube.size.x, cube.size.y, cube.size.z])
    corners = half * np.array(list(itertools.product((-1, 1), repeat=3)))
    in_camera = se3.apply(se3.inverse(T) @ pose_to_matrix(cube.pose), corners)
    outline = cv2.convexHull(intrinsics_from_info(infos[-1]).project(in_camera).astype(np.float32))
    moments = cv2.moments(outline)
    centre = np.array([moments["m10"], moments["m01"]]) / moments["m00"]

    pixels = image_to_array(images[-1]).astype(float)
    red = (pixels[..., 0] > 2.0 * pixels[..., 1]) & (pixels[..., 0] > 2.0 * pixels[..., 2])
    v, u = np.nonzero(red)
    assert red.sum() == pytest.approx(moments["m00"], rel=0.02)  # nothing hides it
    np.testing.assert_allclose([u.mean(), v.mean()], centre, atol=0.5)
    nearest = depth_to_metres(depths[-1])[red].min()
    assert nearest == pytest.approx(in_camera[:, 2].min(), abs=0.002)  # the nearest corner, to a pixel


@pytest.mark.requirement("P-24")
def test_cameras_without_subscribers_draw_nothing(seeing) -> None:
    seeing.spin_sim(0.5)
    assert not any(seeing.node._images.rendered.values())
    subscription = seeing.ros.node.create_subscription(Image, "/wrist/color/image_raw", lambda _m: None, QOS_SENSOR)
    seeing.ros.spin_until(lambda: seeing.node._images.rendered["wrist"] > 3, what="wrist images")
    assert seeing.node._images.rendered["overhead"] == 0
    seeing.ros.node.destroy_subscription(subscription)
    drawn, since_ns = 0, 0

    def rests() -> bool:
        """Whether nothing was drawn for half a second of simulated time."""
        nonlocal drawn, since_ns
        if seeing.node._images.rendered["wrist"] != drawn:
            drawn, since_ns = seeing.node._images.rendered["wrist"], seeing.t_ns
        return seeing.t_ns > since_ns + 500_000_000

    seeing.ros.spin_until(rests, what="the camera draws no more")


def test_camera_info_alone_needs_no_drawing(seeing) -> None:
    infos = seeing.collect(CameraInfo, "/wrist/depth/camera_info", QOS_SENSOR)
    seeing.ros.spin_until(lambda: len(infos) > 10, what="camera info")
    assert infos[-1].header.frame_id == "wrist_color_optical_frame"
    assert not any(seeing.node._images.rendered.values())


def test_images_come_again_after_their_process_was_killed(seeing) -> None:
    images = seeing.collect(Image, "/overhead/color/image_raw", QOS_SENSOR)
    seeing.ros.spin_until(lambda: len(images) > 3, what="images")
    states = seeing.collect(JointState, "/joint_states", reliable(2000))
    seeing.ros.spin_until(lambda: states, what="joint states")
    feed, before = seeing.node._images, seeing.t_ns
    os.kill(feed._process.pid, signal.SIGKILL)
    seeing.ros.spin_until(lambda: "code -9" in feed.fault, what="its death to be reported")
    n = len(images)
    seeing.ros.spin_until(lambda: len(images) > n + 3, what="images again")
    seeing.ros.spin_until(lambda: feed.fault == "", what="the fault to be over")
    stamps = [stamp_to_ns(m.header.stamp) for m in states if stamp_to_ns(m.header.stamp) > before]
    assert np.diff(stamps).max() < 300_000_000  # the robot went on meanwhile


def test_the_drawn_world_is_the_one_that_was_loaded(seeing) -> None:
    images = seeing.collect(Image, "/overhead/color/image_raw", QOS_SENSOR)
    seeing.ros.spin_until(lambda: len(images) > 3, what="images")

    def red() -> int:
        pixels = image_to_array(images[-1]).astype(int)
        return int(((pixels[..., 0] > 120) & (pixels[..., 1] < 60) & (pixels[..., 2] < 60)).sum())

    assert red() > 100
    assert seeing.call(ResetWorld, "/sim/reset_world", scene="empty").success
    seeing.ros.spin_until(lambda: red() == 0, what="an image without the cube")


@pytest.mark.requirement("A-47")
def test_depth_in_metres_by_parameter(bridge) -> None:
    bench = bridge(depth_encoding="32FC1", scene="empty")
    depth = bench.collect(Image, "/overhead/depth/image_raw", QOS_SENSOR)
    bench.ros.spin_until(lambda: depth, what="a depth image")
    assert depth[-1].encoding == "32FC1"
    assert np.nanmedian(depth_to_metres(depth[-1])) == pytest.approx(0.8, abs=0.2)


@pytest.mark.requirement("A-52")
def test_noisy_depth_by_parameter(bridge) -> None:
    bench = bridge(depth_noise__enabled=True, scene="empty")
    depth = bench.collect(Image, "/overhead/depth/image_raw", QOS_SENSOR)
    bench.ros.spin_until(lambda: len(depth) > 1, what="depth images")
    z = depth_to_metres(depth[-1])[400:440, 300:340]
    columns = z - np.nanmean(z, axis=1, keepdims=True)  # the table is level along a row
    fx = load_cameras()["overhead"].intrinsics.fx
    assert np.nanstd(columns) == pytest.approx(np.nanmean(z) ** 2 * 0.08 / (fx * 0.05), rel=0.2)
