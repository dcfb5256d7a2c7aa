# SPDX-License-Identifier: Apache-2.0
"""The planner in this process: its arms, and what it is asked for a grasp or a place. Base frame, m."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

from openarm_common.camera.cameras import load_cameras
from openarm_common.camera.housings import with_housings
from openarm_common.robot.description import RobotDescription
from openarm_grasp.planning.candidates import Box as GraspBox
from openarm_grasp.planning.candidates import GraspCandidate
from openarm_grasp.planning.place import PlaceTarget
from openarm_grasp.strategy import effects
from openarm_motion.collision.collision import Box, box_from
from openarm_motion.config import MotionConfig
from openarm_motion.planning.approach import ApproachRequest, Target
from openarm_motion.planning.arm import Arm


def boxes_of(boxes: Sequence[GraspBox]) -> tuple[Box, ...]:
    """Boxes of the grasp as the planner's."""
    return tuple(Box(box.id, box.T_frame_box, box.size) for box in boxes)


def request_of(effect: effects.PlanGrasp | effects.PlanPlace) -> ApproachRequest:
    """What the planner is asked for a grasp or a place."""
    if isinstance(effect, effects.PlanGrasp):
        return ApproachRequest(
            targets=tuple(_target(way) for way in effect.candidates),
            obstacles=boxes_of((*effect.obstacles, effect.target)),
            touchable=frozenset({effect.target.id}),
            attached_after=True,
        )
    return ApproachRequest(
        targets=tuple(_target(way) for way in effect.targets),
        obstacles=boxes_of(effect.obstacles),
        attached=boxes_of((effect.held,)),
        detached_after=True,
    )


def _target(way: GraspCandidate | PlaceTarget) -> Target:
    return Target(way.id, way.T_base_tcp, way.approach_offset, way.retreat_offset, way.score)


@cache
def arms_behind(top_z: float, centre: tuple[float, float], extents: tuple[float, float, float]) -> Mapping[str, Arm]:
    """Both arms behind a table top (its height, middle and edges, m); made once a process."""
    config = MotionConfig()
    robot = with_housings(RobotDescription.load(), load_cameras().values())
    static = (box_from("table", (*centre, top_z - 0.5 * extents[2]), extents),)
    return {name: Arm(name, robot, config, static) for name in config.arms}
