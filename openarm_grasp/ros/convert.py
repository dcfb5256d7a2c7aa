# SPDX-License-Identifier: Apache-2.0
"""Between messages and what a robot is asked and answers. Poses are in the base frame unless a name says otherwise."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
from control_msgs.action import GripperCommand, ParallelGripperCommand
from openarm_interfaces.action import MoveArm, PlanApproach
from openarm_interfaces.msg import ApproachTarget, CollisionBox
from openarm_interfaces.srv import ComputeIK
from sensor_msgs.msg import JointState

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import matrix_to_pose, vector, xyz
from openarm_common.ros.node import BASE_FRAME
from openarm_common.types import Array
from openarm_grasp.evidence.verdicts import Verdict
from openarm_grasp.planning.candidates import Box, GraspCandidate, PlaceTarget
from openarm_grasp.planning.options import NoWayError
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace


def box_to_msg(box: Box) -> CollisionBox:
    """A collision box; its frame is that of its user."""
    return CollisionBox(id=box.id, pose=matrix_to_pose(box.T_frame_box), size=vector(box.size))


def plan_goal(request: PlanGrasp | PlanPlace, velocity_scale: float) -> PlanApproach.Goal:
    """The planning goal of a grasp (the target may be touched, and is carried on the retreat) or of a place."""
    goal = PlanApproach.Goal(
        arm=request.arm,
        ignore_regions=[box_to_msg(box) for box in request.ignore_regions],
        velocity_scale=velocity_scale,
    )
    if isinstance(request, PlanGrasp):
        goal.targets = _targets(request.candidates)
        goal.obstacles = [box_to_msg(box) for box in (*request.obstacles, request.target)]
        goal.touchable, goal.attached_after_approach = [request.target.id], True
        return goal
    goal.targets = _targets(request.targets)
    goal.obstacles = [box_to_msg(box) for box in request.obstacles]
    goal.attached, goal.detached_after_approach = [box_to_msg(request.held)], True
    if request.after is not None:
        points = getattr(request.after, "points", None)
        if not points:
            raise OpenArmError(Code.INTERNAL, f"{type(request.after).__name__} is not a trajectory with points")
        goal.start = list(points[-1].positions)
    return goal


def _targets(ways: Iterable[GraspCandidate | PlaceTarget]) -> list[ApproachTarget]:
    return [
        ApproachTarget(
            id=way.id,
            pose=matrix_to_pose(way.T_base_tcp),
            approach_offset=vector(way.approach_offset),
            retreat_offset=vector(way.retreat_offset),
            score=way.score,
        )
        for way in ways
    ]


def planned_from_msg(result: PlanApproach.Result, offered: int) -> Planned:
    """A plan, or why there is none.

    Raises:
        OpenArmError: With the planner's code, when it found no plan; INTERNAL, when it chose what was not offered.
    """
    refusals = {r.id: Verdict(code_from_text(r.code, Code.NO_PLAN), r.message) for r in result.refusals}
    if not result.success:
        raise NoWayError(code_from_text(result.code, Code.NO_PLAN), result.message or "no plan", refusals)
    if not 0 <= result.chosen < offered:
        raise OpenArmError(Code.INTERNAL, f"the planner chose target {result.chosen} of {offered}")
    return Planned(
        result.chosen,
        result.transfer,
        result.approach,
        result.retreat,
        refusals,
        tuple(result.limit_margins),
    )


def gripper_goal(
    action: Literal["parallel", "classic"], joint: str, position: float, effort: float = 0.0
) -> ParallelGripperCommand.Goal | GripperCommand.Goal:
    """Goal of either gripper action: the driving finger at a position, m, with at most an effort, N.

    An effort of 0 leaves it to the controller.
    """
    if action == "classic":
        goal = GripperCommand.Goal()
        goal.command.position, goal.command.max_effort = position, effort
        return goal
    command = JointState(name=[joint], position=[position], effort=[effort] if effort > 0.0 else [])
    return ParallelGripperCommand.Goal(command=command)


def reach_request(arm: str, T_base_tcp: Array) -> ComputeIK.Request:
    """Ask how near an arm's TCP comes to a point, in any orientation."""
    request = ComputeIK.Request(arm=arm, position_only=True)
    request.pose.header.frame_id = BASE_FRAME
    request.pose.pose = matrix_to_pose(T_base_tcp)
    return request


def reach_from_msg(arm: str, answer: ComputeIK.Response, T_base_tcp: Array) -> dict[str, float]:
    """Distance in m by arm; empty when the answer says nothing about it."""
    if answer.success:
        return {arm: answer.position_error}
    if answer.code != Code.UNREACHABLE:
        return {}
    return {arm: float(np.linalg.norm(xyz(answer.nearest.position) - T_base_tcp[:3, 3]))}


def move_goal(
    arm: str, to: str | Array, obstacles: Sequence[Box], velocity_scale: float, max_start_delay: float
) -> MoveArm.Goal:
    """A free path to a named posture, or a straight line of the TCP to a pose.

    Args:
        arm: Which.
        to: Name of the posture, or the pose (4, 4), base frame.
        obstacles: Boxes to keep clear of, base frame.
        velocity_scale: Of the motion limits; 0: the planner's default.
        max_start_delay: Longest start delay until the other arm leaves clearance, s.
    """
    goal = MoveArm.Goal(
        arm=arm,
        obstacles=[box_to_msg(box) for box in obstacles],
        hand_empty=True,
        velocity_scale=velocity_scale,
        max_start_delay=max_start_delay,
    )
    if isinstance(to, str):
        goal.kind, goal.named = MoveArm.Goal.NAMED, to
        return goal
    goal.kind, goal.pose.header.frame_id = MoveArm.Goal.LINEAR, BASE_FRAME
    goal.pose.pose = matrix_to_pose(to)
    return goal


def code_from_text(text: str, otherwise: Code) -> Code:
    """The code that a message names; `otherwise` for one that is not of the suite, or claims success in a failure."""
    return Code(text) if text in Code.__members__ and text != Code.OK else otherwise
