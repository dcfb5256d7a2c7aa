# SPDX-License-Identifier: Apache-2.0
"""The node `mujoco_bridge` in process: names, types, QoS, rates, frames, actions, services."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration
from control_msgs.action import FollowJointTrajectory, ParallelGripperCommand
from control_msgs.msg import JointTrajectoryControllerState
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Vector3, WrenchStamped
from openarm_interfaces.msg import ObjectStateArray
from openarm_interfaces.srv import InjectFault, ResetWorld, SetPause, SpawnObject, StepSimulation
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from scipy.optimize import least_squares
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Float64, String
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from openarm_common.cameras import load_cameras
from openarm_common.convert import (
    depth_to_metres,
    image_to_array,
    intrinsics_from_info,
    point,
    stamp_to_ns,
    transform_to_matrix,
)
from openarm_common.description import RobotDescription
from openarm_common.node import QOS_CLOCK, QOS_COMMAND, QOS_LATCHED, QOS_SENSOR, QOS_STATIC_TF, QOS_TF
from openarm_sim_bridge.node import MujocoBridge

ARM = tuple(f"openarm_right_joint{i}" for i in range(1, 8))
FINGER = "openarm_right_finger_joint1"
TCP = "openarm_right_hand_tcp"
HOME = [-0.2, 2.2, 0.0, 1.2, 0.0, 0.0, 0.4]
NEAR_HOME = [-0.1, 2.1, 0.1, 1.3, 0.1, 0.1, 0.3]


class Bench:
    """A bridge, and what has been heard from it."""

    def __init__(self, ros, **parameters: object) -> None:
        self.ros = ros
        overrides = [Parameter(name.replace("__", "."), value=value) for name, value in parameters.items()]
        self.node: MujocoBridge = ros.add(MujocoBridge(parameter_overrides=overrides))
        self.joints: list[JointState] = []
        self.joint_arrivals: list[float] = []
        ros.node.create_subscription(JointState, "/joint_states", self._on_joints, QOS_COMMAND)
        ros.spin_until(lambda: self.joints, 10.0, "a joint state")

    def _on_joints(self, message: JointState) -> None:
        self.joints.append(message)
        self.joint_arrivals.append(time.monotonic())

    def collect(self, kind: type, topic: str, qos) -> list:
        got: list = []
        self.ros.node.create_subscription(kind, topic, got.append, qos)
        return got

    def position(self, name: str) -> float:
        return self.joints[-1].position[self.joints[-1].name.index(name)]

    @property
    def t_ns(self) -> int:
        return stamp_to_ns(self.joints[-1].header.stamp)

    def spin_sim(self, seconds: float, timeout: float = 20.0) -> None:
        """Spin until simulated time has gone on."""
        end = self.t_ns + round(seconds * 1e9)
        self.ros.spin_until(lambda: self.t_ns >= end, timeout, f"{seconds} s of simulated time")

    def call(self, kind: type, service: str, /, **fields: object):
        client = self.ros.node.create_client(kind, service)
        return self.ros.call(client, kind.Request(**fields))

    def arm_client(self, side: str = "right") -> ActionClient:
        return ActionClient(
            self.ros.node, FollowJointTrajectory, f"/{side}_joint_trajectory_controller/follow_joint_trajectory"
        )

    def gripper_client(self, side: str = "right") -> ActionClient:
        return ActionClient(self.ros.node, ParallelGripperCommand, f"/{side}_gripper_controller/gripper_cmd")

    def follow(self, goal: FollowJointTrajectory.Goal, **kwargs):
        return self.ros.send_goal(self.arm_client(), goal, **kwargs)

    def grip(self, position: float, effort: float | None = None):
        command = JointState(name=[FINGER], position=[position], effort=[] if effort is None else [effort])
        handle, future = self.ros.send_goal(self.gripper_client(), ParallelGripperCommand.Goal(command=command))
        assert handle.accepted
        return self.ros.result(future, 15.0)


@pytest.fixture
def bench(ros) -> Iterator[Bench]:
    return Bench(ros, images=False)


@pytest.fixture
def seeing(ros) -> Iterator[Bench]:
    """With cameras."""
    return Bench(ros)


def posture(bench: Bench, residual) -> list[float]:
    """Joint positions of the right arm near home that make a function of the TCP's pose (4, 4) zero."""
    description = bench.node.description
    lower, upper = description.limits(ARM)

    def of(q: np.ndarray) -> np.ndarray:
        T = description.link_pose(TCP, dict(zip(ARM, q, strict=True)))
        return np.concatenate([residual(T), 0.01 * (q - HOME)])

    found = least_squares(of, HOME, bounds=(lower + 0.02, upper - 0.02))
    assert np.abs(residual(description.link_pose(TCP, dict(zip(ARM, found.x, strict=True))))).max() < 0.02
    return found.x.tolist()


