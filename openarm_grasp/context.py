# SPDX-License-Identifier: Apache-2.0
"""What every part of grasping needs to know and no request changes."""

from __future__ import annotations

from dataclasses import dataclass

from openarm_common.camera.cameras import load_cameras
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import Table
from openarm_grasp.config import GraspConfig
from openarm_grasp.planning.arms import Shoulders, arm_order


@dataclass(frozen=True)
class GraspContext:
    """What does not change from request to request.

    Attributes:
        config: Parameters.
        table: Where objects stand.
        shoulders: (x, y) of each arm's shoulder, base frame, m.
        looks: The arm whose hand carries the camera of the second look; "": none.
    """

    config: GraspConfig
    table: Table
    shoulders: Shoulders
    looks: str = ""

    @classmethod
    def of(cls, config: GraspConfig, table: Table, robot: RobotDescription) -> GraspContext:
        """That of a robot at a table."""
        camera = load_cameras().get(config.near.camera)
        looks = robot.arm_of(camera.parent) if camera is not None and config.near.enabled else ""
        return cls(config, table, {arm: _shoulder(robot, arm) for arm in robot.arm_names}, looks)

    def arm_order(self, arm: str, y: float) -> tuple[str, ...]:
        """Arms to try for an object; see `openarm_grasp.planning.arms.arm_order`."""
        return arm_order(arm, y, self.config.approach.overlap_half_width, self.shoulders)

    @property
    def clear_of_objects(self) -> float:
        """Height of a hand, base frame, m; one that is lower may be among the objects."""
        return self.table.top_z + 2.0 * self.config.approach.lift_height


def _shoulder(robot: RobotDescription, arm: str) -> tuple[float, float]:
    """(x, y) of the arm's first joint, base frame, m."""
    first = robot.joint(robot.arm_joints(arm)[0])
    T_base_shoulder = robot.link_pose(first.parent, {}) @ first.T_parent_joint
    return float(T_base_shoulder[0, 3]), float(T_base_shoulder[1, 3])
