# SPDX-License-Identifier: Apache-2.0
"""Rigid bodies of a robot, and which of its links are worth a check against each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from openarm_common.robot.description import RobotDescription


@dataclass(frozen=True)
class Bodies:
    """Links that move as one.

    Attributes:
        body: Link -> name of the first link of the rigid body that it belongs to.
        neighbours: Pairs of rigid bodies that one joint connects.
        allowed: Pairs of links that may touch, as the SRDF says; None without one.
    """

    body: Mapping[str, str]
    neighbours: frozenset[frozenset[str]]
    allowed: frozenset[frozenset[str]] | None

    @classmethod
    def of(cls, description: RobotDescription) -> Bodies:
        """Sort the links of a robot."""
        chains = {link: [j for j in description.chain(link) if j.type != "fixed"] for link in description.links}
        body = {link: joints[-1].child if joints else description.root for link, joints in chains.items()}
        neighbours = frozenset(
            frozenset((body[joint.parent], body[joint.child]))
            for joint in description.joints.values()
            if joint.type != "fixed"
        )
        return cls(body, neighbours, description.allowed_collisions if description.srdf else None)

    def checked(self, a: str, b: str) -> bool:
        """Return whether two links must not touch: what the SRDF allows may; without one, neighbours may."""
        if self.body[a] == self.body[b]:
            return False
        if self.allowed is not None:
            return frozenset((a, b)) not in self.allowed
        return frozenset((self.body[a], self.body[b])) not in self.neighbours
