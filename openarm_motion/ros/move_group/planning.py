# SPDX-License-Identifier: Apache-2.0
"""Requests of MoveIt for plans and motions, as requests to the motion service."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from moveit_msgs.action import ExecuteTrajectory
from moveit_msgs.msg import MotionPlanRequest, MoveItErrorCodes, WorkspaceParameters
from moveit_msgs.srv import GetCartesianPath

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import trajectory_from_msg, xyz
from openarm_motion.collision.solids import Box
from openarm_motion.constraints.asked import CartesianGoal, RegionGoal
from openarm_motion.ros.move_group.codes import MoveItError
from openarm_motion.ros.move_group.convert import Converter, as_moveit
from openarm_motion.ros.move_group.fields import CARTESIAN, EXECUTE, PLAN, check_fields
from openarm_motion.scene.bodies import SceneBody, boxes_about
from openarm_motion.service.requests import ArmGoal, MoveArmsRequest, MoveRequest
from openarm_motion.timing.trajectory import Motion

if TYPE_CHECKING:
    from openarm_motion.constraints.names import RobotNames
    from openarm_motion.service.motion_service import MotionService

#: Name of the planning pipeline.
PIPELINE = "openarm"
#: Longest planning time, s.
_LONGEST = 120.0
#: A base on the border of a workspace is in it, m.
_ROUNDED = 1e-6
#: A joint state that names the present configuration to within this has no other one in mind, rad.
_PRESENT = 1e-3


class Requests:
    """Makes requests of messages.

    Args:
        service: Answers them.
        names: Names of groups and links.
        convert: Messages to core data.
    """

    def __init__(self, service: MotionService, names: RobotNames, convert: Converter) -> None:
        self._service, self._names, self._convert = service, names, convert

    def check(self, message: MotionPlanRequest) -> None:
        """Refuse what no group supports, and what makes no sense.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming the field.
        """
        check_fields(message, PLAN, "plan request")
        self._check_pipeline(message.pipeline_id, message.planner_id)
        self._check_workspace(message.workspace_parameters)
        limit = message.allowed_planning_time
        if not 0.0 <= limit <= _LONGEST or message.num_planning_attempts < 0:
            text = f"allowed_planning_time is {limit:g} s and num_planning_attempts {message.num_planning_attempts}"
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"{text}, expected numbers >= 0 (0: the default), at most {_LONGEST:g} s"
            )
        self._scale(message)

    def plan(self, message: MotionPlanRequest, *, execute: bool = False) -> MoveRequest | MoveArmsRequest:
        """What a plan request, which `check` has passed, asks of the one arm or two of its group.

        Raises:
            OpenArmError: for what is not supported, or makes no sense.
        """
        arms = self.arms(message.group_name)
        goals = [parts for one in message.goal_constraints if any(parts := self._convert.regions(one, arms))]
        path = self._convert.regions(message.path_constraints, arms)
        if not goals:
            text = "goal_constraints has no constraint, expected at least one"
            raise MoveItError(MoveItErrorCodes.INVALID_GOAL_CONSTRAINTS, text)
        if len(arms) > 1 and (len(goals) > 1 or any(path)):
            what = "path_constraints" if any(path) else f"goal_constraints has {len(goals)} alternatives, expected one"
            text = f"{what}: not for a group of two arms; groups of one: {', '.join(self._single())}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        limit, held = message.allowed_planning_time, self._held(message, arms)
        asked = {arm: RegionGoal(tuple(g[k] for g in goals), path[k], limit) for k, arm in enumerate(arms)}
        common: dict[str, Any] = {
            "scale": self._scale(message),
            "plan_only": not execute,
            "state": {} if execute else self._given(self._convert.state(message.start_state)),
            "attempts": max(message.num_planning_attempts, 1),
        }
        if len(arms) == 1:
            return MoveRequest(arms[0], asked[arms[0]], attached=held[arms[0]], **common)
        targets = tuple(ArmGoal(arm, goal, held[arm]) for arm, goal in asked.items())
        return MoveArmsRequest(targets, time_limit=limit, **common)

    def note(self, message: MotionPlanRequest, *, execute: bool) -> str:
        """What the answer says of weights that differ, and of a start that is not where the robot is now."""
        parts = [*message.goal_constraints, message.path_constraints]
        found = [(p.joint_constraints, p.position_constraints, p.orientation_constraints) for p in parts]
        weights = {one.weight or 1.0 for lists in found for constraints in lists for one in constraints}
        said = ", ".join(f"{weight:g}" for weight in sorted(weights))
        text = f"; every constraint is met, whatever its weight ({said})" if len(weights) > 1 else ""
        elsewhere = execute and self._given(self._convert.state(message.start_state))
        return f"{text}; it started where the arm was, not in start_state" if elsewhere else text

    def cartesian(self, message: GetCartesianPath.Request) -> MoveRequest:
        """What a request for a Cartesian path asks.

        Raises:
            OpenArmError: as `plan`.
        """
        check_fields(message, CARTESIAN, "request for a Cartesian path")
        arm = self.arm(message.group_name)
        numbers = (message.max_step, message.revolute_jump_threshold, message.jump_threshold)
        if not np.isfinite(numbers).all() or min(numbers) < 0.0:
            text = "max_step, revolute_jump_threshold, jump_threshold"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{text} are {numbers}, expected numbers >= 0")
        if message.prismatic_jump_threshold != 0.0 and self._service.arms[arm].kinematics.prismatic.any():
            text = f"prismatic_jump_threshold is {message.prismatic_jump_threshold:g}: not for joints that slide"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{text}, expected 0; jump_threshold is for all joints")
        T_link_tool = se3.inverse(self._convert.on_tool(arm, message.link_name))
        frame = message.header.frame_id
        goal = CartesianGoal(
            tuple(self._convert.pose(pose, frame) @ T_link_tool for pose in message.waypoints),
            message.max_step,
            message.revolute_jump_threshold,
            message.jump_threshold,
            message.avoid_collisions,
            self._convert.region(message.path_constraints, arm),
        )
        state = self._given(self._convert.state(message.start_state))
        return MoveRequest(arm, goal, scale=self._scale(message), plan_only=True, state=state)

    def execute(self, message: ExecuteTrajectory.Goal, controller: Callable[[str], str]) -> dict[str, Motion]:
        """The motions, by arm, that a goal of /execute_trajectory asks for.

        Args:
            message: The goal.
            controller: Name of an arm's controller.

        Raises:
            OpenArmError: as `plan`.
        """
        check_fields(message, EXECUTE, "trajectory")
        names, t, q, v, a = trajectory_from_msg(message.trajectory.joint_trajectory)
        arms = self._names.arms_of_joints(names)
        if not arms:
            known = "; ".join(f"{name}: {', '.join(arm.names)}" for name, arm in self._service.arms.items())
            text = f"a trajectory of joints {', '.join(names) or '(none)'}; expected those of one arm or two ({known})"
            raise MoveItError(MoveItErrorCodes.INVALID_MOTION_PLAN, text)
        there = [controller(arm) for arm in arms]
        unknown = [name for name in message.controller_names if name not in there]
        if unknown:
            text = f"controller_names has {unknown[0]!r}; the joints are those of {', '.join(map(repr, there))}"
            raise MoveItError(MoveItErrorCodes.CONTROL_FAILED, text)
        whole = Motion(tuple(names), t, q, v, a)
        return {arm: whole.of(self._service.arms[arm].names) for arm in arms}

    def arms(self, group: str) -> tuple[str, ...]:
        """The arm, or the two arms, of a planning group.

        Raises:
            MoveItError: INVALID_GROUP_NAME.
        """
        with as_moveit(MoveItErrorCodes.INVALID_GROUP_NAME):
            return self._names.arms_of_group(group)

    def arm(self, group: str) -> str:
        """The arm of a planning group; raises as `arms`, for a group of two arms, too."""
        first, *others = self.arms(group)
        if others:
            text = f"group {group!r} has the joints of two arms; groups of one: {', '.join(self._single())}"
            raise MoveItError(MoveItErrorCodes.INVALID_GROUP_NAME, text)
        return first

    def _single(self) -> list[str]:
        return [group for group, arms in self._names.groups().items() if len(arms) == 1]

    def _scale(self, message: MotionPlanRequest | GetCartesianPath.Request) -> tuple[float, float]:
        """Scales of velocity and acceleration."""
        names = ("max_velocity_scaling_factor", "max_acceleration_scaling_factor")
        velocity, acceleration = (float(getattr(message, name)) for name in names)
        for name, value in zip(names, (velocity, acceleration), strict=True):
            next(iter(self._service.arms.values())).scale(value, name)
        return velocity, acceleration

    def _given(self, state: dict[str, float]) -> dict[str, float]:
        """What a state says other than that the robot is where it is."""
        if self._service.robot.state_age() == float("inf"):
            return state
        present = self._service.robot.states.latest()[1]
        if all(abs(value - present.get(name, np.inf)) <= _PRESENT for name, value in state.items()):
            return {}
        return state

    def _held(self, message: MotionPlanRequest, arms: Sequence[str]) -> dict[str, tuple[Box, ...]]:
        """Boxes that the start state says each of the arms holds, tool frame."""
        out: dict[str, tuple[Box, ...]] = dict.fromkeys(arms, ())
        for attached in message.start_state.attached_collision_objects:
            link, body = attached.link_name, attached.object
            with as_moveit(MoveItErrorCodes.INVALID_LINK_NAME):
                arm = self._names.arm_of_link(link)
                if arm not in arms:
                    raise OpenArmError(Code.INVALID_ARGUMENT, f"{body.id!r} is attached to {link!r}, not of the group")
            self.check_touch(attached.touch_links, arm)
            T, shapes = self._convert.shapes(body)
            if not shapes:
                text = f"attached object {body.id!r} of the start state has no shape"
                raise MoveItError(MoveItErrorCodes.INVALID_OBJECT_NAME, text)
            state = {**self._service.robot.states.latest()[1], **self._convert.state(message.start_state)}
            kinematics = self._service.arms[arm].kinematics
            T_base_tool = kinematics.fk(np.array([state[name] for name in kinematics.names]))
            out[arm] += tuple(boxes_about(SceneBody(body.id, T, shapes).moved(se3.inverse(T_base_tool))))
        return out

    def check_touch(self, links: list[str], arm: str) -> None:
        """Refuse links that may not touch what a hand holds: those of the hand always may.

        Raises:
            MoveItError: INVALID_LINK_NAME.
        """
        hand = self._service.arms[arm].robot.arm.hand
        other = [link for link in links if link not in hand and link not in self._names.links_on_tool(arm)]
        if other:
            text = f"touch_links has {other[0]!r}; links of the hand, which always may touch: {', '.join(sorted(hand))}"
            raise MoveItError(MoveItErrorCodes.INVALID_LINK_NAME, text)

    def _check_pipeline(self, pipeline: str, planner: str) -> None:
        known = self._service.config.planning.planner
        if pipeline not in ("", PIPELINE):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"pipeline_id is {pipeline!r}, expected {PIPELINE!r} or empty")
        if planner not in ("", known):
            text = f"planner_id is {planner!r}, expected {known!r} (parameter planning.planner) or empty"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)

    def _check_workspace(self, message: WorkspaceParameters) -> None:
        """As in MoveIt a workspace bounds the base of the robot, which stands where it is; zeros bound nothing."""
        low, high = xyz(message.min_corner), xyz(message.max_corner)
        if not np.isfinite([*low, *high]).all() or (low > high).any():
            text = f"workspace_parameters from {low.tolist()} to {high.tolist()} m, expected min_corner <= max_corner"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        base = se3.inverse(self._convert.in_base(np.eye(4), message.header.frame_id))[:3, 3]
        if (low != high).any() and ((base < low - _ROUNDED) | (base > high + _ROUNDED)).any():
            text = f"workspace_parameters from {low.tolist()} to {high.tolist()} m leave the robot's base out, which is"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{text} at {base.round(3).tolist()} m of their frame")
