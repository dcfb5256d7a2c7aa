# SPDX-License-Identifier: Apache-2.0
"""Which links of a robot an arm moves, which of them grip, and which are one rigid body.

All of it follows from the tree of joints, so no link or joint name is written down here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from openarm_common.robot.description import RobotDescription
from openarm_motion.kinematics.kinematics import ArmKinematics


@dataclass(frozen=True)
class ArmLinks:
    """Links of one arm.

    Attributes:
        moving: Every link that the arm's joints move, the gripper's included.
        gripper: Links that further joints beyond the arm move: the fingers and what is fixed to them.
        hand: The gripper, what carries it, and the tool link: what a held object may touch.
        fixed: Links of the robot that no joint moves.
        gripper_joints: The joints that move the gripper's links, followers left out.
        body: Link -> name of the first link of the rigid body that it belongs to.
        neighbours: Pairs of rigid bodies that one joint connects.
    """

    moving: frozenset[str]
    gripper: frozenset[str]
    hand: frozenset[str]
    fixed: frozenset[str]
    gripper_joints: tuple[str, ...]
    body: Mapping[str, str]
    neighbours: frozenset[frozenset[str]]

    @classmethod
    def of(cls, description: RobotDescription, kinematics: ArmKinematics) -> ArmLinks:
        """Sort the links of `description` for the arm of `kinematics`."""
        arm = set(kinematics.names)
        last = kinematics.names[-1]
        moving: set[str] = set()
        gripper: set[str] = set()
        fixed: set[str] = set()
        carriers: set[str] = set()
        gripper_joints: list[str] = []
        body: dict[str, str] = {}
        for link in description.links:
            movers = [joint for joint in description.chain(link) if joint.type != "fixed"]
            names = [joint.name for joint in movers]
            body[link] = movers[-1].child if movers else description.root
            if not names:
                fixed.add(link)
            if arm.intersection(names):
                moving.add(link)
            if last in names and names[-1] != last:
                gripper.add(link)
                first = movers[names.index(last) + 1]
                carriers.add(first.parent)
                gripper_joints += [j.name for j in movers[names.index(last) + 1 :] if j.mimic is None]
        neighbours = frozenset(
            frozenset((body[joint.parent], body[joint.child]))
            for joint in description.joints.values()
            if joint.type != "fixed"
        )
        # without a gripper the last rigid body is the hand
        hand = gripper | carriers or {link for link in moving if body[link] == body[kinematics.tool_link]}
        return cls(
            moving=frozenset(moving),
            gripper=frozenset(gripper),
            hand=frozenset(hand | {kinematics.tool_link}),
            fixed=frozenset(fixed),
            gripper_joints=tuple(dict.fromkeys(gripper_joints)),
            body=body,
            neighbours=neighbours,
        )