def trajectory_goal(
    *points: tuple[float, list[float]], names: tuple[str, ...] = ARM, velocities: bool = True, **fields
) -> FollowJointTrajectory.Goal:
    message = JointTrajectory(joint_names=list(names))
    for i, (seconds, positions) in enumerate(points):
        point = JointTrajectoryPoint(
            positions=positions, time_from_start=Duration(sec=int(seconds), nanosec=round(seconds % 1 * 1e9))
        )
        if velocities and i == len(points) - 1:
            point.velocities = [0.0] * len(positions)
        message.points.append(point)
    return FollowJointTrajectory.Goal(trajectory=message, **fields)


# --- state
def test_a15_a16_a17_names_types_and_qos(seeing: Bench) -> None:
    node = seeing.ros.node
    assert "mujoco_bridge" in node.get_node_names()
    seeing.ros.spin_until(lambda: node.count_publishers("/spectator/color/image_raw"), 5.0, "the cameras' node")
    seeing.spin_sim(0.5)  # and the rest of its topics
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
    for topic, (kind, is_reliable, latched) in offered.items():
        owner = "mujoco_cameras" if topic.startswith(("/overhead", "/wrist", "/spectator")) else "mujoco_bridge"
        (info,) = [i for i in node.get_publishers_info_by_topic(topic) if i.node_name == owner]
        assert info.topic_type == kind, topic
        assert (info.qos_profile.reliability == ReliabilityPolicy.RELIABLE) == is_reliable, topic
        assert (info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL) == latched, topic
    (commands,) = node.get_subscriptions_info_by_topic("/joint_commands")
    assert commands.topic_type == "sensor_msgs/msg/JointState"
    assert commands.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert QOS_COMMAND.depth == 10
    services = dict(node.get_service_names_and_types())
    for name, kind in (
        ("reset_world", "ResetWorld"),
        ("set_pause", "SetPause"),
        ("step", "StepSimulation"),
        ("spawn_object", "SpawnObject"),
    ):
        assert services[f"/sim/{name}"] == [f"openarm_interfaces/srv/{kind}"]
    assert seeing.joints[0].name == [
        f"openarm_{s}_{j}" for s in ("left", "right") for j in (*(f"joint{i}" for i in range(1, 8)), "finger_joint1")
    ]
    np.testing.assert_allclose([seeing.position(name) for name in ARM], HOME, atol=0.01)


def test_a18_a19_hundred_hertz_in_step_with_the_wall_clock(bench: Bench) -> None:
    factors = bench.collect(Float64, "/sim/real_time_factor", 5)
    clocks = bench.collect(Clock, "/clock", QOS_CLOCK)
    bench.spin_sim(1.0)  # discovery is over
    first, wall = bench.t_ns, time.monotonic()
    bench.spin_sim(3.0)
    ratio = (bench.t_ns - first) * 1e-9 / (time.monotonic() - wall)
    assert ratio == pytest.approx(1.0, abs=0.1)
    steps = np.diff([stamp_to_ns(m.header.stamp) for m in bench.joints])
    assert np.mean(steps == 10_000_000) > 0.98  # a tick each; a starved probe may miss some
    assert np.all(steps % 10_000_000 == 0)
    assert np.all(steps > 0)
    assert factors
    assert factors[-1].data == pytest.approx(1.0, abs=0.1)
    assert len(clocks) > 300
    assert np.median(np.diff(bench.joint_arrivals[-300:])) == pytest.approx(0.01, abs=0.0015)


