# SPDX-License-Identifier: Apache-2.0
"""The action of a gripper controller, of either type that such controllers have.

Both types move the driving finger joint, as the gripper controllers of ros2_control do: positions in m from the middle
and efforts in N, or rad and N m where it is a hinge. The result of a gripper has no text, so an invalid goal is
rejected and the reason logged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from control_msgs.action import GripperCommand, ParallelGripperCommand
from rclpy.action import GoalResponse
from rclpy.action.server import ServerGoalHandle
from sensor_msgs.msg import JointState

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import BaseNode
from openarm_control.arm import End
from openarm_control.gripper import GripperAction, GripperFollower, GripperGoal, GripperOutcome
from openarm_control.loop import ControlLoop
from openarm_control.ros.controller_server import ControllerServer


@dataclass(frozen=True)
class _Type:
    """An action type with the conversions of its goals and results; joint by name."""

    action: type
    goal_of: Callable[[Any, str], GripperGoal]
    result_of: Callable[[GripperOutcome, str], Any]


class GripperServer(ControllerServer[GripperOutcome]):
    """/{side}_gripper_controller/gripper_cmd, of one type: a name can't carry two.

    Args:
        node: Owner.
        prefix: Prefix of its name.
        side: left or right.
        gripper: Its controller.
        loop: Loop whose thread runs the controller.
        check: Refuses a goal, by its id, while another client holds the arm.
        action: parallel (ParallelGripperCommand) or classic (GripperCommand).
    """

    def __init__(
        self,
        node: BaseNode[Any],
        prefix: str,
        side: str,
        gripper: GripperFollower,
        loop: ControlLoop,
        check: Callable[[bytes], None],
        action: GripperAction,
    ) -> None:
        self._gripper = gripper
        self._type = _TYPES[action]
        self._joint = gripper.group.names[0]
        name = f"{prefix}/{side}_gripper_controller/gripper_cmd"
        super().__init__(node, loop, check, f"{side} gripper", self._type.action, name, gripper.cancel)

    def _on_goal(self, request: Any) -> GoalResponse:
        try:
            self._loop.check_able()
            self._gripper.check(self._type.goal_of(request, self._joint))
        except OpenArmError as error:
            self._node.get_logger().error(f"{self._label} goal rejected: {error}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    async def _execute(self, handle: ServerGoalHandle) -> Any:
        goal = self._gripper.check(self._type.goal_of(handle.request, self._joint))
        try:
            outcome = await self._follow(handle, lambda done: self._start(goal, done))
        except OpenArmError as error:
            self._end(handle, End.ABORTED, f"{error.code}: {error.message}")
            return self._type.action.Result()
        self._end(handle, outcome.end, outcome.text)
        return self._type.result_of(outcome, self._joint)

    def _start(self, goal: GripperGoal, done: Callable[[GripperOutcome], None]) -> None:
        self._loop.check_able()
        state = self._loop.read_joints(self._gripper.group)
        self._gripper.start(goal, float(state.position[0]), float(state.effort[0]), done)


def _parallel_goal(request: ParallelGripperCommand.Goal, joint: str) -> GripperGoal:
    """Return the goal of a command that names the finger joint, or no joint at all.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for other joints or no position.
    """
    command = request.command
    if list(command.name) not in ([], [joint]) or len(command.position) != 1:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"gripper command of joints {list(command.name)} with {len(command.position)} positions, expected one"
            f" position of {joint!r}",
        )
    return GripperGoal(
        position=command.position[0],
        max_effort=command.effort[0] if len(command.effort) else 0.0,
        max_velocity=command.velocity[0] if len(command.velocity) else 0.0,
    )


def _parallel_result(outcome: GripperOutcome, joint: str) -> ParallelGripperCommand.Result:
    state = JointState(name=[joint], position=[outcome.position], velocity=[0.0], effort=[outcome.effort])
    return ParallelGripperCommand.Result(state=state, stalled=outcome.stalled, reached_goal=outcome.reached_goal)


def _classic_goal(request: GripperCommand.Goal, _joint: str) -> GripperGoal:
    return GripperGoal(position=request.command.position, max_effort=request.command.max_effort)


def _classic_result(outcome: GripperOutcome, _joint: str) -> GripperCommand.Result:
    return GripperCommand.Result(
        position=outcome.position, effort=outcome.effort, stalled=outcome.stalled, reached_goal=outcome.reached_goal
    )


_TYPES: Mapping[GripperAction, _Type] = {
    "parallel": _Type(ParallelGripperCommand, _parallel_goal, _parallel_result),
    "classic": _Type(GripperCommand, _classic_goal, _classic_result),
}
