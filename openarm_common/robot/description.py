# SPDX-License-Identifier: Apache-2.0
"""The robot: one description for every part of the suite.

`RobotDescription.load()` reads a folder of `models/robots`; the same URDF text goes to MuJoCo, pinocchio and
`/robot_description`. Forward kinematics here needs nothing but numpy. Poses are ``T_root_link``, (4, 4), in the frame
of the root link (`world`, identical to the base frame); joint positions are rad, or m for a finger.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType

import numpy as np

from openarm_common.config import read_text
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import is_file
from openarm_common.robot.folder import ArmParts, RobotFolder, load_folder, other_robot, robot_folder, robot_name
from openarm_common.robot.hand import Hand
from openarm_common.robot.lift import LiftParts
from openarm_common.robot.meshes import take_meshes
from openarm_common.robot.motors import JointMotion, Motors
from openarm_common.robot.srdf import Semantics, parse_srdf, shifted
from openarm_common.robot.turns import nearest_turns
from openarm_common.robot.urdf import Joint, Link, Primitive, parse_urdf, rewritten
from openarm_common.robot.xacro_files import description_text
from openarm_common.robot.xml_text import fault, parse_root
from openarm_common.robot.zeros import HandReach, read_zeros, zeros_path
from openarm_common.types import Array

__all__ = ["Joint", "Link", "Primitive", "RobotDescription"]


@dataclass(frozen=True, eq=False)
class RobotDescription:
    """Links, joints and semantics of a robot, with forward kinematics.

    Attributes:
        urdf: URDF text, expanded.
        srdf: SRDF text, or "".
        name: Name of the robot.
        root: The link that is no joint's child.
        links: Links by name, in the order of the URDF.
        joints: Joints by name, in the order of the URDF.
        semantics: Content of the SRDF.
        base: Base frame.
        arms: Arms by name.
        hands: Hands by arm.
        lift: Lift that carries all arms; None: they stand on the base.
        mirror: Signs that mirror the joint positions of one arm to the other; empty: arms are no mirror images.
        motion: Limits that plans keep for the joints of an arm, where its folder says them.
        motors: Motors of each arm, where its folder says them.
        zeros: Position minus reported position by joint, rad or m; see `with_zeros`.
    """

    urdf: str
    srdf: str
    name: str
    root: str
    links: Mapping[str, Link]
    joints: Mapping[str, Joint]
    semantics: Semantics
    _chains: Mapping[str, tuple[Joint, ...]] = field(repr=False)
    base: str = ""
    arms: Mapping[str, ArmParts] = field(default_factory=dict[str, ArmParts])
    hands: Mapping[str, Hand] = field(default_factory=dict[str, Hand])
    lift: LiftParts | None = None
    mirror: tuple[float, ...] = ()
    motion: JointMotion | None = None
    motors: Motors | None = None
    zeros: Mapping[str, float] = field(default_factory=dict[str, float])
    _described: RobotDescription | None = field(default=None, repr=False)

    @classmethod
    def load(cls, name: str = "") -> RobotDescription:
        """Return a robot of `models/robots`; expanded once a process.

        The robot of this process has the zeros of its joints as they were calibrated, and its hands as they were
        learned, where `OPENARM_ZEROS` names them.

        Args:
            name: Name of its folder; "": that of this process.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the robots there are; CONFIG_INVALID, when a file of it is faulty.
        """
        mine = robot_name()
        return _loaded(robot_folder(name), name or mine, zeros_path() if name in ("", mine) else "")

    @classmethod
    def from_folder(cls, name: str) -> RobotDescription:
        """Read a robot of `models/robots`; as `load`."""
        folder, parts = load_folder(name)
        robot = cls.from_files(folder / (parts.xacro or parts.urdf), folder / parts.srdf)
        if faults := part_faults(parts, robot):
            raise OpenArmError(Code.CONFIG_INVALID, f"{folder / 'robot.yaml'}: {'; '.join(faults)}")
        return robot.of_folder(name, parts)

    @classmethod
    def from_files(
        cls, urdf: Path, srdf: Path | None = None, packages: Mapping[str, Path] | None = None
    ) -> RobotDescription:
        """Read a robot from files; collision meshes become convex hulls, see `openarm_common.robot.meshes`.

        Args:
            urdf: The description; what is named `.xacro` is expanded.
            srdf: Pairs of links that may touch, and postures; without it, neighbours may touch.
            packages: Folders of packages that mesh files are named by, where they are not installed.

        Raises:
            OpenArmError: CONFIG_INVALID, naming the file that is missing or faulty.
        """
        for path in (urdf, *([] if srdf is None else [srdf])):
            if not is_file(path):
                raise OpenArmError(Code.CONFIG_INVALID, f"there is no file {path}")
        root = parse_root(description_text(urdf, packages=packages), str(urdf))
        hulls = take_meshes(root, urdf, packages)
        ET.indent(root)
        text = ET.tostring(root, encoding="unicode") + "\n"  # drops xacro's comments, which name the folder it ran in
        robot = cls.from_urdf(text, "" if srdf is None else read_text(srdf))
        links = {
            name: replace(link, collision=(*link.collision, *hulls.get(name, ())), unread=())
            for name, link in robot.links.items()
        }
        return replace(robot, links=MappingProxyType(links))

    @classmethod
    def from_urdf(cls, urdf: str, srdf: str = "") -> RobotDescription:
        """Read any robot whose joints form one tree.

        Raises:
            OpenArmError: CONFIG_INVALID, naming what is wrong: duplicate names, unknown links, no or several roots, a
                loop, an SRDF that speaks of links or joints which the URDF does not have.
        """
        name, links, joints = parse_urdf(urdf)
        parent_joint: dict[str, Joint] = {}
        for joint in joints.values():
            if joint.child in parent_joint:
                other = parent_joint[joint.child].name
                raise fault(f"link {joint.child!r} is the child of two joints: {other!r} and {joint.name!r}")
            parent_joint[joint.child] = joint
        roots = [link for link in links if link not in parent_joint]
        if len(roots) != 1:
            found = f"found {len(roots)}: {', '.join(roots) or 'the joints form a loop'}"
            raise fault(
                f"expected one root link, {found}{'; join them by fixed joints, or take all but one out' * bool(roots)}"
            )
        chains = {link: _chain_of(link, parent_joint) for link in links}
        semantics = parse_srdf(srdf)
        _check_semantics(semantics, links, joints)
        return cls(
            urdf=urdf,
            srdf=srdf,
            name=name,
            root=roots[0],
            links=MappingProxyType(links),
            joints=MappingProxyType(joints),
            semantics=semantics,
            _chains=MappingProxyType(chains),
        )

    def of_folder(self, name: str, parts: RobotFolder) -> RobotDescription:
        """Return the robot with the name of its folder and what `robot.yaml` says."""
        hand, arms = parts.hand, parts.arms
        moved = {key: arm for key, arm in arms.items() if hand is not None and arm.finger_joint}
        hands = {key: Hand(arm.finger_joint, arm.finger_sign, hand) for key, arm in moved.items()} if hand else {}
        said = {"mirror": parts.mirror, "motion": parts.motion, "motors": parts.motors, "lift": parts.lift}
        return replace(self, name=name, base=parts.base, arms=arms, hands=hands, **said)

    def with_fixed(self, name: str, position: float) -> RobotDescription:
        """Return the robot with a joint that slides fixed at a position, m; it has no lift if that is the joint.

        Raises:
            OpenArmError: INVALID_ARGUMENT, as `joint`, and for one that does not slide.
        """
        old = self.joint(name)
        if old.type != "prismatic":
            raise OpenArmError(Code.INVALID_ARGUMENT, f"joint {name!r} is {old.type}, expected one that slides")
        fixed = replace(old, type="fixed", T_parent_joint=old.T_parent_joint @ old.motion(position))
        lift = None if self.lift is not None and self.lift.joint == name else self.lift
        return replace(self._with_joints(fixed), lift=lift)

    def with_zeros(self, offsets: Mapping[str, float]) -> RobotDescription:
        """Return the robot as its joints report it: one that reports `q` is at `q + offset` of the description.

        Origins of the joints take the offsets up, limits and named postures are what the joints report there, so that
        whatever reads the description takes and gives reported positions.

        Args:
            offsets: Offsets by joint, rad (m for one that slides); in addition to those that the robot has.

        Raises:
            OpenArmError: INVALID_ARGUMENT, as `joint`, for offsets that are not finite, and for joints that are fixed,
                follow another one or are followed.
        """
        led = {joint.mimic for joint in self.joints.values()}
        turned: list[Joint] = []
        for name, offset in offsets.items():
            joint = self.joint(name)
            if joint.type == "fixed" or joint.mimic is not None or name in led or not math.isfinite(offset):
                text = f"zero of joint {name!r}, {offset:g}: expected a finite offset of a joint that moves by itself"
                raise OpenArmError(Code.INVALID_ARGUMENT, text)
            origin = joint.T_parent_joint @ joint.motion(offset)
            lower, upper = joint.lower - offset, joint.upper - offset
            turned.append(replace(joint, T_parent_joint=origin, lower=lower, upper=upper))
        semantics = self.semantics
        states = {
            key: MappingProxyType({name: q - offsets.get(name, 0.0) for name, q in state.items()})
            for key, state in semantics.states.items()
        }
        return replace(
            self._with_joints(*turned),
            srdf=shifted(self.srdf, offsets),
            semantics=replace(semantics, states=MappingProxyType(states)),
            zeros={**self.zeros, **{name: self.zeros.get(name, 0.0) + offset for name, offset in offsets.items()}},
            _described=self.described,
        )

    def with_hands(self, hands: Mapping[str, HandReach]) -> RobotDescription:
        """Return the robot with hands, by arm, as they were learned.

        Raises:
            OpenArmError: Same as `hand`.
        """
        learned = {arm: self.hand(arm).with_reach(reach) for arm, reach in hands.items()}
        return replace(self, hands={**self.hands, **learned}, _described=self.described)

    @property
    def described(self) -> RobotDescription:
        """The robot as its folder describes it: for true joint positions, which simulators and judges have."""
        return self if self._described is None else self._described

    def _with_joints(self, *joints: Joint) -> RobotDescription:
        by_name = {joint.name: joint for joint in joints}
        chains = {link: tuple(by_name.get(j.name, j) for j in chain) for link, chain in self._chains.items()}
        return replace(
            self,
            urdf=rewritten(self.urdf, joints),
            joints=MappingProxyType({name: by_name.get(name, joint) for name, joint in self.joints.items()}),
            _chains=MappingProxyType(chains),
        )

    @property
    def arm_names(self) -> tuple[str, ...]:
        """Names of the arms."""
        return tuple(self.arms)

    def arm(self, name: str) -> ArmParts:
        """Return an arm.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the arms there are.
        """
        if name not in self.arms:
            there = ", ".join(self.arms) or "none"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no arm {name!r} in robot {self.name!r}; arms: {there}")
        return self.arms[name]

    def arm_joints(self, arm: str) -> tuple[str, ...]:
        """Return the names of the joints of an arm, from the shoulder."""
        return self.arm(arm).joints

    def hand(self, arm: str) -> Hand:
        """Return the hand of an arm.

        Raises:
            OpenArmError: INVALID_ARGUMENT, as `arm`; CONFIG_INVALID, when nothing is said of hands.
        """
        self.arm(arm)
        if arm not in self.hands:
            text = f"arm {arm!r} of robot {self.name!r} has no hand: its robot.yaml lacks `hand`, or its finger_joint"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        return self.hands[arm]

    def finger_joint(self, arm: str) -> str:
        """Return the name of the joint that drives the fingers of a hand."""
        return self.arm(arm).finger_joint

    def tcp_link(self, arm: str) -> str:
        """Return the name of the tool centre point of an arm: z out of the fingers, y the opening direction."""
        return self.arm(arm).tcp

    def links_of(self, arm: str) -> tuple[str, ...]:
        """Return the links of an arm: its base and all beyond it, in the order of the URDF."""
        base = self.arm(arm).base
        beyond = {base, *(link for link, chain in self._chains.items() if any(j.parent == base for j in chain))}
        return tuple(link for link in self.links if link in beyond)

    def arm_of(self, link: str) -> str:
        """Return the arm that a link belongs to; "": none."""
        return next((name for name in self.arms if link in self.links_of(name)), "")

    def mirrored(self, q: Iterable[float]) -> Array:
        """Mirror joint positions (n,) of one arm: the other arm takes the pose with y negated.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when the arms of this robot are no mirror images.
        """
        if not self.mirror:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"the arms of robot {self.name!r} are no mirror images")
        return np.fromiter(q, dtype=np.float64) * np.array(self.mirror)

    @property
    def allowed_collisions(self) -> frozenset[frozenset[str]]:
        """Pairs of links whose contact is not checked."""
        return self.semantics.allowed_collisions

    def limits(self, joint_names: Iterable[str], endless: float = math.inf) -> tuple[Array, Array]:
        """Return the lower and upper position limits (n,) of joints; `endless` are those of one that has none, rad."""
        found = [self.joint(name) for name in joint_names]
        lower, upper = np.array([j.lower for j in found]), np.array([j.upper for j in found])
        return np.where(np.isinf(lower), -endless, lower), np.where(np.isinf(upper), endless, upper)

    def away(self, posture: Mapping[str, float], q: Mapping[str, float]) -> float:
        """Return how far the joint that is furthest from a posture is from it, rad or m, by the shortest way.

        Raises:
            OpenArmError: INVALID_ARGUMENT, as `joint`.
        """
        there, here = (np.array([at[name] for name in posture]) for at in (posture, q))
        return float(np.abs(nearest_turns(there, here, self.limits(posture)[1]) - here).max())

    def joint(self, name: str) -> Joint:
        """Return a joint.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the joints there are.
        """
        if name not in self.joints:
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"no joint {name!r} in robot {self.name!r}; joints: {', '.join(self.joints)}"
            )
        return self.joints[name]

    def chain(self, link: str) -> tuple[Joint, ...]:
        """Return the joints from the root to a link, fixed ones included.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the links there are.
        """
        if link not in self._chains:
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"no link {link!r} in robot {self.name!r}; links: {', '.join(self.links)}"
            )
        return self._chains[link]

    def reach(self, link: str, offset: float = 0.0) -> dict[str, float]:
        """Return by movable joint how far a point can move when the joint does: at most m per rad, or m per m.

        Args:
            link: Link that carries the point.
            offset: Distance of the point from the origin of the link, m.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for an unknown link.
        """
        out: dict[str, float] = {}
        length = offset
        for joint in reversed(self.chain(link)):
            if joint.type != "fixed":
                leader, ratio = joint.mimic or joint.name, abs(joint.multiplier)
                out[leader] = out.get(leader, 0.0) + ratio * (1.0 if joint.type == "prismatic" else length)
            if joint.type == "prismatic":
                length += max(abs(joint.lower), abs(joint.upper))
            length += float(np.linalg.norm(joint.T_parent_joint[:3, 3]))
        return out

    def link_pose(self, link: str, q: Mapping[str, float]) -> Array:
        """Return the pose ``T_root_link`` (4, 4) of one link; only the joints of its chain are evaluated.

        Args:
            link: Name of the link.
            q: Positions of (at least) the movable joints of the chain; a mimicking joint takes its leader's.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for an unknown link or a joint that is missing in `q`.
        """
        T = np.eye(4)
        for joint in self.chain(link):
            T = T @ self._joint_pose(joint, q)
        return T

    def link_poses(self, q: Mapping[str, float]) -> dict[str, Array]:
        """Return the poses ``T_root_link`` (4, 4) of every link.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for a joint that is missing in `q`.
        """
        poses: dict[str, Array] = {self.root: np.eye(4)}
        for chain in self._chains.values():
            for joint in chain:
                if joint.child not in poses:
                    poses[joint.child] = poses[joint.parent] @ self._joint_pose(joint, q)
        return {link: poses[link] for link in self.links}

    def group_joints(self, group: str) -> tuple[str, ...]:
        """Return the movable joints of a group of the SRDF, from the root; those of fixed and mimic joints left out.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the groups there are.
        """
        if group not in self.semantics.members:
            there = ", ".join(self.semantics.members) or "none"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no group {group!r}; groups of {self.name!r}: {there}")
        found: list[str] = []
        for kind, *names in self.semantics.members[group]:
            if kind == "group" and names[0] != group:
                found += self.group_joints(names[0])
            elif kind == "joint":
                found.append(names[0])
            elif kind == "chain":
                before = self.chain(names[0])
                found += [joint.name for joint in self.chain(names[1]) if joint not in before]
        joints = [self.joint(name) for name in dict.fromkeys(found)]
        return tuple(joint.name for joint in joints if joint.type != "fixed" and joint.mimic is None)

    def group_state(self, group: str, name: str) -> dict[str, float]:
        """Return the joint positions of a named posture, for example group "left_arm", state "home".

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the states there are.
        """
        states = self.semantics.states
        if (group, name) not in states:
            there = ", ".join(f"{g}/{n}" for g, n in states) or "none"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no state {name!r} of group {group!r}; states: {there}")
        return dict(states[group, name])

    def _joint_pose(self, joint: Joint, q: Mapping[str, float]) -> Array:
        if joint.type == "fixed":
            return joint.T_parent_joint
        leader = joint.mimic or joint.name
        if leader not in q:
            there = ", ".join(q) or "no joints"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no position of joint {leader!r}; got {there}")
        position = float(q[leader])
        if joint.mimic is not None:
            position = joint.multiplier * position + joint.offset
        return joint.T_parent_joint @ joint.motion(position)


@lru_cache(maxsize=8)
def _loaded(folder: Path, name: str, zeros: str) -> RobotDescription:
    """Return a robot with the zeros and hands of a file; the file of a run is written once."""
    if zeros:
        held = read_zeros(Path(zeros))
        if text := other_robot(held.robot):
            raise OpenArmError(Code.CONFIG_INVALID, f"{zeros} {text}")
        return _loaded(folder, name, "").with_zeros(held.offsets).with_hands(held.hands)
    return RobotDescription.from_folder(name)


def part_faults(parts: RobotFolder, robot: RobotDescription) -> list[str]:
    """Return every link, joint and group of a folder that its URDF and SRDF don't have."""
    faults = [] if parts.base in robot.links else [f"base: no link {parts.base!r}"]
    for name, arm in parts.arms.items():
        links = [arm.base, arm.flange, arm.hand, arm.tcp, *arm.fingers]
        faults += [f"arms.{name}: no link {link!r}" for link in links if link not in robot.links]
        joints = arm.controlled
        faults += [f"arms.{name}: no joint {joint!r}" for joint in joints if joint not in robot.joints]
        if f"{name}_arm" not in robot.semantics.groups:
            faults.append(f"arms.{name}: the SRDF has no group {name}_arm")
    return faults + _lift_faults(parts, robot)


