# SPDX-License-Identifier: Apache-2.0
"""Joint states for nodes: none is lost while a node works on something else."""

from __future__ import annotations

import pytest
from sensor_msgs.msg import JointState

from openarm_common.config import Config
from openarm_common.convert import ns_to_stamp
from openarm_common.description import RobotDescription
from openarm_common.node import BaseNode, reliable
from openarm_common.tf import RobotStateListener


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
    for number in range(1, 61):  # nobody spins meanwhile
        publish(number)
    joints.wait_for_all_acked()
    ros.spin_until(lambda: listener.buffer.latest()[0] == 600_000_000, what="the last")
    assert len(listener.buffer.between(10_000_000, 600_000_000)) == kept
