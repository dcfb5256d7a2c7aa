# SPDX-License-Identifier: Apache-2.0
"""Joint states for nodes: none is lost while a node works, and what the hands hold."""

from __future__ import annotations

import pytest
from sensor_msgs.msg import JointState
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common.config import Config
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import ns_to_stamp
from openarm_common.ros.node import QOS_LATCHED, BaseNode, reliable
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
    listener._node.get_logger().warning = rejected.append
    publisher.publish(marker("openarm_right_hand_tcp", -1.0))
    ros.spin_until(lambda: rejected, what="the damaged message is named")
    assert "expected a cube with edges" in rejected[0]
    assert [box.link for box in listener.tracker.held] == ["openarm_right_hand_tcp"]


def test_joint_states_are_subscribed_to_while_any_user_wants_them(ros) -> None:
    listener = RobotStateListener(ros.add(BaseNode("eye", Config)), RobotDescription.load(), joints=False)
    subscribers = lambda: ros.node.count_subscribers("/joint_states")  # noqa: E731
    listener.enable(True, "first")
    listener.enable(True, "second")
    listener.enable(False, "first")
    ros.spin_until(subscribers, what="one user is left")
    listener.enable(False, "second")
    ros.spin_until(lambda: not subscribers(), what="none is left")
