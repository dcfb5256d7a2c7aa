# SPDX-License-Identifier: Apache-2.0
"""Motion's messages to core data and back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, MoveArms, PlanApproach
from openarm_interfaces.msg import ApproachTarget, ArmTarget, CollisionBox, CollisionObject, PlanFailure, Refusal
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import (
    matrix_to_pose,
    point,
    pose_to_matrix,
    trajectory_from_msg,
    trajectory_to_msg,
    vector,
    xyz,
)
from openarm_common.types import Array
from openarm_motion.collision.solids import Box, Cylinder, Mesh, Solid, Sphere
from openarm_motion.planning.approach import ApproachRequest, Refused, Target
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.service.requests import (
    ArmGoal,
    DualGoal,
    ExecuteRequest,
    Goal,
    JointGoal,
    LineGoal,
    MoveArmsRequest,
    MoveRequest,
    NamedGoal,
    PlanApproachRequest,
    PoseGoal,
    Strategy,
    YieldGoal,
)
from openarm_motion.timing.trajectory import Motion, Trajectory

_HELD_COLOR = (0.2, 0.8, 0.4, 0.5)
_SCENE_COLOR = (0.8, 0.3, 0.2, 0.5)
_PREVIEW_COLOR = (0.2, 0.5, 0.9, 0.9)

_STRATEGIES: dict[int, Strategy] = {
    MoveArms.Goal.ANY: "any",
    MoveArms.Goal.TOGETHER: "together",
    MoveArms.Goal.STAGGERED: "staggered",
}


def boxes_from_msg(messages: Sequence[CollisionBox]) -> tuple[Box, ...]:
    """Boxes; the frame is what the using message states.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the box.
    """
    return tuple(Box(box.id, pose_to_matrix(box.pose), xyz(box.size)) for box in messages)


def box_msg(box: Box) -> CollisionBox:
    """Message of a box; the frame is what the using message states."""
    return CollisionBox(id=box.id, pose=matrix_to_pose(box.T), size=vector(box.size))


def solid_from_msg(message: CollisionObject, in_base: Callable[[Array, str], Array]) -> Solid:
    """A body of the planning scene; `in_base` brings a pose in a frame to the base frame.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the body and what is wrong with it; NO_TRANSFORM, for an unknown frame.
    """
    T = in_base(pose_to_matrix(message.pose.pose), message.pose.header.frame_id)
    size = xyz(message.size)
    if message.shape == "box":
        return Box(message.id, T, size)
    if message.shape == "cylinder":
        if abs(size[0] - size[1]) > 1e-6:
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"cylinder {message.id!r} has diameters {size[0]:g} and {size[1]:g} m; one only"
            )
        return Cylinder(message.id, T, 0.5 * float(size[0]), float(size[2]))
    if message.shape == "sphere":
        return Sphere(message.id, T, 0.5 * float(size[0]))
    if message.shape == "mesh":
        return Mesh(message.id, T, np.array([[v.x, v.y, v.z] for v in message.vertices], np.float64).reshape(-1, 3))
    raise OpenArmError(
        Code.INVALID_ARGUMENT, f"body {message.id!r} has shape {message.shape!r}; shapes: box, cylinder, sphere, mesh"
    )


def solid_msg(solid: Solid, frame: str) -> CollisionObject:
    """Message of a body in the base frame."""
    message = CollisionObject(id=solid.id, shape=type(solid).__name__.lower(), size=vector(solid.extents))
    message.pose.header.frame_id = frame
    message.pose.pose = matrix_to_pose(solid.T)
    if isinstance(solid, Mesh):
        message.vertices = [point(vertex) for vertex in solid.vertices]
    return message


def refusal_msg(refused: Refused) -> Refusal:
    """Convert the reason why a target was not chosen."""
    message = Refusal(id=refused.id, code=refused.code.value, message=refused.message)
    if refused.contact is not None:
        message.first, message.second = refused.contact.first, refused.contact.second
    return message


def failure_msg(error: OpenArmError) -> PlanFailure:
    """Where and why planning failed."""
    message = PlanFailure(stage="request")
    if not isinstance(error, PlanFailedError):
        return message
    message.stage = error.stage
    if error.contact is not None:
        message.first, message.second = error.contact.first, error.contact.second
        message.distance = error.contact.distance
    if error.alternative is not None:
        message.has_alternative, message.alternative = True, error.alternative.q.tolist()
        message.alternative_pose = matrix_to_pose(error.alternative.pose)
        message.alternative_distance = error.alternative.distance
    return message


def scene_markers(solids: Sequence[Solid], frame: str) -> MarkerArray:
    """Bodies of the planning scene; replaces what was shown before. A mesh is shown by the box about it."""
    array = MarkerArray(markers=[Marker(action=Marker.DELETEALL)])
    kinds: dict[type[Solid], int] = {Cylinder: Marker.CYLINDER, Sphere: Marker.SPHERE}
    for k, solid in enumerate(solids):
        marker = _marker(solid.id, k, kinds.get(type(solid), Marker.CUBE), frame, _SCENE_COLOR)
        T = solid.T.copy()
        T[:3, 3] += T[:3, :3] @ solid.centre
        marker.pose, marker.scale = matrix_to_pose(T), vector(solid.extents)
        array.markers.append(marker)
    return array


def preview_markers(paths: Mapping[str, Array], frame: str) -> MarkerArray:
    """The path of each arm's tool (n, 3), its start and its end; replaces what was shown before."""
    array = MarkerArray(markers=[Marker(action=Marker.DELETEALL)])
    for k, (arm, points) in enumerate(paths.items()):
        line = _marker(f"{arm}/way", 3 * k, Marker.LINE_STRIP, frame, _PREVIEW_COLOR)
        line.points = [point(p) for p in points]
        line.scale.x = 0.005
        array.markers.append(line)
        for i, (what, at) in enumerate((("start", points[0]), ("end", points[-1]))):
            end = _marker(f"{arm}/{what}", 3 * k + 1 + i, Marker.SPHERE, frame, _PREVIEW_COLOR)
            end.pose.position = point(at)
            end.scale = vector(np.full(3, 0.02 + 0.01 * i))
            array.markers.append(end)
    return array