def test_a73_the_tree_of_frames_is_complete_and_has_no_gaps(bench: Bench) -> None:
    static = bench.collect(TFMessage, "/tf_static", QOS_STATIC_TF)
    moving = bench.collect(TFMessage, "/tf", QOS_TF)
    bench.ros.spin_until(lambda: static, 5.0, "/tf_static")
    bench.spin_sim(1.0)
    parents = {t.child_frame_id: t.header.frame_id for m in static + moving for t in m.transforms}
    description = RobotDescription.load()
    assert {j.child: j.parent for j in description.joints.values()}.items() <= parents.items()
    for alias, parent in (
        ("base_link", "openarm_body_link0"),
        ("left_arm_base", "openarm_left_link0"),
        ("right_arm_base", "openarm_right_link0"),
        ("table", "openarm_body_link0"),
    ):
        assert parents[alias] == parent
    assert set(parents.values()) - set(parents) == {"world"}  # one root
    stamps = np.array([stamp_to_ns(m.transforms[0].header.stamp) for m in moving]) * 1e-9
    assert np.diff(stamps).max() <= 0.1
    assert len(stamps) / (stamps[-1] - stamps[0]) == pytest.approx(50.0, rel=0.05)
    by_stamp = {stamp_to_ns(m.header.stamp): m for m in bench.joints}
    last = next(m for m in reversed(moving) if stamp_to_ns(m.transforms[0].header.stamp) in by_stamp)
    state = by_stamp[stamp_to_ns(last.transforms[0].header.stamp)]
    poses = description.link_poses(dict(zip(state.name, state.position, strict=True)))
    for t in last.transforms:
        T = np.linalg.inv(poses[t.header.frame_id]) @ poses[t.child_frame_id]
        np.testing.assert_allclose(transform_to_matrix(t.transform), T, atol=1e-9)


def test_robot_description_is_latched(bench: Bench) -> None:
    got = bench.collect(String, "/robot_description", QOS_LATCHED)
    bench.ros.spin_until(lambda: got, 5.0, "/robot_description")
    assert got[0].data == RobotDescription.load().urdf


def test_ground_truth_is_the_only_outlet_of_object_poses(bench: Bench) -> None:
    got = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)
    bench.ros.spin_until(lambda: len(got) > 10, 5.0, "ground truth")
    assert got[-1].header.frame_id == "world"
    cube = next(o for o in got[-1].objects if o.name == "red_cube")
    assert (cube.label, cube.size.x) == ("red", 0.05)
    assert cube.pose.position.z == pytest.approx(0.425, abs=0.001)
    stamps = np.array([stamp_to_ns(m.header.stamp) for m in got]) * 1e-9
    assert np.diff(stamps).mean() == pytest.approx(0.05, abs=0.005)
    kinds = dict(bench.ros.node.get_topic_names_and_types())
    assert [t for t, k in kinds.items() if "openarm_interfaces/msg/ObjectStateArray" in k] == [
        "/sim/ground_truth/objects"
    ]


# --- cameras
def test_a26_a28_a30_images_info_and_joint_states_belong_together(seeing: Bench) -> None:
    colour = seeing.collect(Image, "/overhead/color/image_raw", QOS_SENSOR)
    depth = seeing.collect(Image, "/overhead/depth/image_raw", QOS_SENSOR)
    infos = seeing.collect(CameraInfo, "/overhead/color/camera_info", QOS_SENSOR)
    depth_infos = seeing.collect(CameraInfo, "/overhead/depth/camera_info", QOS_SENSOR)
    seeing.ros.spin_until(lambda: len(colour) > 30 and len(depth) > 30, 20.0, "images")
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
    stamps = {stamp_to_ns(m.header.stamp) for m in seeing.joints}
    paired = [stamp_to_ns(m.header.stamp) in stamps for m in colour + depth]
    assert np.mean(paired) > 0.8  # a starved probe may miss some joint states

    def with_info() -> float:
        known = {stamp_to_ns(m.header.stamp) for m in infos}
        return float(np.mean([stamp_to_ns(m.header.stamp) in known for m in colour]))

    # Best effort: a starved probe may miss the info of one image or another.
    seeing.ros.spin_until(lambda: with_info() > 0.8, 10.0, "infos with the stamps of the images")
    pixels, z = image_to_array(image), depth_to_metres(depth[-1])
    assert pixels.std() > 10.0
    # The table top, seen by a camera whose mount is nominal: planar depth of a plane.
    T = load_cameras()["overhead"].T_parent_optical
    v, u = np.array([430, 430, 460]), np.array([320, 100, 550])
    rays = intrinsics_from_info(info)
    points = rays.deproject(np.stack([u, v], axis=-1), z[v, u].astype(float))
    heights = (points @ T[:3, :3].T + T[:3, 3])[:, 2]
    np.testing.assert_allclose(heights, 0.40, atol=1e-3)


