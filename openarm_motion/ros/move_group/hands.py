# SPDX-License-Identifier: Apache-2.0
"""Hands as planning groups: a finger joint that goes to a position, by the action of its gripper controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from control_msgs.action import GripperCommand, ParallelGripperCommand
from moveit_msgs.msg import MotionPlanRequest, MoveItErrorCodes

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.actions import ActionClient, run_goal
from openarm_common.ros.node import BaseNode
from openarm_motion.config import MoveGroupConfig
from openarm_motion.ros.move_group.codes import MoveItError
from openarm_motion.service.robot import RobotWatch
from openarm_motion.timing.trajectory import Motion

if TYPE_CHECKING:
    from openarm_motion.constraints.names import RobotNames
    from openarm_motion.service.motion_service import MotionService

#: Shortest plan of a hand, s.
_SHORTEST = 0.1


class Hands:
    """Plans and executes motions of fingers.

    Args:
        node: Owner of the clients.
        config: Names and type of their actions, and how fast fingers are.
        service: Knows where they are.
        description: The robot.
        names: Names of its groups.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        config: MoveGroupConfig,
        service: MotionService,
        description: RobotDescription,
        names: RobotNames,
    ) -> None:
        self._config, self._service, self._description = config, service, description
        self.groups = names.hands()
        self._classic = config.gripper_action == "classic"
        kind = GripperCommand if self._classic else ParallelGripperCommand
        arms = sorted(set(self.groups.values()))
        self._clients = {arm: ActionClient(node, kind, config.gripper.format(arm=arm)) for arm in arms}

    def close(self) -> None:
        """Take the clients down."""
        for client in self._clients.values():
            client.destroy()

    def of_joints(self, names: Sequence[str]) -> str:
        """The arm whose fingers a trajectory moves; "": none. Joints that follow the driven one may be named, too."""
        fingers = {arm: self._description.finger_joint(arm) for arm in self._clients}
        return next((arm for arm, f in fingers.items() if f in names and set(names) <= self._followers(f)), "")

    def joints(self, arm: str) -> dict[str, tuple[str, ...]]:
        """Return the joint of an arm's fingers by the arm."""
        return {arm: (self._description.finger_joint(arm),)}

    def plan(self, message: MotionPlanRequest) -> Motion:
        """A straight motion of the fingers to the joint goal of a request, which is one that any group supports.

        Raises:
            OpenArmError: for any other kind of goal, and for path constraints; LIMITS; NOT_READY.
        """
        arm = self.groups[message.group_name]
        finger = self._description.finger_joint(arm)
        goals = message.goal_constraints
        joints = goals[0].joint_constraints if goals else []
        other = len(goals) != 1 or goals[0].position_constraints or goals[0].orientation_constraints
        if other or not joints or any(joint.joint_name not in self._followers(finger) for joint in joints):
            text = f"the goal of group {message.group_name!r} must be joint constraints of {finger!r} alone"
            raise MoveItError(MoveItErrorCodes.INVALID_GOAL_CONSTRAINTS, text)
        position = next((j.position for j in joints if j.joint_name == finger), joints[0].position)
        path = message.path_constraints
        if path.joint_constraints or path.position_constraints or path.orientation_constraints:
            text = f"path_constraints: group {message.group_name!r} goes straight to its goal, expected none"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        limits = self._description.joint(finger)
        if not limits.lower - 1e-6 <= position <= limits.upper + 1e-6:
            text = f"{finger} is to go to {position:g}, limits {limits.lower:g} to {limits.upper:g}"
            raise OpenArmError(Code.LIMITS, text)
        given = message.start_state.joint_state
        state = {**self._service.robot.states.latest()[1], **dict(zip(given.name, given.position, strict=False))}
        if finger not in state:
            raise OpenArmError(Code.NOT_READY, f"/joint_states lacks {finger}")
        ends = np.array([[state[finger]], [position]])
        share = self._service.arms[arm].scale(message.max_velocity_scaling_factor or 1.0)
        duration = max(_SHORTEST, float(np.ptp(ends)) / (self._config.finger_speed * share))
        return Motion((finger,), np.array([0.0, duration]), ends, np.zeros((2, 1)), np.zeros((2, 1)))

    async def execute(self, arm: str, motion: Motion, stopped: Callable[[], bool]) -> None:
        """Send the fingers to the end of a motion; what stops them before that is held, which is no failure.

        Raises:
            OpenArmError: NOT_READY, EXECUTION_FAILED or CANCELLED.
        """
        finger = self._description.finger_joint(arm)
        position = float(motion.q[-1][motion.names.index(finger)])
        client = self._clients[arm]
        if not client.server_is_ready():
            raise OpenArmError(Code.NOT_READY, f"no action server {client.name} (parameter move_group.gripper)")
        if self._classic:
            goal: Any = GripperCommand.Goal()
            goal.command.position = position
        else:
            goal = ParallelGripperCommand.Goal()
            goal.command.name, goal.command.position = [finger], [position]
        watch = RobotWatch(self._service.robot)
        result = await run_goal(client, goal, lambda done, limit: watch.until(done, limit=limit), stopped=stopped)
        if stopped():
            raise OpenArmError(Code.CANCELLED, f"cancelled; the {arm} hand holds where it is")
        if not (result.reached_goal or result.stalled):
            raise OpenArmError(Code.EXECUTION_FAILED, f"{client.name}: the fingers neither arrived nor met anything")

    def _followers(self, finger: str) -> set[str]:
        return {finger, *(j.name for j in self._description.joints.values() if j.mimic == finger)}
