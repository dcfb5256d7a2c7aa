# SPDX-License-Identifier: Apache-2.0
"""What the motion tests share: the robot at home, a table, and one `Arm` a side (building one takes 0.2 s)."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.camera.cameras import load_cameras
from openarm_common.camera.housings import with_housings
from openarm_common.robot.description import RobotDescription
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.config import MotionConfig
from openarm_motion.planning.arm import Arm

SIX_JOINTS = """
<robot name="six">
<link name="base"><collision><geometry><cylinder radius="0.08" length="0.1"/></geometry></collision></link>
{links}
</robot>
"""
# an arm of another build: six joints, an offset wrist, names of its own
_CHAIN = [
    ("waist", (0, 0, 0.10), (0, 0, 1), 2.9),
    ("shoulder", (0, 0, 0.20), (0, 1, 0), 1.9),
    ("elbow", (0, 0, 0.40), (0, 1, 0), 2.4),
    ("forearm", (0, 0.03, 0.20), (0, 0, 1), 2.9),
    ("bend", (0, 0, 0.20), (0, 1, 0), 2.0),
    ("flange", (0.02, 0, 0.08), (0, 0, 1), 3.0),
]


def six_joint_urdf() -> str:
    """URDF of a six-joint arm that has nothing in common with OpenArm."""
    parts = []
    parent = "base"
    for name, xyz, axis, limit in _CHAIN:
        shape = '<collision><origin xyz="0 0 0.03"/><geometry><box size="0.06 0.06 0.06"/></geometry></collision>'
        parts.append(f'<link name="{name}_link">{shape}</link>')
        parts.append(
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/>'
            f'<origin xyz="{xyz[0]} {xyz[1]} {xyz[2]}"/><axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>'
            f'<limit lower="-{limit}" upper="{limit}" effort="10" velocity="2"/></joint>'
        )
        parent = f"{name}_link"
    parts.append(
        '<link name="tool"/><joint name="tool_joint" type="fixed"><parent link="flange_link"/>'
        '<child link="tool"/><origin xyz="0 0 0.1"/></joint>'
    )
    return SIX_JOINTS.format(links="\n".join(parts))


@pytest.fixture(scope="session")
def description() -> RobotDescription:
    return with_housings(RobotDescription.load(), load_cameras().values())


@pytest.fixture(scope="session")
def table() -> Box:
    """Top of the default table, 0.40 m high."""
    return box_from("table", (0.46, 0.0, 0.38), (0.7, 1.2, 0.04))


@pytest.fixture(scope="session")
def home(description: RobotDescription) -> dict[str, float]:
    """Both arms at home, fingers closed."""
    state = {**description.group_state("left_arm", "home"), **description.group_state("right_arm", "home")}
    return {**state, description.finger_joint("left"): 0.0, description.finger_joint("right"): 0.0}


@pytest.fixture(scope="session")
def arms(description: RobotDescription, table: Box) -> dict[str, Arm]:
    return {side: Arm(side, description, MotionConfig(), [table]) for side in ("left", "right")}


@pytest.fixture(scope="session")
def right(arms: dict[str, Arm]) -> Arm:
    return arms["right"]


@pytest.fixture(scope="session")
def six() -> RobotDescription:
    """Another robot."""
    return RobotDescription.from_urdf(six_joint_urdf())


def down(x: float, y: float, z: float, yaw: float = 0.0) -> np.ndarray:
    """Tool pose that looks straight down with the opening axis at `yaw` in the plane."""
    from openarm_common import se3

    return se3.make(se3.rotation_from_z_y((0, 0, -1), (np.cos(yaw), np.sin(yaw), 0)), (x, y, z))
