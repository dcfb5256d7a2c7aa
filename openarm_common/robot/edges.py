# SPDX-License-Identifier: Apache-2.0
"""Poses of the moving edges of a robot description, all at once.

An edge is a movable joint: the pose of its child link in its parent link. Quaternions are (x, y, z, w); positions are
metres, joint positions rad or m.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array


class MovingEdges:
    """Edges of the movable joints.

    Args:
        description: The robot.
        joint_names: Order of the positions that `update` takes; mimicking joints follow their leaders.

    Attributes:
        frames: (parent, child) of each edge.
    """

    def __init__(self, description: RobotDescription, joint_names: Sequence[str]) -> None:
        column = {name: i for i, name in enumerate(joint_names)}
        joints = [j for j in description.joints.values() if j.type != "fixed" and (j.mimic or j.name) in column]
        self.frames = tuple((joint.parent, joint.child) for joint in joints)
        self._column = np.array([column[joint.mimic or joint.name] for joint in joints], dtype=np.intp)
        self._scale = np.array([joint.multiplier if joint.mimic else 1.0 for joint in joints])
        self._offset = np.array([joint.offset if joint.mimic else 0.0 for joint in joints])
        self._slides = np.array([joint.type == "prismatic" for joint in joints])
        self._origin = np.stack([joint.T_parent_joint[:3, 3] for joint in joints])
        turns = [joint.T_parent_joint[:3, :3] @ joint.axis for joint in joints]
        self._direction = np.stack(turns) * self._slides[:, None]
        # The fixed rotation times the half turn (axis sin, cos) is linear in sine and cosine.
        self._cosine = np.stack([se3.quat_xyzw_from_matrix(joint.T_parent_joint[:3, :3]) for joint in joints])
        v0, w0 = self._cosine[:, :3], self._cosine[:, 3:]
        v1 = np.stack([joint.axis for joint in joints])
        self._sine = np.hstack([w0 * v1 + np.cross(v0, v1), -np.sum(v0 * v1, axis=1, keepdims=True)])

    def poses(self, positions: Array) -> tuple[Array, Array]:
        """Return the translations (m, 3) and quaternions (m, 4) of all edges at joint positions (n,)."""
        q = self._scale * positions[self._column] + self._offset
        half = np.where(self._slides, 0.0, 0.5 * q)[:, None]
        quaternions = self._cosine * np.cos(half) + self._sine * np.sin(half)
        return self._origin + self._direction * q[:, None], quaternions
