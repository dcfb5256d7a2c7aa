# SPDX-License-Identifier: Apache-2.0
"""Joint states for nodes: none is lost while a node works, and what the hands hold."""

from __future__ import annotations

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.config import Config
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import matrix_to_transform, ns_to_stamp
from openarm_common.ros.node import QOS_LATCHED, QOS_STATIC_TF, BaseNode, reliable
from openarm_common.ros.tf import RobotStateListener


@pytest.mark.parametrize(("depth", "kept"), [(100, 60), (10, 10)])
def test_what_comes_while_a_node_is_busy_waits(ros, depth: int, kept: int) -> None:
    robot = RobotDescription.load()
    listener = RobotStateListener(ros.add(BaseNode("eye", Config)), robot, depth=depth)
    joints = ros.node.create_publisher(JointState, "/joint_states", reliable(100))
    ros.spin_until(joints.get_subscription_count, what="the eye listens")
    names = list(robot.arm_joints("left"))

    def publish(number: int) -> None:
        message = JointState(name=names, position=[0.001 * number] * len(names))
        message.header.stamp = ns_to_stamp(10_000_000 * number)
        joints.publish(message)

    publish(0)
    ros.spin_until(lambda: listener.age_s() < 60.0, what="the first")
    for number in range(1, 61):  # without spinning
        publish(number)
    joints.wait_for_all_acked()
    ros.spin_until(lambda: listener.buffer.latest()[0] == 600_000_000, what="the last")
    assert len(listener.buffer.between(10_000_000, 600_000_000)) == kept


def marker(frame: str, size: float) -> MarkerArray:
    box = Marker(ns="right/red", type=Marker.CUBE)
    box.header.frame_id = frame
    box.pose.orientation.w = 1.0
    box.scale.x = box.scale.y = box.scale.z = size
    return MarkerArray(markers=[box])


def test_a_damaged_message_of_what_is_held_changes_nothing(ros) -> None:
    listener = RobotStateListener(ros.add(BaseNode("eye", Config)), RobotDescription.load(), held_topic="/held")
    publisher = ros.node.create_publisher(MarkerArray, "/held", QOS_LATCHED)
    publisher.publish(marker("openarm_right_hand_tcp", 0.04))
    ros.spin_until(lambda: [box.name for box in listener.tracker.held] == ["right/red"], what="it is held")
    rejected: list[str] = []
    listener._node.get_logger().warning = lambda text, **_: rejected.append(text)
    publisher.publish(marker("openarm_right_hand_tcp", -1.0))
    ros.spin_until(lambda: rejected, what="the damaged message is named")
    assert "expected a cube with edges" in rejected[0]
    assert [box.link for box in listener.tracker.held] == ["openarm_right_hand_tcp"]


def test_joint_states_and_transforms_of_wrong_form_are_counted_and_change_nothing(ros, monkeypatch) -> None:
    monkeypatch.setattr(BaseNode, "REPORT_PERIOD_S", 0.1)
    listener = RobotStateListener(ros.add(BaseNode("eye", Config)), RobotDescription.load())
    joints = ros.node.create_publisher(JointState, "/joint_states", reliable(100))
    edges = ros.node.create_publisher(TFMessage, "/tf_static", QOS_LATCHED)
    reports = ros.hear(DiagnosticArray, "/diagnostics")
    ros.spin_until(joints.get_subscription_count, what="the eye listens")
    good = JointState(name=["a", "b"], position=[0.1, 0.2])
    good.header.stamp = ns_to_stamp(5)
    for wrong in ([0.1], [0.1, 0.2, 0.3], [0.1, float("nan")], [1e308, 1e308]):
        joints.publish(JointState(name=["a", "b"], position=wrong))
    joints.publish(JointState(name=["a", "a"], position=[0.1, 0.2]))
    joints.publish(JointState(name=["a"], position=[0.1], effort=[1.0, 2.0]))
    joints.publish(good)
    bad, sound = TransformStamped(child_frame_id="eye_link"), TransformStamped(child_frame_id="table")
    bad.transform.rotation.w = 0.0
    sound.header.frame_id, sound.transform.translation.z = "openarm_body_link0", 0.3
    edges.publish(TFMessage(transforms=[bad, sound]))

    def counts() -> dict[str, str]:
        return {v.key: v.value for v in reports[-1].status[0].values} if reports else {}

    ros.spin_until(lambda: counts().get("refused//tf_static"), what="the transform is reported")
    ros.spin_until(lambda: counts().get("refused//joint_states") == "6", what="six joint states are reported")
    ros.spin_until(lambda: listener.buffer._states, what="the good one")
    assert listener.buffer.latest() == (5, {"a": 0.1, "b": 0.2})
    assert list(listener.buffer._static) == ["table"]


def test_between_joint_states_a_joint_follows_its_velocities(ros) -> None:
    """The cubic in the middle: 20 ms / 8 of the difference of the velocities."""
    listener = RobotStateListener(ros.add(BaseNode("eye", Config)), RobotDescription.load())
    joints = ros.node.create_publisher(JointState, "/joint_states", reliable(100))
    ros.spin_until(joints.get_subscription_count, what="the eye listens")
    for t_ns, velocity in ((0, 0.1), (20_000_000, -0.1)):
        message = JointState(name=["openarm_right_joint1"], position=[0.3], velocity=[velocity])
        message.header.stamp = ns_to_stamp(t_ns)
        joints.publish(message)
    ros.spin_until(lambda: len(listener.buffer._states) == 2, what="both joint states")
    assert listener.buffer.joints_at(10_000_000)["openarm_right_joint1"] == pytest.approx(0.3005, abs=1e-6)


def test_joint_states_are_subscribed_to_while_any_user_wants_them(ros) -> None:
    listener = RobotStateListener(ros.add(BaseNode("eye", Config)), RobotDescription.load(), joints=False)
    subscribers = lambda: ros.node.count_subscribers("/joint_states")  # noqa: E731
    listener.enable(True, "first")
    listener.enable(True, "second")
    listener.enable(False, "first")
    ros.spin_until(subscribers, what="one user is left")
    listener.enable(False, "second")
    ros.spin_until(lambda: not subscribers(), what="none is left")


def test_cameras_with_a_housing_follow_the_transforms_from_their_parents(ros) -> None:
    """A mount of calibration: of the wrist; what is no mount of a camera, or as before, is no news."""
    listener = RobotStateListener(ros.add(BaseNode("eye", Config)), RobotDescription.load())
    news = []
    listener.follow_mounts(news.append)
    camera = load_cameras()["wrist"]
    T = camera.T_parent_link @ se3.make(se3.rot_z(0.02), (0.01, -0.004, 0.003))
    static = ros.node.create_publisher(TFMessage, "/tf_static", QOS_STATIC_TF)
    mounts = [
        matrix_to_transform(camera.parent, camera.link_frame, T, 0),
        matrix_to_transform("openarm_body_link0", camera.link_frame, np.eye(4), 0),  # of another parent
        matrix_to_transform(camera.parent, "spectator_link", np.eye(4), 0),
    ]
    static.publish(TFMessage(transforms=mounts))
    ros.spin_until(lambda: news, what="the mount")
    assert np.allclose(news[0]["wrist"].T_parent_link, T)
    assert news[0]["overhead"] == load_cameras()["overhead"]
    heard = []
    listener.watch(lambda: heard.append(True))
    static.publish(TFMessage(transforms=mounts))
    ros.spin_until(lambda: heard, what="the second message")
    assert len(news) == 1
