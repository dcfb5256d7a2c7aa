# SPDX-License-Identifier: Apache-2.0
"""Motion's messages to core data and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from openarm_interfaces.action import PlanApproach
from openarm_interfaces.msg import ApproachTarget, CollisionBox, Refusal
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common.convert import matrix_to_pose, pose_to_matrix, trajectory_to_msg, vector, xyz
from openarm_motion.approach import ApproachRequest, Refused, Target
from openarm_motion.collision import Box
from openarm_motion.trajectory import Trajectory

_HELD_COLOR = (0.2, 0.8, 0.4, 0.5)


def boxes_from_msg(messages: Sequence[CollisionBox]) -> tuple[Box, ...]:
    """Boxes; the frame is what the using message states.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the box.
    """
    return tuple(Box(box.id, pose_to_matrix(box.pose), xyz(box.size)) for box in messages)


def request_from_msg(goal: PlanApproach.Goal) -> ApproachRequest:
    """What a goal of /motion/plan_approach asks.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a pose or a box that is none.
    """
    return ApproachRequest(
        targets=tuple(_target(target) for target in goal.targets),
        obstacles=boxes_from_msg(goal.obstacles),
        attached=boxes_from_msg(goal.attached),
        touchable=frozenset(goal.touchable),
        attached_after=goal.attached_after_approach,
        detached_after=goal.detached_after_approach,
    )


def trajectory_msg(trajectory: Trajectory) -> JointTrajectory:
    """Message of a trajectory."""
    return trajectory_to_msg(trajectory.names, trajectory.t, trajectory.q, trajectory.v, trajectory.a)


def refusals_msg(refusals: Sequence[Refused]) -> list[Refusal]:
    """Messages of refusals."""
    return [Refusal(id=refused.id, code=refused.code.value, message=refused.message) for refused in refusals]


def markers_msg(held: Mapping[str, tuple[str, Sequence[Box]]]) -> MarkerArray:
    """Everything that is held: by arm, the tool frame and the boxes in it; replaces what was shown before."""
    array = MarkerArray(markers=[Marker(action=Marker.DELETEALL)])
    for arm, (frame, boxes) in held.items():
        for k, box in enumerate(boxes):
            marker = Marker(ns=f"{arm}/{box.id}", id=k, type=Marker.CUBE, action=Marker.ADD, frame_locked=True)
            marker.header.frame_id = frame
            marker.pose = matrix_to_pose(box.T)
            marker.scale = vector(box.size)
            marker.color.r, marker.color.g, marker.color.b, marker.color.a = _HELD_COLOR
            array.markers.append(marker)
    return array


def _target(message: ApproachTarget) -> Target:
    return Target(
        id=message.id,
        pose=pose_to_matrix(message.pose),
        approach_offset=xyz(message.approach_offset),
        retreat_offset=xyz(message.retreat_offset),
        score=message.score,
    )
