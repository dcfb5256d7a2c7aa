# SPDX-License-Identifier: Apache-2.0
"""The controller of a gripper on the graph, with either of the two actions that such controllers have.

Both move the driving finger joint: position in m from the middle (0 closed, 0.044 open), as ros2_control's gripper
controllers do; effort in N. A gripper's result has no text, so a goal that is refused is rejected, with the reason in
the log.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from control_msgs.action import GripperCommand, ParallelGripperCommand
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from sensor_msgs.msg import JointState

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import BaseNode
from openarm_sim_bridge.control.actuation import End
from openarm_sim_bridge.control.gripper import GripperFollower, GripperGoal, GripperOutcome
from openarm_sim_bridge.ros.trajectory_server import Waiting
from openarm_sim_bridge.simulation import Simulation

GripperAction = Literal["parallel", "classic"]


@dataclass(frozen=True)
class _Type:
    """An action type, and how its goals and results read; joint by name."""

    action: type
    goal_of: Callable[[Any, str], GripperGoal]
    result_of: Callable[[GripperOutcome, str], Any]


class GripperActionServer:
    """/{side}_gripper_controller/gripper_cmd, of one type: a name can't carry two.

    Args:
        node: Owner.
        side: left or right.
        follower: Of the gripper.
        simulation: Whose thread works the follower.
        action: parallel (ParallelGripperCommand) or classic (GripperCommand).
    """

    def __init__(
        self, node: BaseNode[Any], side: str, follower: GripperFollower, simulation: Simulation, action: GripperAction
    ) -> None:
        self._node = node
        self._side = side
        self._follower = follower
        self._simulation = simulation
        self._type = _TYPES[action]
        self._joint = follower.group.names[0]
        self._column = simulation.world.joint_names.index(self._joint)
        self._server = ActionServer(
            node,
            self._type.action,
            f"/{side}_gripper_controller/gripper_cmd",
            self._execute,
            goal_callback=self._judge,
            cancel_callback=self._cancel,
        )

    def destroy(self) -> None:
        """Take the action away."""
        self._server.destroy()

    def _judge(self, request: Any) -> GoalResponse:
        try:
            self._simulation.check_able()
            self._follower.check(self._type.goal_of(request, self._joint))
        except OpenArmError as error:
            self._node.get_logger().error(f"{self._side} gripper goal rejected: {error}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _cancel(self, _handle: ServerGoalHandle) -> CancelResponse:
        self._simulation.call(self._follower.cancel)
        return CancelResponse.ACCEPT

    async def _execute(self, handle: ServerGoalHandle) -> Any:
        waiting: Waiting[GripperOutcome] = Waiting(self._node)
        goal = self._follower.check(self._type.goal_of(handle.request, self._joint))
        self._simulation.call(lambda: self._start(goal, waiting.done)).add_done_callback(waiting.started)
        if handle.is_cancel_requested:
            self._simulation.call(self._follower.cancel)
        outcome: GripperOutcome | None = await waiting.future
        if outcome is None:  # the simulation is shutting down
            handle.abort()
            return self._type.action.Result()
        if outcome.end is End.SUCCEEDED:
            handle.succeed()
        elif outcome.end is End.CANCELLED:
            handle.canceled()
        else:
            handle.abort()
            self._node.get_logger().warning(f"{self._side} gripper: {outcome.text}")
        return self._type.result_of(outcome, self._joint)

    def _start(self, goal: GripperGoal, done: Callable[[GripperOutcome], None]) -> None:
        state = self._simulation.world.read_joints()
        self._follower.start(goal, float(state.position[self._column]), float(state.effort[self._column]), done)


def _parallel_goal(request: ParallelGripperCommand.Goal, joint: str) -> GripperGoal:
    """Goal of a command that names the finger joint, or no joint at all.

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