def test_p24_cameras_without_subscribers_draw_nothing(seeing: Bench) -> None:
    seeing.spin_sim(0.5)
    assert not any(seeing.node._images.rendered.values())
    subscription = seeing.ros.node.create_subscription(Image, "/wrist/color/image_raw", lambda _m: None, QOS_SENSOR)
    seeing.ros.spin_until(lambda: seeing.node._images.rendered["wrist"] > 3, 15.0, "wrist images")
    assert seeing.node._images.rendered["overhead"] == 0
    seeing.ros.node.destroy_subscription(subscription)
    seeing.spin_sim(0.8)
    drawn = seeing.node._images.rendered["wrist"]
    seeing.spin_sim(0.5)
    assert seeing.node._images.rendered["wrist"] == drawn


def test_camera_info_alone_needs_no_drawing(seeing: Bench) -> None:
    infos = seeing.collect(CameraInfo, "/wrist/depth/camera_info", QOS_SENSOR)
    seeing.ros.spin_until(lambda: len(infos) > 10, 5.0, "camera info")
    assert infos[-1].header.frame_id == "wrist_color_optical_frame"
    assert not any(seeing.node._images.rendered.values())


def test_images_come_again_after_their_process_was_killed(seeing: Bench) -> None:
    images = seeing.collect(Image, "/overhead/color/image_raw", QOS_SENSOR)
    seeing.ros.spin_until(lambda: len(images) > 3, 20.0, "images")
    feed, before = seeing.node._images, seeing.t_ns
    os.kill(feed.pid, signal.SIGKILL)
    seeing.ros.spin_until(lambda: "code -9" in feed.fault, 5.0, "its death to be told")
    n = len(images)
    seeing.ros.spin_until(lambda: len(images) > n + 3, 20.0, "images again")
    seeing.ros.spin_until(lambda: feed.fault == "", 5.0, "the fault to be over")
    stamps = [stamp_to_ns(m.header.stamp) for m in seeing.joints if stamp_to_ns(m.header.stamp) > before]
    assert np.diff(stamps).max() < 300_000_000  # the robot went on meanwhile; a starved probe may miss some


def test_the_drawn_world_is_the_one_that_was_loaded(seeing: Bench) -> None:
    images = seeing.collect(Image, "/overhead/color/image_raw", QOS_SENSOR)
    seeing.ros.spin_until(lambda: len(images) > 3, 20.0, "images")

    def red() -> int:
        pixels = image_to_array(images[-1]).astype(int)
        return int(((pixels[..., 0] > 120) & (pixels[..., 1] < 60) & (pixels[..., 2] < 60)).sum())

    assert red() > 100
    assert seeing.call(ResetWorld, "/sim/reset_world", scene="empty").success
    seeing.ros.spin_until(lambda: red() == 0, 5.0, "an image without the cube")


def test_a47_depth_in_metres_by_parameter(ros) -> None:
    bench = Bench(ros, depth_encoding="32FC1", scene="empty")
    depth = bench.collect(Image, "/overhead/depth/image_raw", QOS_SENSOR)
    ros.spin_until(lambda: depth, 20.0, "a depth image")
    assert depth[-1].encoding == "32FC1"
    assert np.nanmedian(depth_to_metres(depth[-1])) == pytest.approx(0.8, abs=0.2)


def test_a52_noisy_depth_by_parameter(ros) -> None:
    bench = Bench(ros, depth_noise__enabled=True, scene="empty")
    depth = bench.collect(Image, "/overhead/depth/image_raw", QOS_SENSOR)
    ros.spin_until(lambda: len(depth) > 1, 20.0, "depth images")
    z = depth_to_metres(depth[-1])[400:440, 300:340]
    columns = z - np.nanmean(z, axis=1, keepdims=True)  # the table is level along a row
    fx = load_cameras()["overhead"].intrinsics.fx
    assert np.nanstd(columns) == pytest.approx(np.nanmean(z) ** 2 * 0.08 / (fx * 0.05), rel=0.2)


# --- arms
def test_a25_a_trajectory_is_followed(bench: Bench) -> None:
    feedback: list = []
    handle, future = bench.follow(trajectory_goal((1.0, NEAR_HOME)), feedback_callback=feedback.append)
    assert handle.accepted
    answer = bench.ros.result(future, 15.0)
    assert answer.status == GoalStatus.STATUS_SUCCEEDED, answer.result.error_string
    assert answer.result.error_code == FollowJointTrajectory.Result.SUCCESSFUL
    np.testing.assert_allclose([bench.position(name) for name in ARM], NEAR_HOME, atol=0.02)
    assert len(feedback) > 5
    assert feedback[-1].feedback.joint_names == list(ARM)
    assert abs(feedback[-1].feedback.error.positions[0]) < 0.05