def _lift_faults(parts: RobotFolder, robot: RobotDescription) -> list[str]:
    lift = parts.lift
    if lift is None:
        return []
    if lift.joint not in robot.joints or robot.joints[lift.joint].type != "prismatic":
        return [f"lift: no joint {lift.joint!r} that slides"]
    joint = robot.joints[lift.joint]
    faults = [
        f"lift: does not carry arm {name}, whose base is {arm.base!r}"
        for name, arm in parts.arms.items()
        if arm.base in robot.links and joint not in robot.chain(arm.base)
    ]
    if not joint.lower <= lift.home <= joint.upper:
        faults.append(f"lift.home: {lift.home:g} m, expected {joint.lower:g} .. {joint.upper:g}")
    return faults


def _chain_of(link: str, parent_joint: Mapping[str, Joint]) -> tuple[Joint, ...]:
    chain: list[Joint] = []
    seen = {link}
    while link in parent_joint:
        joint = parent_joint[link]
        chain.append(joint)
        link = joint.parent
        if link in seen:
            raise fault(f"the joints form a loop through link {link!r}")
        seen.add(link)
    return tuple(reversed(chain))


def _check_semantics(semantics: Semantics, links: Mapping[str, Link], joints: Mapping[str, Joint]) -> None:
    for pair in semantics.allowed_collisions:
        for link in pair - links.keys():
            raise fault(f"SRDF disables collisions of link {link!r}, which the URDF does not have")
    for joint in sorted({joint for state in semantics.states.values() for joint in state} - joints.keys()):
        raise fault(f"SRDF speaks of joint {joint!r}, which the URDF does not have")
    for group_name, state in semantics.states:
        if group_name not in semantics.groups:
            raise fault(f"SRDF state {state!r} belongs to group {group_name!r}, which does not exist")
