# SPDX-License-Identifier: Apache-2.0
"""Names of a robot's SRDF and URDF as arms and frames of the tool: planning groups, links that move with a tool."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from openarm_motion.planning.arm import Arm


class RobotNames:
    """What the names of a robot mean to its arms.

    Args:
        description: The robot.
        arms: Arms by name.
    """

    def __init__(self, description: RobotDescription, arms: Mapping[str, Arm]) -> None:
        self._description, self._arms = description, arms

    def arms_of_group(self, group: str) -> tuple[str, ...]:
        """Return the arms whose joints are those of a group of the SRDF.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the groups of arms.
        """
        arms = self.groups()
        if group not in arms:
            text = f"group {group!r}; planning groups: {', '.join(arms) or 'none'}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        return arms[group]

    def groups(self) -> dict[str, tuple[str, ...]]:
        """Return the arms by the groups of the SRDF that have just their joints: those of one arm, or of two."""
        found = (
            (g, self.arms_of_joints(self._description.group_joints(g))) for g in self._description.semantics.members
        )
        return {group: arms for group, arms in found if arms}

    def hands(self) -> dict[str, str]:
        """Return by group of the SRDF the arm whose hand has just its joints."""
        fingers = {arm: self._description.finger_joint(arm) for arm in self._description.hands}
        members = {g: self._description.group_joints(g) for g in self._description.semantics.members}
        return {g: arm for g, joints in members.items() for arm, finger in fingers.items() if joints[:1] == (finger,)}

    def arms_of_joints(self, joints: Sequence[str]) -> tuple[str, ...]:
        """Return the one or two arms that have just these joints, in whatever order; empty: there are none."""
        arms = tuple(name for name, arm in self._arms.items() if set(arm.names) <= set(joints))
        whole = len(arms) <= 2 and sorted(joint for name in arms for joint in self._arms[name].names) == sorted(joints)
        return arms if whole else ()

    def arm_of_joint(self, joint: str, arms: Sequence[str]) -> str:
        """Return which of some arms has a joint.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing their joints.
        """
        for arm in arms:
            if joint in self._arms[arm].names:
                return arm
        there = ", ".join(name for arm in arms for name in self._arms[arm].names)
        raise OpenArmError(Code.INVALID_ARGUMENT, f"constraint of joint {joint!r}; joints of the arms: {there}")

    def on_tool(self, arm: str, link: str) -> Array:
        """Return the pose (4, 4) of a link that moves with an arm's tool, in the frame of the tool; "" is the tool.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the links that do.
        """
        if not link:
            link = self._arms[arm].kinematics.tool_link
        links = self.links_on_tool(arm)
        if link not in links:
            text = f"link {link!r} does not move with the tool of the {arm} arm; those that do: {', '.join(links)}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        zero = dict.fromkeys(self._description.joints, 0.0)
        tool = self._description.link_pose(self._arms[arm].kinematics.tool_link, zero)
        return se3.inverse(tool) @ self._description.link_pose(link, zero)

    def links_on_tool(self, arm: str) -> list[str]:
        """Return the links that move with an arm's tool, as one body with it."""
        joints = self._moving(self._arms[arm].kinematics.tool_link)
        return [link for link in self._description.links if self._moving(link) == joints]

    def arm_of_link(self, link: str, arms: Sequence[str] = ()) -> str:
        """Return the arm that carries a link of its hand, of all arms or some.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the links of hands.
        """
        for arm in arms or self._arms:
            if link in self.links_on_tool(arm):
                return arm
        there = ", ".join(link for arm in self._arms for link in self.links_on_tool(arm))
        raise OpenArmError(Code.INVALID_ARGUMENT, f"link {link!r} is of no hand; links that carry objects: {there}")

    def _moving(self, link: str) -> list[str]:
        return [joint.name for joint in self._description.chain(link) if joint.type != "fixed"]
