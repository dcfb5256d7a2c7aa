# SPDX-License-Identifier: Apache-2.0
"""The links of a robot as a tree of rigid bodies: forward kinematics of many postures at once. Root frame, m, rad."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from openarm_common.robot.description import Joint, RobotDescription
from openarm_common.robot.tree_kernels import forward_many
from openarm_common.types import Array, Ints

#: Parents, placements, axes and prismatic joints, see `place_bodies`.
TreeArrays = tuple[Ints, Array, Array, NDArray[np.bool_]]


class KinematicTree:
    """Rigid bodies and the joints that move them: body 0 is the root, body i + 1 follows joint i.

    Args:
        description: The robot.
        joint_names: Order of the joints of postures; others are at 0, followers follow.

    Attributes:
        joints: Movable joints (m), each after those that carry it.
        body: Body of each link.
        fixed: Pose (4, 4) of each link in its body.
        arrays: The tree as the kernels take it.
    """

    def __init__(self, description: RobotDescription, joint_names: Sequence[str] = ()) -> None:
        chains = {link: description.chain(link) for link in description.links}
        found = {joint.name: joint for chain in chains.values() for joint in chain if joint.type != "fixed"}
        self.joints: tuple[Joint, ...] = tuple(found.values())
        number = {name: i + 1 for i, name in enumerate(found)}
        last = {link: [0, *(number[j.name] for j in chain if j.type != "fixed")][-1] for link, chain in chains.items()}
        self.body: Mapping[str, int] = last
        self.fixed = {link: _from_body(chain) for link, chain in chains.items()}
        self.arrays: TreeArrays = (
            np.array([self.body[joint.parent] for joint in self.joints], np.int64),
            np.array([self.fixed[joint.parent] @ joint.T_parent_joint for joint in self.joints]).reshape(-1, 4, 4),
            np.array([joint.axis / np.linalg.norm(joint.axis) for joint in self.joints]).reshape(-1, 3),
            np.array([joint.type == "prismatic" for joint in self.joints], np.bool_),
        )
        column = {name: k for k, name in enumerate(joint_names)}
        self._share, self._offset = np.zeros((len(self.joints), len(joint_names))), np.zeros(len(self.joints))
        for i, joint in enumerate(self.joints):
            leader = joint.mimic or joint.name
            if leader in column:
                self._share[i, column[leader]] = 1.0 if joint.mimic is None else joint.multiplier
            self._offset[i] = 0.0 if joint.mimic is None else joint.offset
        self._allowed = description.allowed_collisions if description.srdf else None

    def checked(self, first: str, second: str) -> bool:
        """Return whether two links must not touch: what the SRDF allows may; without one, neighbours may."""
        a, b = sorted((self.body[first], self.body[second]))
        if self._allowed is None:
            return a != b and int(self.arrays[0][b - 1]) != a
        return a != b and frozenset((first, second)) not in self._allowed

    def positions(self, q: Array) -> Array:
        """Return the positions (..., m) of all joints in postures (..., n)."""
        return q @ self._share.T + self._offset

    def link_poses(self, link: str, q: Array) -> Array:
        """Return the poses (k, 4, 4) of a link in postures (k, n)."""
        return forward_many(self.positions(q), *self.arrays, self.body[link], self.fixed[link])


def _from_body(chain: Sequence[Joint]) -> Array:
    """Return the pose (4, 4) of a link, of a chain that ends there, in the first link of its rigid body."""
    T = np.eye(4)
    for joint in chain:
        T = T @ joint.T_parent_joint if joint.type == "fixed" else np.eye(4)
    return T
