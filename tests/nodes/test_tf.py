# SPDX-License-Identifier: Apache-2.0
"""Joint states for nodes: none is lost while a node works, and a posture does not depend on what arrived first."""

from __future__ import annotations

import time

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import ns_to_stamp
from openarm_common.ros.node import BaseNode, reliable
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
    for number in range(1, 61):  # nobody spins meanwhile
        publish(number)
    joints.wait_for_all_acked()
    ros.spin_until(lambda: listener.buffer.latest()[0] == 600_000_000, what="the last")
    assert len(listener.buffer.between(10_000_000, 600_000_000)) == kept


MS = 1_000_000
ROBOT = RobotDescription.load()
ARM = ROBOT.arm_joints("left")
HAND = "openarm_left_hand"


class Eye:
    """A listener that waits a minute for a posture, longer than any test."""

    def __init__(self, ros, wait: float = 60.0) -> None:
        self.node = ros.add(BaseNode("eye", Config))
        self.listener = RobotStateListener(self.node, ROBOT, wait=wait)

    def at(self, t_ms: int, q: float) -> None:
        self.listener.buffer.add_joint_state(t_ms * MS, ARM, [q] * len(ARM))

    def posture(self, frame: str, t_ms: int, *, joints: bool = False):
        return self.listener.posture(frame, t_ms * MS, time.monotonic(), joints=joints)


@pytest.mark.parametrize(("frame", "joints"), [(HAND, False), ("openarm_body_link0", True)])
@pytest.mark.requirement("B-61")
def test_a_posture_waits_for_the_joint_state_after_its_stamp(ros, frame: str, joints: bool) -> None:
    """However near the one before is; and is then between the two."""
    eye = Eye(ros)
    assert eye.posture(frame, 103, joints=joints) is None
    eye.at(100, 0.0)
    assert eye.posture(frame, 103, joints=joints) is None
    eye.at(110, 0.1)
    found = eye.posture(frame, 103, joints=joints)
    between = dict.fromkeys(ARM, 0.03)
    np.testing.assert_allclose(found.T_base_frame, ROBOT.link_pose(frame, between), atol=1e-12)
    assert found.joints == (pytest.approx(between) if joints else {})


def test_what_no_joint_moves_waits_for_none(ros) -> None:
    found = Eye(ros).posture("openarm_body_link0", 103)
    np.testing.assert_array_equal(found.T_base_frame, np.eye(4))


def test_a_posture_that_can_no_longer_come_is_refused_at_once(ros) -> None:
    """The joint states are past its stamp, or nobody listens to them."""
    eye = Eye(ros)
    eye.at(120, 0.0)
    with pytest.raises(OpenArmError, match=r"the nearest is \+17.0 ms away"):
        eye.posture(HAND, 103)
    eye.listener.enable(False)
    with pytest.raises(OpenArmError, match=r"the nearest is -80.0 ms away"):
        eye.posture(HAND, 200)


def test_when_the_time_is_over_what_is_there_must_do(ros) -> None:
    eye = Eye(ros, wait=0.0)
    eye.at(100, 0.2)
    assert eye.posture(HAND, 103, joints=True).joints == dict.fromkeys(ARM, 0.2)
    with pytest.raises(OpenArmError) as refused:
        eye.posture("camera", 103)
    assert refused.value.code is Code.NO_TRANSFORM


def test_a_frame_that_is_not_connected_yet_is_waited_for(ros) -> None:
    eye = Eye(ros)
    assert eye.posture("camera", 103) is None
    eye.listener.buffer.set_static("openarm_body_link0", "camera", np.eye(4))
    assert eye.posture("camera", 103) is not None
