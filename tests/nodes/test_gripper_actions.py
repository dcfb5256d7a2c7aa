# SPDX-License-Identifier: Apache-2.0
"""The two types of gripper_cmd: what the bridge serves and what the grasp node asks for go by the same parameter."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from action_msgs.msg import GoalStatus
from control_msgs.action import GripperCommand
from control_msgs.msg import GripperCommand as Command
from rclpy.action import ActionClient, get_action_names_and_types

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.ros.node import GraspNode
from tests.conftest import own_domain

NAME = "/right_gripper_controller/gripper_cmd"
TYPES = {"parallel": "ParallelGripperCommand", "classic": "GripperCommand"}


def client_of(bench) -> ActionClient:
    return ActionClient(bench.ros.node, GripperCommand, NAME)


@pytest.fixture
def ros_domain() -> Iterator[int]:
    """A domain for each test: one participant cannot serve an action with two types."""
    with own_domain() as domain:
        yield domain


@pytest.mark.requirement("P-22")
def test_the_classic_action_reaches_the_real_joint(bridge) -> None:
    position = 0.025
    bench = bridge(images=False, gripper_action="classic")
    goal = GripperCommand.Goal(command=Command(position=position, max_effort=10.0))
    handle, future = bench.ros.send_goal(client_of(bench), goal)
    assert handle.accepted
    answer = bench.ros.result(future)
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert (answer.result.reached_goal, answer.result.stalled) == (True, False)
    assert answer.result.position == pytest.approx(position, abs=0.001)
    bench.ros.spin_until(lambda: abs(bench.position(bench.FINGER) - position) < 0.001, what="a joint state of it")
    bad, _ = bench.ros.send_goal(client_of(bench), GripperCommand.Goal(command=Command(position=0.2)))
    assert not bad.accepted


@pytest.mark.parametrize("action", TYPES)
def test_the_grasp_node_speaks_the_type_that_the_bridge_serves(bridge, action: str) -> None:
    bench = bridge(images=False, gripper_action=action)
    ros = bench.ros
    grasp = ros.start(GraspNode, gripper_action=action)
    faults: list[OpenArmError] = []

    async def grip() -> bool:
        try:
            await grasp._robot._nodes.begin(list)
            return await grasp._robot.grip("right", bench.FINGER, 0.03, "open")
        except OpenArmError as error:  # one that left the task would end the executor
            faults.append(error)
            return False

    assert ros.result(ros.executor.create_task(grip)), faults
    ros.spin_until(lambda: abs(bench.position(bench.FINGER) - 0.03) < 0.001, what="a joint state of it")
    assert dict(get_action_names_and_types(ros.node))[NAME] == [f"control_msgs/action/{TYPES[action]}"]


def test_a_wrong_type_is_refused_by_name(ros) -> None:
    with pytest.raises(OpenArmError, match=r"gripper_action.*'parallel', 'classic' or 'trajectory'") as caught:
        ros.start(GraspNode, gripper_action="suction")
    assert caught.value.code is Code.CONFIG_INVALID


@pytest.mark.requirement("R-03")
def test_a_gripper_behind_a_trajectory_controller_is_asked_for_a_position(bridge) -> None:
    """As openarm_ros2 has it: the goal succeeds when its time is over, joint states say where the fingers are."""
    bench = bridge(images=False, controllers="openarm_ros2")
    ros, name = bench.ros, "/{arm}_gripper_controller/follow_joint_trajectory"
    grasp = ros.start(GraspNode, gripper_action="trajectory", gripper=name)

    async def grip() -> bool:
        await grasp._robot._nodes.begin(list)
        return await grasp._robot.grip("right", bench.FINGER, 0.03, "open")

    assert ros.result(ros.executor.create_task(grip))
    ros.spin_until(lambda: abs(bench.position(bench.FINGER) - 0.03) < 0.001, what="a joint state of it")
