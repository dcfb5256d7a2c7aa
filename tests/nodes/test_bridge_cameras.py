# SPDX-License-Identifier: Apache-2.0
"""The node `mujoco_bridge` in process, with what it draws: topics, images, CameraInfo, depth, faults of cameras.

One bridge, whose world each test leaves as it was.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from openarm_interfaces.msg import ObjectStateArray
from openarm_interfaces.srv import MoveObject
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, JointState
from tf2_msgs.msg import TFMessage

from openarm_calibration.ros.publisher import PublisherNode
from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.config import Config
from openarm_common.ros.convert import pose_to_matrix, stamp_to_ns, transform_to_matrix
from openarm_common.ros.images import image_to_array, lens_from_info
from openarm_common.ros.node import QOS_COMMAND, QOS_SENSOR, QOS_STATIC_TF, QOS_TF, BaseNode, reliable
from openarm_sim_bridge.cameras import camera_feed


def stamps(messages: list) -> np.ndarray:
    return np.array([stamp_to_ns(m.header.stamp) for m in messages])


def depth_to_metres(message: Image) -> np.ndarray:
    """Depth (height, width), m, NaN where invalid."""
    pixels = image_to_array(message)
    depth = pixels * np.float32(0.001) if message.encoding == "16UC1" else pixels.copy()
    depth[~(depth > 0.0)] = np.nan
    return depth


@pytest.mark.long
@pytest.mark.requirement("A-26", "A-28", "A-30", "A-58")
def test_images_info_and_joint_states_belong_together(seeing) -> None:
    colour = seeing.collect(Image, "/overhead/color/image_raw", QOS_SENSOR)
    depth = seeing.collect(Image, "/overhead/depth/image_raw", QOS_SENSOR)
    infos = seeing.collect(CameraInfo, "/overhead/color/camera_info", QOS_SENSOR)
    depth_infos = seeing.collect(CameraInfo, "/overhead/depth/camera_info", QOS_SENSOR)
    seeing.ros.spin_until(
        lambda: len(colour) > 5 and len(depth) > 5 and len(infos) > 20 and depth_infos, what="images and camera infos"
    )
    image, info = colour[-1], infos[-1]
    assert (image.width, image.height, image.encoding) == (640, 480, "rgb8")
    assert image.header.frame_id == "overhead_color_optical_frame"
    assert (depth[-1].encoding, depth[-1].header.frame_id) == ("16UC1", "overhead_color_optical_frame")
    assert info.k[4] == pytest.approx(240.0 / math.tan(math.radians(30.0)), abs=1e-6)
    assert info.k[0] == info.k[4]
    assert (info.k[2], info.k[5]) == (319.5, 239.5)
    assert list(info.k) == list(depth_infos[-1].k)
    # Best effort: a starved probe may miss the info of one image or another, but stamps that are near are equal.
    images, announced = stamps(colour + depth), stamps(infos)
    assert np.all(images % 10_000_000 == 0)  # of a tick
    for what, others in (("infos", infos), ("joint states", seeing.joints)):
        seeing.ros.spin_until(
            lambda others=others: len(set(stamps(colour)) & set(stamps(others))) > 5,
            what=f"{what} with the stamps of images",
        )
    distance = np.abs(images[:, None] - announced).min(axis=1)
    assert np.all((distance == 0) | (distance >= 30_000_000))
    between = np.diff(np.unique(announced))  # a starved probe misses some, and a slow machine draws fewer
    assert between.min() >= 30_000_000  # of ticks of 10 ms, 30 a second
    pixels, z = image_to_array(image), depth_to_metres(depth[-1])
    assert pixels.std() > 10.0
    # The table top, seen by a camera whose mount is nominal: planar depth of a plane.
    T = load_cameras()["overhead"].T_parent_optical
    v, u = np.array([430, 430, 460]), np.array([320, 100, 550])
    rays = lens_from_info(info).intrinsics
    points = rays.deproject(np.stack([u, v], axis=-1), z[v, u].astype(float))
    heights = (points @ T[:3, :3].T + T[:3, 3])[:, 2]
    np.testing.assert_allclose(heights, 0.40, atol=1e-3)


@pytest.mark.requirement("P-27", "A-30")
def test_a_cube_is_seen_by_the_wrist_camera_where_camera_info_and_tf_say(seeing) -> None:
    """Its eight corners, from the world over /tf and /tf_static into the image, outline the red pixels."""
    bench = seeing
    bench.ros.add(PublisherNode())
    bench.reset(keyframe="wrist_look")
    images = bench.collect(Image, "/wrist/color/image_raw", QOS_SENSOR)
    depths = bench.collect(Image, "/wrist/depth/image_raw", QOS_SENSOR)
    infos = bench.collect(CameraInfo, "/wrist/color/camera_info", QOS_SENSOR)
    truth = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)
    edges: dict[str, tuple[str, np.ndarray]] = {}

    def on_tf(message: TFMessage) -> None:
        for edge in message.transforms:
            edges[edge.child_frame_id] = edge.header.frame_id, transform_to_matrix(edge.transform)

    bench.ros.node.create_subscription(TFMessage, "/tf", on_tf, QOS_TF)
    bench.ros.node.create_subscription(TFMessage, "/tf_static", on_tf, QOS_STATIC_TF)
    bench.spin_sim(0.3)  # all is at rest, so that every stamp shows the same
    bench.fresh(images, 2), bench.fresh(depths, 1), bench.fresh(infos, 1), bench.fresh(truth, 1)

    T, frame = np.eye(4), images[-1].header.frame_id
    while frame in edges:
        frame, T_parent = edges[frame]
        T = T_parent @ T
    cube = next(o for o in truth[-1].objects if o.name == "red_cube")
    half = 0.5 * np.array([cube.size.x, cube.size.y, cube.size.z])
    corners = half * np.array(list(itertools.product((-1, 1), repeat=3)))
    in_camera = se3.apply(se3.inverse(T) @ pose_to_matrix(cube.pose), corners)
    outline = cv2.convexHull(lens_from_info(infos[-1]).intrinsics.project(in_camera).astype(np.float32))
    moments = cv2.moments(outline)
    centre = np.array([moments["m10"], moments["m01"]]) / moments["m00"]

    pixels = image_to_array(images[-1]).astype(float)
    red = (pixels[..., 0] > 2.0 * pixels[..., 1]) & (pixels[..., 0] > 2.0 * pixels[..., 2])
    v, u = np.nonzero(red)
    assert red.sum() == pytest.approx(moments["m00"], rel=0.02)  # nothing hides it
    np.testing.assert_allclose([u.mean(), v.mean()], centre, atol=0.5)
    nearest = depth_to_metres(depths[-1])[red].min()
    assert nearest == pytest.approx(in_camera[:, 2].min(), abs=0.002)  # the nearest corner, to a pixel


@pytest.mark.long
@pytest.mark.requirement("P-24")
def test_cameras_draw_only_while_their_images_have_subscribers(seeing) -> None:
    """A CameraInfo alone needs no drawing."""
    drawn: list[tuple[dict[str, int], int]] = []

    def rests() -> bool:
        """Whether nothing was drawn for half a second of simulated time."""
        if not drawn or seeing.node._images.rendered != drawn[-1][0]:
            drawn.append((seeing.node._images.rendered, seeing.t_ns))
        return seeing.t_ns > drawn[-1][1] + 500_000_000

    infos = seeing.collect(CameraInfo, "/wrist/depth/camera_info", QOS_SENSOR)
    seeing.ros.spin_until(lambda: rests() and infos, what="camera info, and no drawing")
    assert infos[-1].header.frame_id == "wrist_color_optical_frame"
    before = seeing.node._images.rendered
    subscription = seeing.ros.node.create_subscription(Image, "/wrist/color/image_raw", lambda _m: None, QOS_SENSOR)
    seeing.ros.spin_until(lambda: seeing.node._images.rendered["wrist"] > before["wrist"] + 3, what="wrist images")
    assert seeing.node._images.rendered["overhead"] == before["overhead"]
    seeing.ros.node.destroy_subscription(subscription)
    seeing.ros.spin_until(rests, what="the camera draws no more")


def test_the_drawn_world_is_the_one_that_was_loaded(seeing) -> None:
    images = seeing.collect(Image, "/overhead/color/image_raw", QOS_SENSOR)
    seeing.ros.spin_until(lambda: len(images) > 3, what="images")

    def red() -> int:
        pixels = image_to_array(images[-1]).astype(int)
        return int(((pixels[..., 0] > 120) & (pixels[..., 1] < 60) & (pixels[..., 2] < 60)).sum())

    assert red() > 100
    seeing.reset(scene="empty")
    seeing.ros.spin_until(lambda: red() == 0, what="an image without the cube")
    seeing.reset(scene="demo")
    seeing.ros.spin_until(lambda: red() > 100, what="an image with it again")


@pytest.mark.requirement("A-04", "A-15", "A-16", "A-17")
def test_names_types_and_qos(seeing) -> None:
    node = seeing.ros.node
    assert "mujoco_bridge" in node.get_node_names()
    offered = {
        "/clock": ("rosgraph_msgs/msg/Clock", False, False),
        "/joint_states": ("sensor_msgs/msg/JointState", True, False),
        "/robot_description": ("std_msgs/msg/String", True, True),
        "/tf": ("tf2_msgs/msg/TFMessage", True, False),
        "/tf_static": ("tf2_msgs/msg/TFMessage", True, True),
        "/overhead/color/image_raw": ("sensor_msgs/msg/Image", False, False),
        "/overhead/color/camera_info": ("sensor_msgs/msg/CameraInfo", False, False),
        "/overhead/depth/image_raw": ("sensor_msgs/msg/Image", False, False),
        "/overhead/depth/camera_info": ("sensor_msgs/msg/CameraInfo", False, False),
        "/wrist/color/image_raw": ("sensor_msgs/msg/Image", False, False),
        "/wrist/depth/image_raw": ("sensor_msgs/msg/Image", False, False),
        "/spectator/color/image_raw": ("sensor_msgs/msg/Image", False, False),
        "/sim/ground_truth/objects": ("openarm_interfaces/msg/ObjectStateArray", True, False),
        "/sim/real_time_factor": ("std_msgs/msg/Float64", True, False),
        "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", True, False),
    }

    def publishers(topic: str) -> list:
        owner = "mujoco_cameras" if topic.startswith(("/overhead", "/wrist", "/spectator")) else "mujoco_bridge"
        return [info for info in node.get_publishers_info_by_topic(topic) if info.node_name == owner]

    seeing.ros.spin_until(lambda: all(map(publishers, offered)), what="every publisher of bridge and cameras")
    for topic, (kind, is_reliable, latched) in offered.items():
        (info,) = publishers(topic)
        assert info.topic_type == kind, topic
        assert (info.qos_profile.reliability == ReliabilityPolicy.RELIABLE) == is_reliable, topic
        assert (info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL) == latched, topic
    seeing.ros.spin_until(lambda: node.get_subscriptions_info_by_topic("/joint_commands"), what="/joint_commands")
    (commands,) = node.get_subscriptions_info_by_topic("/joint_commands")
    assert commands.topic_type == "sensor_msgs/msg/JointState"
    assert commands.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert QOS_COMMAND.depth == 10
    expected = {
        f"/sim/{name}": [f"openarm_interfaces/srv/{kind}"]
        for name, kind in (
            ("reset_world", "ResetWorld"),
            ("set_pause", "SetPause"),
            ("step", "StepSimulation"),
            ("spawn_object", "SpawnObject"),
        )
    }
    seeing.ros.spin_until(
        lambda: expected.items() <= dict(node.get_service_names_and_types()).items(), what="the services"
    )
    assert seeing.joints[0].name == [
        f"openarm_{s}_{j}" for s in ("left", "right") for j in (*(f"joint{i}" for i in range(1, 8)), "finger_joint1")
    ]
    np.testing.assert_allclose(seeing.arm, seeing.HOME, atol=0.01)


@pytest.mark.requirement("A-04")
def test_a_sensor_can_not_be_had_reliably_and_that_is_reported(seeing) -> None:
    refused: list[QoSPolicyKind] = []
    events = SubscriptionEventCallbacks(incompatible_qos=lambda event: refused.append(event.last_policy_kind))
    seeing.ros.node.create_subscription(
        Image, "/overhead/color/image_raw", lambda _m: None, QOS_COMMAND, event_callbacks=events
    )
    seeing.ros.spin_until(lambda: refused, what="the refusal")
    assert refused[0] == QoSPolicyKind.RELIABILITY


def test_diagnostics_report_how_well_it_keeps_up(seeing) -> None:
    got = seeing.collect(DiagnosticArray, "/diagnostics", QOS_COMMAND)

    def values() -> dict[str, str]:
        return {v.key: v.value for m in got[-1:] for s in m.status for v in s.values}

    expected = {
        "real_time_factor",
        "joint_state_period_p99_ms",
        "joint_state_period_max_ms",
        "frames_overhead",
        "frames_wrist",
    }
    seeing.ros.spin_until(lambda: expected <= set(values()), what=f"a status with {', '.join(sorted(expected))}")


def test_a_camera_is_drawn_at_the_rate_that_its_subscribers_need(seeing) -> None:
    got = seeing.collect(DiagnosticArray, "/diagnostics", QOS_COMMAND)
    eye, topic, images = seeing.ros.add(BaseNode("eye", Config)), "/overhead/depth/image_raw", []

    def until(rate: str) -> None:
        def reached() -> bool:
            bridge = [s for m in got[-3:] for s in m.status if s.name == "mujoco_bridge: status"]
            values = {v.key: v.value for s in bridge for v in s.values}
            slow = rate == "30" and any("this machine draws no faster: overhead at" in s.message for s in bridge)
            return values.get("rate_overhead") == rate or slow

        seeing.ros.spin_until(reached, what=f"{rate} images a second")

    until("0")
    eye.take_images_at(4.0, [topic])
    subscription = eye.create_subscription(Image, topic, images.append, QOS_SENSOR)
    until("4")
    images.clear()
    seeing.ros.spin_until(lambda: len(images) > 3, what="images")
    assert np.all(np.diff(stamps(images)) >= 240_000_000)
    eye.take_images_at(0.0, [topic])  # as a recorder of what is made for others
    until("0")
    other = seeing.ros.node.create_subscription(Image, topic, lambda _: None, QOS_SENSOR)  # which says nothing of it
    until("30")
    seeing.ros.node.destroy_subscription(other)
    until("0")
    eye.destroy_subscription(subscription)


def test_a_camera_drops_its_images(seeing) -> None:
    images = seeing.collect(Image, "/overhead/color/image_raw", QOS_SENSOR)
    seeing.fresh(images, 5)
    seeing.inject("camera_drop", "{camera: overhead, share: 1.0}")
    count, since_ns = len(images), seeing.t_ns

    def quiet() -> bool:
        """Whether no image has come for half a second of simulated time."""
        nonlocal count, since_ns
        if len(images) != count:
            count, since_ns = len(images), seeing.t_ns
        return seeing.t_ns > since_ns + 500_000_000

    seeing.ros.spin_until(quiet, what="the end of the images")
    seeing.inject("camera_drop", "{camera: wrist, share: 1.0}")  # takes the new values
    seeing.fresh(images, 2)


def test_the_picture_of_a_frozen_camera_stays_while_stamps_go_on(seeing) -> None:
    images = seeing.collect(Image, "/overhead/color/image_raw", QOS_SENSOR)
    seeing.inject("camera_freeze")
    (before,) = seeing.fresh(images)[:1]
    pose = PoseStamped()
    pose.pose.position.x, pose.pose.position.y = 0.30, -0.05
    assert seeing.call(MoveObject, "/sim/move_object", name="red_cube", pose=pose).success
    later = seeing.fresh(images, 3)[-1]
    assert stamp_to_ns(later.header.stamp) > stamp_to_ns(before.header.stamp)
    assert bytes(later.data) == bytes(before.data)
    seeing.clear()
    assert bytes(seeing.fresh(images, 3)[-1].data) != bytes(before.data)


@pytest.mark.requirement("A-72")
def test_stamp_offset_and_intrinsics_bias(seeing) -> None:
    infos = seeing.collect(CameraInfo, "/overhead/depth/camera_info", QOS_SENSOR)
    true = seeing.fresh(infos)[0]
    assert np.all(stamps(infos[-3:]) % 10_000_000 == 0)
    seeing.inject("stamp_offset", "{ms: 23}")
    seeing.ros.spin_until(lambda: stamps(infos[-1:])[0] % 10_000_000 == 3_000_000, what="stamps with an offset")
    assert np.all(stamps(seeing.fresh(infos, 3)) % 10_000_000 == 3_000_000)
    seeing.inject("intrinsics_bias", "{focal: 0.05, cx: 4.0}")
    seeing.ros.spin_until(lambda: infos[-1].k[0] != true.k[0], what="wrong intrinsics")
    wrong = infos[-1]
    np.testing.assert_allclose([wrong.k[0], wrong.k[4]], [1.05 * true.k[0], 1.05 * true.k[4]])
    assert wrong.k[2] == pytest.approx(true.k[2] + 4.0)
    assert wrong.p[0] == wrong.k[0]
    seeing.clear()
    seeing.ros.spin_until(lambda: list(infos[-1].k) == list(true.k), what="the true intrinsics")
    seeing.ros.spin_until(lambda: stamps(infos[-1:])[0] % 10_000_000 == 0, what="stamps without an offset")


@pytest.mark.long
def test_mount_knocked_light_and_depth_patch(seeing) -> None:
    images = seeing.collect(Image, "/overhead/color/image_raw", QOS_SENSOR)
    depths = seeing.collect(Image, "/overhead/depth/image_raw", QOS_SENSOR)

    def shown(got: list, shows: Callable[[np.ndarray], object], what: str) -> np.ndarray:
        """The first picture in which it shows."""
        seeing.ros.spin_until(lambda: got and shows(image_to_array(got[-1]).astype(float)), what=what)
        return image_to_array(got[-1]).astype(float)

    def same(one: np.ndarray, other: np.ndarray, atol: float) -> bool:
        return bool(np.allclose(one, other, atol=atol))

    seeing.fresh(depths, 2), seeing.fresh(images, 2)
    plain_depth, plain = (image_to_array(got[-1]).astype(float) for got in (depths, images))
    seeing.inject("depth_patch", "{u: 300, v: 220, width: 40, height: 20, metres: -0.05}")
    change = shown(depths, lambda d: not same(d, plain_depth, 1.0), "the patch") - plain_depth
    np.testing.assert_allclose(change[220:240, 300:340], -50.0, atol=1.0)
    assert np.abs(change[:200]).max() <= 1.0
    seeing.clear()
    seeing.inject("light_changed", "{scale: 0.3}")
    shown(images, lambda c: c[100:].mean() < 0.6 * plain[100:].mean(), "less light")
    seeing.clear()
    shown(depths, lambda d: same(d, plain_depth, 1.0), "the depth without the patch")
    seeing.inject("mount_knocked", "{camera: overhead, mm: 20, deg: 3}", seed=5)
    knocked = shown(depths, lambda d: np.abs(d - plain_depth).mean() > 3.0, "the knock")
    seeing.inject("mount_knocked", "{camera: overhead, mm: 20, deg: 3}", seed=5)
    np.testing.assert_allclose(image_to_array(seeing.fresh(depths, 3)[-1]), knocked, atol=1.0)  # the same seed
    seeing.clear()
    shown(depths, lambda d: same(d, plain_depth, 1.0), "the true mount in depth")
    shown(images, lambda c: same(c, plain, 2.0), "the true mount and light in colour")


@pytest.mark.long
def test_images_are_late(seeing) -> None:
    """The newest image is older than the newest joint state by the delay. Last: some come after its end."""
    late: list[int] = []
    seeing.ros.node.create_subscription(
        Image, "/overhead/color/image_raw", lambda m: late.append(seeing.t_ns - stamp_to_ns(m.header.stamp)), QOS_SENSOR
    )
    seeing.inject("camera_delay", "{seconds: 1.0}")
    seeing.ros.spin_until(lambda: len(late) > 5 and np.median(late[-5:]) > 0.85e9, what="late images")
    seeing.clear("camera_delay")
    seeing.ros.spin_until(lambda: max(late[-5:]) < 0.85e9, what="images in time")


# The last one: what the killed process published counts as there for a while.
@pytest.mark.long
def test_images_come_again_after_their_process_was_killed(seeing, monkeypatch) -> None:
    monkeypatch.setattr(camera_feed, "_AGAIN_S", 0.1)
    images = seeing.collect(Image, "/overhead/color/image_raw", QOS_SENSOR)
    seeing.ros.spin_until(lambda: len(images) > 3, what="images")
    states = seeing.collect(JointState, "/joint_states", reliable(2000))
    seeing.ros.spin_until(lambda: states, what="joint states")
    feed, before = seeing.node._images, seeing.t_ns
    feed._process.kill()
    seeing.ros.spin_until(lambda: "code -9" in feed.fault, what="its death to be reported")
    n = len(images)
    seeing.ros.spin_until(lambda: len(images) > n + 3, what="images again")
    seeing.ros.spin_until(lambda: feed.fault == "", what="the fault to be over")
    heard = stamps(states)
    assert np.diff(heard[heard > before]).max() < 300_000_000  # the robot went on meanwhile
