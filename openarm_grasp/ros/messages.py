# SPDX-License-Identifier: Apache-2.0
"""Requests, answers, status, markers, and what a robot is asked, as messages. Poses are in the base frame."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from control_msgs.action import FollowJointTrajectory, GripperCommand, ParallelGripperCommand
from geometry_msgs.msg import Point
from openarm_interfaces.action import MoveArm, Pick, PickTwo, PlanApproach
from openarm_interfaces.msg import ApproachTarget, CollisionBox, GraspOption, GraspStatus, PickRequest, PickResult
from openarm_interfaces.msg import StateTime as StateTimeMsg
from openarm_interfaces.srv import ComputeIK, Grasp
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA, Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import matrix_to_pose, ns_to_stamp, point, stamp_to_ns, vector, xyz
from openarm_common.types import Array
from openarm_grasp.config import GripperAction
from openarm_grasp.planning.candidates import Box, GraspCandidate, PlaceTarget
from openarm_grasp.planning.options import NoWayError, Option, Refusal
from openarm_grasp.requests.confirm import ShownPlan
from openarm_grasp.requests.request import GraspOutcome, GraspRequest, PairOutcome
from openarm_grasp.requests.task import Status
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace

_CHOSEN = ColorRGBA(r=0.1, g=0.8, b=0.2, a=1.0)
_REFUSED = ColorRGBA(r=0.9, g=0.2, b=0.1, a=0.35)
_WAITING = ColorRGBA(r=0.95, g=0.6, b=0.1, a=1.0)
_OFFERED = ColorRGBA(r=0.4, g=0.5, b=0.9, a=0.35)

#: Time in which a trajectory moves the fingers, ns: the whole way at the speed of the other actions.
_GRIP_NS = 600_000_000

#: What the namespaces of the parts of a plan that waits begin with.
PLAN = "plan/"


# --- requests and answers
#: Fields of a request that have the same name in each message, and those of requests that are made alone.
_SAME, _ALONE = ("arm", "selection", "place_on"), ("dry_run", "confirm", "phase", "timeout", "velocity_scale")


def request_from_msg(message: Grasp.Request | Pick.Goal | PickRequest, **alone: Any) -> GraspRequest:
    """The request of a user, whose words are read here; a service request and an action goal have the same fields."""
    p, at = message.place_position, message.object_position
    names = _SAME if isinstance(message, PickRequest) else (*_SAME, *_ALONE)
    given = {name: getattr(message, name) for name in names if getattr(message, name) != ""}
    return GraspRequest.of(
        message.label,
        **given,
        **alone,
        place=(p.x, p.y, p.z) if message.has_place_position else None,
        place_yaw=message.place_yaw if message.has_place_yaw else None,
        object_at=(at.x, at.y) if message.has_object_position else None,
        exclude_near=tuple((p.x, p.y) for p in message.exclude_near),
        place_choices=tuple((p.x, p.y) for p in message.place_choices),
    )


def requests_from_msg(goal: PickTwo.Goal) -> tuple[GraspRequest, GraspRequest]:
    """Two requests at once."""
    run = {"dry_run": goal.dry_run, "timeout": goal.timeout, "velocity_scale": goal.velocity_scale}
    first, second = (request_from_msg(item, **run) for item in goal.requests)
    return first, second


def fill_request(message: Pick.Goal | PickRequest, asked: GraspRequest) -> None:
    """Write a request into an action goal, or into one of its requests.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a place that is not two or three numbers.
    """
    for name in ("label", *_SAME, *(() if isinstance(message, PickRequest) else _ALONE)):
        setattr(message, name, getattr(asked, name))
    if asked.place_yaw is not None:
        message.has_place_yaw, message.place_yaw = True, asked.place_yaw
    if (place := asked.place) is not None:
        if len(place) not in (2, 3):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"place {list(place)} must be x, y or x, y, z in metres")
        message.has_place_position, message.place_position = True, point((*place, 0.0)[:3])
    if (at := asked.object_at) is not None:
        message.has_object_position, message.object_position = True, point((at[0], at[1], 0.0))
    message.exclude_near, message.place_choices = (
        [point((x, y, 0.0)) for x, y in spots] for spots in (asked.exclude_near, asked.place_choices)
    )


def fill_answer(answer: Grasp.Response | Pick.Result | PickResult, outcome: GraspOutcome) -> None:
    """Write an outcome into a service response, an action result, or one of its answers."""
    for name in ("success", "message", "label", "arm", "attempts", "duration", "route"):
        setattr(answer, name, getattr(outcome, name))
    answer.outcome, answer.code = outcome.kind, outcome.code.value
    answer.place_position = point(outcome.place_position)
    if outcome.object_position is not None:
        answer.has_object_position, answer.object_position = True, point(outcome.object_position)
    answer.state_times = [StateTimeMsg(**asdict(one)) for one in outcome.state_times]
    if not isinstance(answer, PickResult):
        answer.options = [option_to_msg(option) for option in outcome.options]
        answer.recording = outcome.recording


def option_to_msg(option: Option) -> GraspOption:
    """The result of one grasp that was weighed."""
    parts = {"parts": list(option.parts), "values": list(option.parts.values())}
    return GraspOption(**asdict(option) | parts | {"code": str(option.code)})


def option_from_msg(message: GraspOption) -> Option:
    """The same, of an answer."""
    same = {one.name: getattr(message, one.name) for one in fields(Option)}
    return Option(**same | {"parts": dict(zip(message.parts, message.values, strict=True))})


def pair_result(outcome: PairOutcome) -> PickTwo.Result:
    """The answer to two requests."""
    names = ("success", "message", "simultaneous", "duration", "recording")
    same = {name: getattr(outcome, name) for name in names}
    result = PickTwo.Result(outcome=outcome.kind, code=outcome.code.value, **same)
    for one in outcome.answers:
        answer = PickResult()
        fill_answer(answer, one)
        result.results.append(answer)
    return result


def status_msg(status: Status, frame: str, t_ns: int) -> GraspStatus:
    """A state that was entered."""
    same = {name: getattr(status, name) for name in ("reason", "attempt", "label", "arm", "code", "budget")}
    state, plan = {"state": status.state.value, "previous_state": status.previous.value}, status.plan
    header = Header(stamp=ns_to_stamp(t_ns), frame_id=frame)
    return GraspStatus(header=header, plan_id=plan.id if plan else "", **state, **same)


# --- pictures
def status_markers(status: Status, robot: RobotDescription, t_ns: int) -> MarkerArray:
    """The candidates of a state, and the plan that waits in it; they replace what was shown before."""
    markers = candidate_markers(status.candidates, status.chosen, status.refused, robot.base, t_ns)
    if status.plan is not None:
        markers.markers += plan_markers(status.plan, robot, t_ns)
    return markers


def plan_markers(plan: ShownPlan, robot: RobotDescription, t_ns: int) -> list[Marker]:
    """The path of the TCP on each part of a plan, a point for each point of its trajectory."""
    link = robot.tcp_link(plan.arm)
    found: list[Marker] = []
    for i, (name, trajectory) in enumerate(plan.parts):
        if not isinstance(trajectory, JointTrajectory):
            raise OpenArmError(Code.INTERNAL, f"{type(trajectory).__name__} is not a trajectory of the graph")
        planned: Any = trajectory
        joints = (dict(zip(planned.joint_names, p.positions, strict=True)) for p in planned.points)
        path = _points(*(robot.link_pose(link, q)[:3, 3] for q in joints))
        line = Marker(ns=f"{PLAN}{name}", id=i, type=Marker.LINE_STRIP, color=_WAITING, points=path)
        line.header = Header(stamp=ns_to_stamp(t_ns), frame_id=robot.base)
        line.pose.orientation.w, line.scale.x = 1.0, 0.005
        found.append(line)
    return found


def candidate_markers(
    candidates: Sequence[GraspCandidate], chosen: str, refused: Collection[str], frame: str, t_ns: int
) -> MarkerArray:
    """An arrow along each approach and a bar along its opening axis: the chosen one green, what was refused red."""
    markers = [Marker(action=Marker.DELETEALL)]
    for i, c in enumerate(candidates):
        tip = c.T_base_tcp[:3, 3]
        half = 0.5 * c.width * c.T_base_tcp[:3, 1]
        color = _CHOSEN if c.id == chosen else _REFUSED if c.id in refused else _OFFERED
        shaft = _points(tip + c.approach_offset, tip)
        arrow = Marker(ns="approach", id=i, type=Marker.ARROW, color=color, points=shaft)
        arrow.scale = vector((0.004, 0.008, 0.012))
        bar = Marker(ns="opening", id=i, type=Marker.LINE_STRIP, color=color, points=_points(tip - half, tip + half))
        bar.scale.x = 0.003
        markers += [arrow, bar]
    for marker in markers:
        marker.header = Header(stamp=ns_to_stamp(t_ns), frame_id=frame)
        marker.pose.orientation.w = 1.0
    return MarkerArray(markers=markers)


def _points(*positions: np.ndarray) -> list[Point]:
    return [point(p) for p in positions]


# --- what a robot is asked
def box_to_msg(box: Box) -> CollisionBox:
    """A collision box; its frame is that of its user."""
    return CollisionBox(id=box.id, pose=matrix_to_pose(box.T_frame_box), size=vector(box.size))


def plan_goal(request: PlanGrasp | PlanPlace, velocity_scale: float) -> PlanApproach.Goal:
    """The planning goal of a grasp (the target may be touched, and is carried on the retreat) or of a place."""
    goal = PlanApproach.Goal(
        arm=request.arm,
        ignore_regions=[box_to_msg(box) for box in request.ignore_regions],
        velocity_scale=velocity_scale,
        blend_approach=request.blend,
    )
    if isinstance(request, PlanGrasp):
        goal.targets = _targets(request.candidates)
        goal.obstacles = [box_to_msg(box) for box in (*request.obstacles, *request.target)]
        goal.touchable, goal.attached_after_approach = [box.id for box in request.target], True
        goal.start = list(request.start)
        return goal
    goal.targets = _targets(request.targets)
    goal.obstacles = [box_to_msg(box) for box in request.obstacles]
    goal.attached, goal.detached_after_approach = [box_to_msg(box) for box in request.held], True
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


def planned_from_msg(result: PlanApproach.Result, offered: int, *, blend: bool = False) -> Planned:
    """A plan, blended or not, or why there is none.

    Raises:
        OpenArmError: the planner's code, when it found no plan; INTERNAL, when it chose what was not offered.
    """
    refusals = {
        r.id: Refusal(code_from_text(r.code, Code.NO_PLAN), r.message, bodies=(r.first, r.second))
        for r in result.refusals
    }
    if not result.success:
        raise NoWayError(code_from_text(result.code, Code.NO_PLAN), result.message or "no plan", refusals)
    if not 0 <= result.chosen < offered:
        raise OpenArmError(Code.INTERNAL, f"the planner chose target {result.chosen} of {offered}")
    parts = (result.transfer, result.approach, result.retreat)
    if not all(part.points for part in parts):
        raise OpenArmError(Code.INTERNAL, "the planner answered with a trajectory without points")
    first = result.transfer.points[0]
    return Planned(
        result.chosen,
        result.transfer,
        None if blend else result.approach,
        result.retreat,
        refusals,
        tuple(result.limit_margins),
        dict(zip(result.transfer.joint_names, first.positions, strict=True)),
        sum(stamp_to_ns(part.points[-1].time_from_start) * 1e-9 for part in parts),
        result.scene_version,
    )


#: Type of the action of a gripper by its name in the configuration.
GRIPPER_ACTIONS: Mapping[GripperAction, type] = {
    "parallel": ParallelGripperCommand,
    "classic": GripperCommand,
    "trajectory": FollowJointTrajectory,
}


def gripper_goal(
    action: GripperAction, joint: str, position: float, effort: float = 0.0
) -> ParallelGripperCommand.Goal | GripperCommand.Goal | FollowJointTrajectory.Goal:
    """Goal of a gripper action: the driving finger at a position, m, with at most an effort, N.

    An effort of 0 leaves it to the controller, and a trajectory always does.
    """
    if action == "trajectory":
        point = JointTrajectoryPoint(positions=[position], time_from_start=Duration(nanosec=_GRIP_NS))
        return FollowJointTrajectory.Goal(trajectory=JointTrajectory(joint_names=[joint], points=[point]))
    if action == "classic":
        goal = GripperCommand.Goal()
        goal.command.position, goal.command.max_effort = position, effort
        return goal
    command = JointState(name=[joint], position=[position], effort=[effort] if effort > 0.0 else [])
    return ParallelGripperCommand.Goal(command=command)


def gripped(result: Any) -> bool:
    """Whether a hand came to the end of its motion, at its goal or at an object, by the result of its action."""
    if isinstance(result, FollowJointTrajectory.Result):  # which says nothing of the fingers: joint states do
        return bool(result.error_code == FollowJointTrajectory.Result.SUCCESSFUL)
    return bool(result.stalled or result.reached_goal)


def reach_request(arm: str, frame: str, T_base_tcp: Array) -> ComputeIK.Request:
    """Ask how near an arm's TCP comes to a point, in any orientation."""
    request = ComputeIK.Request(arm=arm, position_only=True)
    request.pose.header.frame_id = frame
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
    arm: str, frame: str, to: str | Array, obstacles: Sequence[Box], velocity_scale: float, max_start_delay: float
) -> MoveArm.Goal:
    """A free path to a named posture, or to joint positions, or a straight line of the TCP to a pose.

    Args:
        arm: Arm to move.
        frame: Base frame.
        to: Name of the posture, joint positions (n,), or the pose (4, 4), base frame.
        obstacles: Boxes to keep clear of, base frame.
        velocity_scale: Share of the motion limits; 0: the planner's default.
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
    if to.ndim == 1:
        goal.kind, goal.joint_positions = MoveArm.Goal.JOINTS, to.tolist()
        return goal
    goal.kind, goal.pose.header.frame_id = MoveArm.Goal.LINEAR, frame
    goal.pose.pose = matrix_to_pose(to)
    return goal


def code_from_text(text: str, otherwise: Code) -> Code:
    """The code that a message names; `otherwise` for one that is not of the suite, or claims success in a failure."""
    return Code(text) if text in Code.__members__ and text != Code.OK else otherwise
