# SPDX-License-Identifier: Apache-2.0
"""What every part of grasping needs to know and no request changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from openarm_common.camera.cameras import CameraConfig, hand_cameras, load_cameras
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import per_robot
from openarm_common.robot.hand import Hand, HandParts
from openarm_common.robot.work import Table
from openarm_common.robot.zeros import HandReach
from openarm_common.types import Array
from openarm_grasp.config import GraspConfig
from openarm_grasp.planning.arms import Shoulders, arm_order
from openarm_grasp.sampling.hand_shape import HandShape


@dataclass(frozen=True)
class GraspContext:
    """What does not change from request to request.

    Attributes:
        config: Parameters.
        table: Table that objects stand on.
        hand: Measures of the grippers.
        shoulders: (x, y) of each arm's shoulder, base frame, m.
        looks: Camera of the second look, by the arm whose hand carries it.
        cameras: Cameras at their mounts: the hand carries their housings.
        hands: Hands by arm; none: `hand` is that of each.
    """

    config: GraspConfig
    table: Table
    hand: HandParts
    shoulders: Shoulders
    looks: Mapping[str, str] = field(default_factory=dict[str, str])
    cameras: tuple[CameraConfig, ...] = ()
    hands: Mapping[str, Hand] = field(default_factory=dict[str, Hand])

    @classmethod
    def of(
        cls,
        config: GraspConfig,
        table: Table,
        robot: RobotDescription,
        cameras: Mapping[str, CameraConfig] | None = None,
    ) -> GraspContext:
        """That of a robot at a table; `cameras`, by name, are where they are mounted, nominal without."""
        cameras = load_cameras() if cameras is None else cameras
        looks = {robot.arm_of(cameras[name].parent): name for name in hand_cameras()} if config.near.enabled else {}
        return cls(
            config,
            table,
            robot.hand(robot.arm_names[0]).parts,
            {arm: _shoulder(robot, arm) for arm in robot.arm_names},
            looks,
            tuple(cameras.values()),
            robot.hands,
        )

    def parts(self, arm: str) -> HandParts:
        """Return the measures of the hand of an arm."""
        return self.hands[arm].parts if arm in self.hands else self.hand

    def config_of(self, arm: str) -> GraspConfig:
        """Return the parameters with the width that the hand of an arm, as far as it opens, has room around."""
        config, width = self.config, self.parts(arm).max_width
        if width >= config.approach.max_width:
            return config
        approach = config.approach.model_copy(update={"max_width": width})
        return config.model_copy(update={"approach": approach})

    def shape(self, arm: str) -> HandShape:
        """Return the shape of an arm's open hand, with the cameras that it carries; made the first time."""
        hand = self.hands.get(arm)
        return _shape(arm, self.cameras, None if hand is None else hand.reach)

    def arm_order(self, arm: str, y: float) -> tuple[str, ...]:
        """Arms to try for an object; see `openarm_grasp.planning.arms.arm_order`."""
        return arm_order(arm, y, self.config.approach.overlap_half_width, self.shoulders)

    def on_table(self, xy: Sequence[float] | Array) -> Array:
        """Return the point (3,) of the table at (2,) or (3,), base frame, m."""
        return np.array([*xy[:2], self.table.top_z], dtype=np.float64)

    @property
    def clear_of_objects(self) -> float:
        """Height of a hand, base frame, m; one that is lower may be among the objects."""
        return self.table.top_z + 2.0 * self.config.approach.lift_height


@per_robot
def _shape(arm: str, cameras: tuple[CameraConfig, ...], reach: HandReach | None) -> HandShape:
    robot = RobotDescription.load().described
    return HandShape.of(robot if reach is None else robot.with_hands({arm: reach}), arm, cameras)


def _shoulder(robot: RobotDescription, arm: str) -> tuple[float, float]:
    """(x, y) of the arm's first joint, base frame, m."""
    first = robot.joint(robot.arm_joints(arm)[0])
    anyhow = dict.fromkeys(robot.joints, 0.0)  # a lift changes neither
    T_base_shoulder = robot.link_pose(first.parent, anyhow) @ first.T_parent_joint
    return float(T_base_shoulder[0, 3]), float(T_base_shoulder[1, 3])