def test_the_topics_of_the_trajectory_controller(bench: Bench) -> None:
    """joint_trajectory is followed without an action; controller_state tells reference and feedback."""
    controller = "/right_joint_trajectory_controller"
    states = bench.collect(JointTrajectoryControllerState, f"{controller}/controller_state", 10)
    publisher = bench.ros.node.create_publisher(JointTrajectory, f"{controller}/joint_trajectory", QOS_COMMAND)
    bench.ros.spin_until(lambda: publisher.get_subscription_count() and states, 5.0, "the controller's topics")
    assert states[-1].joint_names == list(ARM)
    np.testing.assert_allclose(states[-1].feedback.positions, HOME, atol=0.01)
    publisher.publish(trajectory_goal((1.0, [*NEAR_HOME[:6], float("nan")])).trajectory)  # refused, in the log
    publisher.publish(trajectory_goal((1.0, NEAR_HOME)).trajectory)
    bench.ros.spin_until(
        lambda: np.allclose([bench.position(name) for name in ARM], NEAR_HOME, atol=0.02), 10.0, "the arm to arrive"
    )
    bench.ros.spin_until(lambda: np.allclose(states[-1].reference.positions, NEAR_HOME, atol=1e-6), 5.0, "its state")
    np.testing.assert_allclose(states[-1].error.positions, 0.0, atol=0.02)
    assert np.all(np.diff([stamp_to_ns(m.header.stamp) for m in states]) >= 0)


@pytest.mark.parametrize(
    ("goal", "code", "text"),
    [
        (
            trajectory_goal((1.0, NEAR_HOME), names=(*ARM[:6], "elbow")),
            FollowJointTrajectory.Result.INVALID_JOINTS,
            "unknown joint 'elbow'",
        ),
        (
            trajectory_goal((1.0, NEAR_HOME[:6]), names=ARM[:6]),
            FollowJointTrajectory.Result.INVALID_JOINTS,
            "missing joint 'openarm_right_joint7'",
        ),
        (
            trajectory_goal((1.0, [*NEAR_HOME[:6], float("nan")])),
            FollowJointTrajectory.Result.INVALID_GOAL,
            "position of openarm_right_joint7 at point 0 is nan",
        ),
        (
            trajectory_goal((1.0, [*NEAR_HOME[:3], 3.0, *NEAR_HOME[4:]])),
            FollowJointTrajectory.Result.INVALID_GOAL,
            "position of openarm_right_joint4 at point 0 is 3.0000",
        ),
        (trajectory_goal(), FollowJointTrajectory.Result.INVALID_GOAL, "no points"),
        (
            trajectory_goal((1.0, NEAR_HOME), (0.5, HOME)),
            FollowJointTrajectory.Result.INVALID_GOAL,
            "strictly increasing",
        ),
    ],
    ids=["unknown", "missing", "nan", "limits", "empty", "times"],
)
def test_p21_bad_trajectories_end_with_the_joint_and_the_value(bench: Bench, goal, code: int, text: str) -> None:
    _, future = bench.follow(goal)
    answer = bench.ros.result(future, 5.0)
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert answer.result.error_code == code
    assert text in answer.result.error_string
    assert np.abs(np.array([bench.position(name) for name in ARM]) - HOME).max() < 0.01


def test_p21_cancel_holds(bench: Bench) -> None:
    handle, future = bench.follow(trajectory_goal((4.0, NEAR_HOME)))
    bench.spin_sim(2.0)
    bench.ros.result(handle.cancel_goal_async())
    assert bench.ros.result(future, 5.0).status == GoalStatus.STATUS_CANCELED
    bench.spin_sim(0.3)
    held = np.array([bench.position(name) for name in ARM])
    assert np.abs(held - HOME).max() > 0.02
    assert np.abs(held - NEAR_HOME).max() > 0.02
    bench.spin_sim(1.0)
    np.testing.assert_allclose([bench.position(name) for name in ARM], held, atol=0.003)


def test_p21_a_newer_trajectory_takes_over_and_a_bad_one_does_not(bench: Bench) -> None:
    _, first = bench.follow(trajectory_goal((3.0, NEAR_HOME)))
    bench.spin_sim(0.5)
    _, bad = bench.follow(trajectory_goal())
    assert bench.ros.result(bad, 5.0).status == GoalStatus.STATUS_ABORTED
    assert not first.done()
    _, second = bench.follow(trajectory_goal((1.0, HOME)))
    assert "newer" in bench.ros.result(first, 5.0).result.error_string
    assert bench.ros.result(second, 10.0).status == GoalStatus.STATUS_SUCCEEDED