def approach_request(goal: PlanApproach.Goal) -> PlanApproachRequest:
    """What a goal of /motion/plan_approach asks.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a pose or a box that is none; so do the others.
    """
    approach = ApproachRequest(
        targets=tuple(_target(target) for target in goal.targets),
        obstacles=boxes_from_msg(goal.obstacles),
        attached=boxes_from_msg(goal.attached),
        touchable=frozenset(goal.touchable),
        attached_after=goal.attached_after_approach,
        detached_after=goal.detached_after_approach,
        blend=goal.blend_approach,
    )
    return PlanApproachRequest(
        goal.arm,
        approach,
        np.array(goal.start, np.float64),
        goal.velocity_scale,
        boxes_from_msg(goal.ignore_regions),
        goal.expected_scene_version,
    )


def move_request(goal: MoveArm.Goal) -> MoveRequest:
    """What a goal of /motion/move asks."""
    return MoveRequest(
        goal.arm,
        _single_goal(goal),
        boxes_from_msg(goal.obstacles),
        boxes_from_msg(goal.attached),
        goal.hand_empty,
        goal.velocity_scale,
        goal.plan_only,
        goal.max_start_delay,
        goal.expected_scene_version,
    )


def move_arms_request(goal: MoveArms.Goal) -> MoveArmsRequest:
    """What a goal of /motion/move_arms asks."""
    if goal.strategy not in _STRATEGIES:
        text = f"strategy is {goal.strategy}; valid: ANY 0, TOGETHER 1, STAGGERED 2"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    return MoveArmsRequest(
        tuple(ArmGoal(t.arm, _dual_goal(t), boxes_from_msg(t.attached), t.hand_empty) for t in goal.targets),
        _STRATEGIES[goal.strategy],
        boxes_from_msg(goal.obstacles),
        goal.velocity_scale,
        goal.plan_only,
        goal.expected_scene_version,
    )


def execute_request(goal: ExecuteTrajectory.Goal) -> ExecuteRequest:
    """What a goal of /motion/execute asks."""
    names, t, q, v, a = trajectory_from_msg(goal.trajectory)
    return ExecuteRequest(goal.arm, Motion(tuple(names), t, q, v, a), goal.max_start_delay, goal.scene_version)


def _goal(message: MoveArm.Goal | ArmTarget, valid: str) -> JointGoal | NamedGoal | PoseGoal:
    """A goal of one of the kinds that a motion of one arm and a dual-arm motion have in common."""
    if message.kind == message.JOINTS:
        return JointGoal(np.array(message.joint_positions, np.float64))
    if message.kind == message.NAMED:
        return NamedGoal(message.named)
    if message.kind == message.POSE:
        return PoseGoal(pose_to_matrix(message.pose.pose), message.pose.header.frame_id, message.position_only)
    raise OpenArmError(Code.INVALID_ARGUMENT, f"kind is {message.kind}; valid: {valid}")


def _single_goal(goal: MoveArm.Goal) -> Goal:
    if goal.kind == goal.LINEAR:
        return LineGoal(pose_to_matrix(goal.pose.pose), goal.pose.header.frame_id)
    return _goal(goal, "JOINTS 0, POSE 1, LINEAR 2, NAMED 3")


def _dual_goal(target: ArmTarget) -> DualGoal:
    if target.kind == ArmTarget.YIELD:
        return YieldGoal(target.named or "home")
    return _goal(target, "JOINTS 0, POSE 1, NAMED 3, YIELD 4")


def trajectory_msg(trajectory: Trajectory) -> JointTrajectory:
    """Message of a trajectory."""
    return trajectory_to_msg(trajectory.names, trajectory.t, trajectory.q, trajectory.v, trajectory.a)


def held_markers(held: Mapping[str, tuple[str, Sequence[Box]]]) -> MarkerArray:
    """Everything that is held: by arm, the tool frame and the boxes in it; replaces what was shown before."""
    array = MarkerArray(markers=[Marker(action=Marker.DELETEALL)])
    for arm, (frame, boxes) in held.items():
        for k, box in enumerate(boxes):
            marker = _marker(f"{arm}/{box.id}", k, Marker.CUBE, frame, _HELD_COLOR)
            marker.frame_locked, marker.pose, marker.scale = True, matrix_to_pose(box.T), vector(box.size)
            array.markers.append(marker)
    return array


def _marker(name: str, id: int, kind: int | None, frame: str, color: tuple[float, float, float, float]) -> Marker:
    marker = Marker(ns=name, id=id, type=kind, action=Marker.ADD)
    marker.header.frame_id = frame
    marker.color.r, marker.color.g, marker.color.b, marker.color.a = color
    return marker


def _target(message: ApproachTarget) -> Target:
    return Target(
        id=message.id,
        pose=pose_to_matrix(message.pose),
        approach_offset=xyz(message.approach_offset),
        retreat_offset=xyz(message.retreat_offset),
        score=message.score,
    )
