# SPDX-License-Identifier: Apache-2.0
"""A robot of poses: where only the pose of a tip is known, six joints stand for it, so that samples stay samples.

`x`, `y`, `z` (m) and then `yaw`, `pitch`, `roll` (rad) move `tip` in `base`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from scipy.spatial.transform import Rotation

from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array

#: Of links and joints that stand for a pose.
_JOINTS = (
    ("pose_x", "prismatic", "1 0 0"), ("pose_y", "prismatic", "0 1 0"), ("pose_z", "prismatic", "0 0 1"),
    ("pose_yaw", "revolute", "0 0 1"), ("pose_pitch", "revolute", "0 1 0"), ("pose_roll", "revolute", "1 0 0"),
)  # fmt: skip
_LIMIT = '<limit lower="-100" upper="100" effort="1" velocity="1"/>'


def robot_of_poses(base: str, tip: str) -> RobotDescription:
    """Return a robot whose six joints are the pose of `tip` in `base`.

    Args:
        base: Name of the base link.
        tip: Name of the link that moves.

    Raises:
        OpenArmError: CONFIG_INVALID, for names that are none, or the same.
    """
    names = [base, *(f"{name}_link" for name, _, _ in _JOINTS[:-1]), tip]
    links = "".join(f"<link name={_quoted(name)}/>" for name in names)
    joints = "".join(
        f'<joint name="{name}" type="{kind}"><parent link={_quoted(parent)}/><child link={_quoted(child)}/>'
        f'<axis xyz="{axis}"/>{_LIMIT}</joint>'
        for (name, kind, axis), parent, child in zip(_JOINTS, names, names[1:], strict=False)
    )
    return RobotDescription.from_urdf(f'<robot name="poses">{links}{joints}</robot>')


def are_of_pose(names: Sequence[str]) -> bool:
    """Return whether joints are those that stand for a pose: nothing is known of the robot's own."""
    return tuple(names) == tuple(name for name, _, _ in _JOINTS)


def joints_of_pose(T: Array) -> Mapping[str, float]:
    """Return the joints that stand for a pose (4, 4)."""
    yaw, pitch, roll = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX")
    values = (*T[:3, 3], yaw, pitch, roll)
    return {name: float(value) for (name, _, _), value in zip(_JOINTS, values, strict=True)}


def _quoted(name: str) -> str:
    from xml.sax.saxutils import quoteattr

    return quoteattr(name)