def test_a_blocked_arm_ends_with_its_tolerance_and_holds(bench: Bench) -> None:
    below_table = posture(bench, lambda T: [*(T[:3, 3] - [0.30, -0.25, 0.30])])
    _, future = bench.follow(trajectory_goal((3.0, below_table)))
    answer = bench.ros.result(future, 20.0)
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert answer.result.error_code == FollowJointTrajectory.Result.PATH_TOLERANCE_VIOLATED
    assert "openarm_right_joint" in answer.result.error_string
    bench.spin_sim(0.5)
    assert bench.node._simulation.world.body_pose(TCP)[2, 3] > 0.38
    efforts = np.abs(bench.joints[-1].effort)
    assert efforts.max() < 5.0  # it does not go on pushing


# --- grippers
@pytest.mark.parametrize("position", [0.005, 0.035])
def test_p22_b55_the_gripper_reaches_its_goal(bench: Bench, position: float) -> None:
    answer = bench.grip(position)
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert answer.result.reached_goal
    assert not answer.result.stalled
    assert answer.result.state.position[0] == pytest.approx(position, abs=0.001)
    assert bench.position(FINGER) == pytest.approx(position, abs=0.001)


def test_p22_a_gripper_stalls_on_an_object_and_says_so(bench: Bench) -> None:
    """A box is put between fingers that are nearly closed, in a world that stands still."""
    level = posture(bench, lambda T: [10.0 * T[2, 1], *(T[:3, 3] - [0.40, -0.39, 0.75])])  # opening axis horizontal
    bench.ros.result(bench.follow(trajectory_goal((1.5, level)))[1], 15.0)
    assert bench.grip(0.016).result.reached_goal
    assert bench.call(SetPause, "/sim/set_pause", paused=True).success
    T = bench.node._simulation.world.body_pose(TCP)
    pose = PoseStamped()
    pose.header.frame_id = "world"
    pose.pose.position = point(T[:3, 3] - 0.017 * T[:3, 2])
    yaw = math.atan2(-T[0, 1], T[1, 1])  # the box's y along the opening axis
    pose.pose.orientation.z, pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    size = Vector3(x=0.02, y=0.030, z=0.02)
    spawned = bench.call(
        SpawnObject, "/sim/spawn_object", name="held", shape="box", size=size, color="purple", mass=0.02, pose=pose
    )
    assert spawned.success, spawned.message
    goal = ParallelGripperCommand.Goal(command=JointState(name=[FINGER], position=[0.0]))
    handle, future = bench.ros.send_goal(bench.gripper_client(), goal)
    assert handle.accepted
    assert bench.call(SetPause, "/sim/set_pause", paused=False).success
    answer = bench.ros.result(future, 15.0)
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert (answer.result.stalled, answer.result.reached_goal) == (True, False)
    assert 2 * answer.result.state.position[0] == pytest.approx(0.030, abs=0.001)
    assert answer.result.state.effort[0] == pytest.approx(-30.0, abs=1.0)
    pads = [
        bench.collect(WrenchStamped, f"/openarm_right_{finger}_finger/contact_wrench", QOS_SENSOR)
        for finger in ("left", "right")
    ]
    wrists = bench.collect(WrenchStamped, "/right_force_torque_sensor_broadcaster/wrench", QOS_SENSOR)
    bench.ros.spin_until(lambda: all(pads) and wrists, 5.0, "force sensors")
    for got in pads:  # each presses with half of the force
        force = got[-1].wrench.force
        assert math.hypot(force.x, force.y, force.z) == pytest.approx(15.0, abs=1.5)
    assert pads[0][-1].wrench.force.y * pads[1][-1].wrench.force.y < 0.0
    assert pads[0][-1].header.frame_id == "openarm_right_left_finger"
    assert wrists[-1].header.frame_id == "openarm_right_hand"
    bench.spin_sim(1.0)
    held = next(o for o in bench.node._simulation.world.objects() if o.object.name == "held")
    assert held.T_world_object[2, 3] > 0.6  # by friction alone
    got = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)
    assert bench.call(InjectFault, "/sim/inject_fault", name="friction_lowered", parameters="{scale: 0.0}").success
    bench.ros.spin_until(
        lambda: got and any(o.name == "held" and o.pose.position.z < 0.6 for o in got[-1].objects), 5.0, "its fall"
    )


def test_bad_gripper_goals_are_rejected(bench: Bench) -> None:
    for command in (
        JointState(name=[FINGER], position=[0.2]),
        JointState(name=["thumb"], position=[0.0]),
        JointState(name=[FINGER]),
        JointState(name=[FINGER], position=[float("nan")]),
    ):
        handle, _ = bench.ros.send_goal(bench.gripper_client(), ParallelGripperCommand.Goal(command=command))
        assert not handle.accepted


# --- commands
def test_a16_a23_b55_position_commands_may_be_partial_and_unknown_names_are_ignored(bench: Bench) -> None:
    publisher = bench.ros.node.create_publisher(JointState, "/joint_commands", QOS_COMMAND)
    bench.ros.spin_until(lambda: publisher.get_subscription_count(), 5.0)
    publisher.publish(JointState(name=["openarm_right_joint4", "tail", FINGER], position=[1.5, 9.0, 0.02]))
    bench.ros.spin_until(
        lambda: abs(bench.position("openarm_right_joint4") - 1.5) < 0.01 and abs(bench.position(FINGER) - 0.02) < 0.001,
        10.0,
        "the joints to arrive",
    )
    assert bench.node._warned == {"tail"}
    velocities = [m.velocity[m.name.index("openarm_right_joint4")] for m in bench.joints]
    assert max(velocities) < 1.2 * bench.node.config.trajectory.command_velocity  # no jump
    assert bench.position("openarm_right_joint1") == pytest.approx(HOME[0], abs=0.01)


@pytest.mark.parametrize("bad", [float("nan"), 99.0])
def test_bad_position_commands_are_refused_as_a_whole(bench: Bench, bad: float) -> None:
    publisher = bench.ros.node.create_publisher(JointState, "/joint_commands", QOS_COMMAND)
    bench.ros.spin_until(lambda: publisher.get_subscription_count(), 5.0)
    publisher.publish(JointState(name=["openarm_right_joint4", "openarm_right_joint1"], position=[1.5, bad]))
    bench.spin_sim(0.5)
    assert bench.position("openarm_right_joint4") == pytest.approx(HOME[3], abs=0.01)


# --- services
def test_p25_pause_and_step(bench: Bench) -> None:
    assert not bench.call(StepSimulation, "/sim/step", steps=5).success  # it runs
    assert bench.call(SetPause, "/sim/set_pause", paused=True).success
    bench.ros.spin_until(
        lambda: len(bench.joints) > 2 and bench.joints[-1].header.stamp == bench.joints[-2].header.stamp,
        5.0,
        "time to stand",
    )
    before = bench.t_ns
    n = len(bench.joints)
    bench.ros.spin_until(lambda: len(bench.joints) >= n + 3, 5.0, "signs of life")
    assert bench.t_ns == before
    answer = bench.call(StepSimulation, "/sim/step", steps=203)
    assert answer.success, answer.message
    bench.ros.spin_until(lambda: bench.t_ns == before + 203 * 2_000_000, 5.0, "203 steps of 2 ms")
    assert not bench.call(StepSimulation, "/sim/step", steps=0).success
    assert bench.call(SetPause, "/sim/set_pause", paused=False).success
    bench.spin_sim(0.2)


def test_p25_reset_puts_the_robot_back_and_aborts_what_runs(bench: Bench) -> None:
    _, future = bench.follow(trajectory_goal((3.0, NEAR_HOME)))
    bench.spin_sim(1.5)
    before, began = bench.t_ns, time.monotonic()
    answer = bench.call(ResetWorld, "/sim/reset_world")
    assert time.monotonic() - began < 0.5
    assert answer.success
    assert "reset" in bench.ros.result(future, 5.0).result.error_string
    bench.spin_sim(0.3)
    assert bench.t_ns > before
    np.testing.assert_allclose([bench.position(name) for name in ARM], HOME, atol=0.01)
    stamps = np.array([stamp_to_ns(m.header.stamp) for m in bench.joints])
    assert np.all(np.diff(stamps) > 0)


def test_a_diverged_world_takes_no_command_until_it_is_reset(bench: Bench, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning to a file there
    simulation = bench.node._simulation
    monkeypatch.setattr(simulation, "_dump_folder", tmp_path)
    got = bench.collect(DiagnosticArray, "/diagnostics", QOS_COMMAND)
    _, running = bench.follow(trajectory_goal((3.0, NEAR_HOME)))
    bench.spin_sim(0.3)
    simulation.call(lambda: simulation.world.data.qvel.fill(np.nan))
    answer = bench.ros.result(running, 5.0)
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert "diverged" in answer.result.error_string
    assert "The last second is in" in answer.result.error_string
    _, refused = bench.follow(trajectory_goal((1.0, NEAR_HOME)))
    assert "until the world is reset" in bench.ros.result(refused, 5.0).result.error_string
    goal = ParallelGripperCommand.Goal(command=JointState(name=[FINGER], position=[0.02]))
    assert not bench.ros.send_goal(bench.gripper_client(), goal)[0].accepted
    bench.ros.spin_until(lambda: any("diverged" in s.message for m in got for s in m.status), 5.0, "/diagnostics")
    assert bench.call(ResetWorld, "/sim/reset_world").success
    assert bench.grip(0.02).result.reached_goal


def test_p25_another_scene_is_loaded_while_time_goes_on(bench: Bench) -> None:
    got = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)
    answer = bench.call(ResetWorld, "/sim/reset_world", scene="random", seed=7)
    assert answer.success, answer.message
    bench.ros.spin_until(
        lambda: got and got[-1].objects and got[-1].objects[0].name != "red_cube", 5.0, "the new objects"
    )
    names = [o.name for o in got[-1].objects]
    bad = bench.call(ResetWorld, "/sim/reset_world", scene="nowhere")
    assert not bad.success
    assert "SCENE_INVALID" in bad.message
    assert "demo" in bad.message
    n = len(got)
    bench.ros.spin_until(lambda: len(got) > n + 2, 5.0)
    assert [o.name for o in got[-1].objects] == names


def test_b16_spawn_adds_an_object_on_the_table_and_names_what_is_wrong(bench: Bench) -> None:
    got = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)
    size, pose = Vector3(x=0.04, y=0.04, z=0.04), PoseStamped()
    pose.pose.position.x, pose.pose.position.y = 0.4, 0.0
    assert bench.call(
        SpawnObject, "/sim/spawn_object", name="extra", shape="box", size=size, color="purple", pose=pose
    ).success
    bench.ros.spin_until(lambda: any(o.name == "extra" for m in got for o in m.objects), 5.0, "the object")
    extra = next(o for o in got[-1].objects if o.name == "extra")
    assert extra.pose.position.z == pytest.approx(0.42, abs=0.002)
    for change, text in (
        ({"name": "extra"}, "already"),
        ({"name": "other"}, "overlap"),
        ({"name": "other", "shape": "cone"}, "box, cylinder"),
        ({"name": "other", "color": "pink"}, "red"),
    ):
        answer = bench.call(
            SpawnObject,
            "/sim/spawn_object",
            **({"shape": "box", "size": size, "color": "orange", "pose": pose} | change),
        )
        assert not answer.success, change
        assert text in answer.message
    assert bench.call(ResetWorld, "/sim/reset_world").success
    n = len(got)
    bench.ros.spin_until(lambda: len(got) > n + 3, 5.0)
    assert all(o.name != "extra" for o in got[-1].objects)


def test_diagnostics_tell_how_well_it_keeps_up(seeing: Bench) -> None:
    got = seeing.collect(DiagnosticArray, "/diagnostics", QOS_COMMAND)
    seeing.ros.spin_until(lambda: any(s.message == "running" for m in got for s in m.status), 5.0, "a status")
    values = {v.key: v.value for s in got[-1].status for v in s.values}
    assert {
        "real_time_factor",
        "joint_state_period_p99_ms",
        "joint_state_period_max_ms",
        "frames_overhead",
        "frames_wrist",
    } <= set(values)


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_p34_a_signal_ends_the_process_in_order(ros, stop: signal.Signals) -> None:
    """With cameras on and a trajectory under way: no error is told, and the exit code is 0."""
    joints: list[JointState] = []
    images: list[Image] = []
    ros.node.create_subscription(JointState, "/joint_states", joints.append, QOS_COMMAND)
    ros.node.create_subscription(Image, "/overhead/color/image_raw", images.append, QOS_SENSOR)
    client = ActionClient(ros.node, FollowJointTrajectory, "/right_joint_trajectory_controller/follow_joint_trajectory")
    command = [sys.executable, "-m", "openarm_sim_bridge.node", "--ros-args", "-p", "scene:=empty"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ) as process:
        try:
            ros.spin_until(lambda: joints and images, 30.0, "joint states and images of the process")
            handle, _ = ros.send_goal(client, trajectory_goal((5.0, NEAR_HOME)))
            assert handle.accepted
            process.send_signal(stop)
            _, errors = process.communicate(timeout=10.0)
        finally:
            process.kill()
    assert process.returncode == 0
    assert "Traceback" not in errors, errors
    assert "rror" not in errors, errors
