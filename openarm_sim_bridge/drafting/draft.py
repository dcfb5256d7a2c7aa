# SPDX-License-Identifier: Apache-2.0
"""A draft of a robot's folder from its maker's MJCF or URDF: `openarm model new`. m, rad."""

from __future__ import annotations

import itertools
import math
import shutil
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import yaml

from openarm_common import se3
from openarm_common.collision.self_collision import LinkContacts
from openarm_common.config import load_config
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import Joint, RobotDescription
from openarm_common.types import Array
from openarm_sim_bridge.drafting.additions import add_hands, add_masses, add_stand, drives, fix_undriven, fixed_to, lift
from openarm_sim_bridge.drafting.adopted import AdoptedUrdf
from openarm_sim_bridge.drafting.collisions import adjacent_pairs
from openarm_sim_bridge.drafting.edits import Edits
from openarm_sim_bridge.drafting.hand import surface
from openarm_sim_bridge.drafting.mjcf import UrdfDraft, compiled
from openarm_sim_bridge.drafting.semantics import SOURCE, rewrite_states, write_srdf

_LICENSED = "# SPDX-License-Identifier: Apache-2.0\n"
_HEAD = f"""{_LICENSED}# Drafted by `openarm model new` from {{source}}: review it, then ask `openarm model check`.
"""
_NOTHING: Mapping[str, str] = MappingProxyType({})
_NOWHERE: Mapping[str, Path] = MappingProxyType({})
#: Lowest table that a robot can work at, and how high it stands whose arms are lower, m.
_LOWEST_TABLE, _STAND = 0.05, 0.45
#: Links that touch in such a share of random states may, as in MoveIt's Setup Assistant (`min_collision_fraction`).
_MOSTLY = 0.95
#: Postures that are tried in place of one in which links touch.
_DRAWS = 400
#: Least travel of two fingers to each other, m.
_CLOSES = 0.002
_LICENCE = "<!-- SPDX-License-Identifier: Apache-2.0 -->\n"


class _Dumper(yaml.SafeDumper):
    """Writes out what is there twice: files of the suite have no aliases."""

    def ignore_aliases(self, data: object) -> bool:
        return True


@dataclass(frozen=True)
class Draft:
    """What is to know of a draft.

    Attributes:
        reasons: Why each pair of links in the SRDF may touch.
        remarks: Parts that were left out or guessed, a sentence each.
    """

    reasons: Mapping[frozenset[str], str]
    remarks: tuple[str, ...]


def draft_folder(
    folder: Path,
    source: Path,
    arms: Mapping[str, tuple[str, str]],
    edits: Path | None = None,
    samples: int = 60_000,
    arguments: Mapping[str, str] = _NOTHING,
    packages: Mapping[str, Path] = _NOWHERE,
) -> Draft:
    """Write `robot.yaml`, URDF, meshes, `semantics.yaml` and SRDF of a robot.

    A draft that fails leaves nothing.

    Args:
        folder: Folder to make; its name is the robot's.
        source: MJCF (`.xml`), URDF, or xacro (`.xacro`).
        arms: Arms by name: link that the arm stands on, and link of its tool centre point.
        edits: YAML of `Edits`.
        samples: Random states of the collision matrix, unless the folder has a `semantics.yaml` already.
        arguments: Arguments of xacro, by name.
        packages: Folders of packages that a URDF names, by name.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the folder has a robot, or an arm names a link that the robot does not
            have; CONFIG_INVALID, when a file is faulty.
    """
    if (folder / "robot.yaml").exists():
        text = f"{folder} has a robot; give another name, or take the folder away"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    if not arms:
        raise OpenArmError(Code.INVALID_ARGUMENT, "expected at least one arm, as NAME=BASE_LINK:TIP_LINK")
    folder.parent.mkdir(parents=True, exist_ok=True)
    # next to the folder, since files of a robot may be named from there
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}_") as place:
        work = Path(place)
        if (folder / SOURCE).exists():
            shutil.copy(folder / SOURCE, work)
        draft = _drafted(work, folder.name, source, arms, edits, samples, arguments, packages)
        folder.mkdir(exist_ok=True)
        shutil.copytree(work, folder, dirs_exist_ok=True, copy_function=shutil.move)
        folder.chmod(0o755)
    return draft


def _drafted(
    folder: Path,
    name: str,
    source: Path,
    arms: Mapping[str, tuple[str, str]],
    edits: Path | None,
    samples: int,
    arguments: Mapping[str, str],
    packages: Mapping[str, Path],
) -> Draft:
    """Draft a robot of this name in a folder that is there; see `draft_folder`."""
    wanted = Edits() if edits is None else load_config(edits, Edits)
    urdf = folder / f"{name}.urdf"
    remarks: list[str] = []
    if source.suffix == ".xml":
        shared = folder.parent / wanted.meshes if wanted.meshes else None
        if shared is not None and not (shared / "robot.yaml").is_file():
            text = f"{edits}:meshes: there is no robot {wanted.meshes[:80]!r} next to {folder.parent / name}"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        draft = UrdfDraft(name, compiled(source, wanted), wanted, shared)
        draft.meshes.write(folder, wanted.triangles, wanted.detail)
        urdf.write_text(draft.text(), encoding="utf-8")
    else:
        adopted = AdoptedUrdf(source, folder, wanted, arguments, packages)
        remarks += adopted.remarks
        urdf.write_text(adopted.text(), encoding="utf-8")
    robot = RobotDescription.from_files(urdf)
    root = ET.fromstring(urdf.read_text(encoding="utf-8"))
    if twins := [found for arm, ends in arms.items() if (found := twin(robot, arm_parts(robot, arm, *ends)[0]))]:
        for element in root.findall("joint"):
            for follower, leader, multiplier, offset in twins:
                if element.get("name") == follower:
                    numbers = {"multiplier": f"{multiplier:g}", "offset": f"{offset:.13g}"}
                    ET.SubElement(element, "mimic", {"joint": leader} | numbers)
                    remarks.append(f"{follower!r} is taken to follow {leader!r}, as the other finger of its hand")
        _write_urdf(urdf, root, licensed=False)
        robot = RobotDescription.from_files(urdf)
    parts: dict[str, dict[str, Any]] = {}
    for arm, (base, tip) in arms.items():
        parts[arm], guesses = arm_parts(robot, arm, base, tip)
        remarks += guesses
    base = wanted.base if source.suffix == ".xml" else robot.root
    if source.suffix != ".xml" and (stand := _stand(robot, parts, wanted)) is not None:
        base = wanted.base if "base" in wanted.model_fields_set else f"{name}_stand"
        add_stand(root, robot, base, stand, wanted.turn)
        if "stand" not in wanted.model_fields_set:
            what = f"{robot.root!r} stands on {base!r}, {stand[2]:g} m high, as the table"
            remarks.append(f"{what}; `stand: [X, Y, Z]` in --edits of a new draft changes that")
    remarks += fix_undriven(root, robot, parts)
    if source.suffix != ".xml":
        remarks += add_masses(root, robot)
    hand, notes = add_hands(root, robot, parts)
    _write_urdf(urdf, root, licensed=source.suffix == ".xml")
    robot = RobotDescription.from_files(urdf)
    signs = mirror_signs(robot, [part["joints"] for part in parts.values()])
    content: dict[str, Any] = {
        "urdf": urdf.name,
        "srdf": f"{name}.srdf",
        "base": base,
        **hand,
        **drives(robot, parts),
        "arms": parts,
    }
    for joint in lift(robot, parts):
        home = float(np.clip(0.0, robot.joints[joint].lower, robot.joints[joint].upper))
        content["lift"] = {"joint": joint, "home": home}
    head = _HEAD.format(source=source.name)
    write_yaml(folder / "robot.yaml", content | {"mirror": signs}, head)
    if (folder / SOURCE).exists():
        return Draft(write_srdf(folder)[1], tuple(remarks + notes))
    first: dict[str, Any] = {**_first_semantics(robot, parts), "samples": samples}
    if mostly := sorted(sorted(pair) for pair in _mostly_touching(robot, parts)):
        first["may_touch"] += [pair for pair in mostly if pair not in first["may_touch"]]
        what = f"not checked, since they touch in nearly all states: {', '.join(map(' and '.join, mostly))}"
        notes.append(f"{what}; may_touch in {SOURCE} says so")
    write_yaml(folder / SOURCE, first, head)
    srdf, reasons = write_srdf(folder)
    if home := _free_home(RobotDescription.from_files(urdf, srdf), first["postures"]["home"], parts):
        write_yaml(folder / SOURCE, first | {"postures": {"home": home}})
        rewrite_states(folder)
        notes.append("links touch with all joints at 0; posture 'home' is another, where none do")
    return Draft(reasons, tuple(remarks + notes))


def arm_parts(robot: RobotDescription, name: str, base: str, tip: str) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return an arm as `robot.yaml` has it, and what of it is a guess, a sentence each.

    Fingers are what a joint with limits moves beyond the arm's last joint: rather one that others follow, then one that
    slides.

    Args:
        robot: The robot.
        name: Name of the arm.
        base: Link that it stands on.
        tip: Link of its tool centre point.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when a link does not exist or no joint is between the two.
    """
    chain, before = robot.chain(tip), {joint.name for joint in robot.chain(base)}
    joints = [joint for joint in chain if joint.name not in before and _leads(joint)]
    if not joints or base not in {robot.root, *(joint.child for joint in chain)}:
        text = f"arm {name!r}: no joint moves {tip!r} against {base!r}; expected the base link, then the tip link"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    flange = joints[-1].child
    beyond = [
        joint
        for joint in robot.joints.values()
        if joint.type != "fixed" and joint not in chain and flange in {joint.parent, *_links_to(robot, joint.parent)}
    ]
    followers = {joint.name: [other for other in beyond if other.mimic == joint.name] for joint in beyond}
    leaders = [joint for joint in beyond if _leads(joint) and -math.inf < joint.lower < joint.upper < math.inf]
    leaders.sort(key=lambda joint: (not followers[joint.name], joint.type != "prismatic"))
    leader = leaders[0] if leaders else None
    moved = [] if leader is None else [leader, *followers[leader.name]]
    others = [joint.name for joint in beyond if joint not in moved]
    remarks: list[str] = []
    if endless := [joint.name for joint in joints if joint.type == "continuous"]:
        way = f"where a cable forbids that, write `range: {{{endless[0]}: [LOWER, UPPER]}}` in --edits and draft again"
        remarks.append(f"arms.{name}: joints that turn without end: {', '.join(endless)}; {way}")
    if leader is not None and others:
        what = f"arms.{name}: finger_joint {leader.name!r} is a guess; further joints of the hand: {', '.join(others)}"
        way = "couple to it what follows it, by `mimic` in --edits of a new draft"
        remarks.append(f"{what}; where another one drives the hand, change robot.yaml; {way}")
    elif others:
        what = f"arms.{name}: no joint of the hand has limits, so it has no fingers: {', '.join(others)}"
        remarks.append(f"{what}; give one `range: {{{others[0]}: [LOWER, UPPER]}}` in --edits and draft again")
    if len(moved) == 1:
        what = f"arms.{name}: {moved[0].name!r} moves one finger, {moved[0].child!r}"
        way = f"where the other is a part of {moved[0].parent!r}, add that to fingers in robot.yaml"
        remarks.append(f"{what}; {way}; which end is closed is a guess, see gripper in semantics.yaml")
    hand = leader.parent if leader is not None else chain[-1].parent
    parts = {
        "base": base,
        "joints": [joint.name for joint in joints],
        "flange": flange,
        "hand": hand,
        "tcp": tip,
        "finger_joint": leader.name if leader is not None else "",
        "fingers": _ends(robot, [joint.child for joint in moved], hand),
    }
    return parts, tuple(remarks)


def twin(robot: RobotDescription, arm: Mapping[str, Any]) -> tuple[str, str, float, float] | None:
    """Return the joint of the other finger of a hand that no description couples, with leader, multiplier and offset.

    It is of the kind, travel and parent of the first, the only one such, and comes nearer to it where both move.
    """
    leader = robot.joints.get(arm["finger_joint"])
    if leader is None or any(joint.mimic == leader.name for joint in robot.joints.values()):
        return None

    def kind(joint: Joint) -> tuple[str, str, float]:
        return joint.type, joint.parent, round(joint.upper - joint.lower, 4)

    alike = [
        one for one in robot.joints.values() if one is not leader and one.mimic is None and kind(one) == kind(leader)
    ]
    if len(alike) != 1 or alike[0].name in arm["joints"]:
        return None
    (other,) = alike
    both = {**arm, "fingers": [*arm["fingers"], *_ends(robot, [other.child], arm["hand"])]}
    ways = [(1.0, other.lower - leader.lower), (-1.0, other.upper + leader.lower)]

    def closes(way: tuple[float, float]) -> float:
        ends = [{leader.name: q, other.name: way[0] * q + way[1]} for q in (leader.lower, leader.upper)]
        return abs(_gap(robot, both, ends[0]) - _gap(robot, both, ends[1]))

    best = max(ways, key=closes)
    return (other.name, leader.name, *best) if closes(best) > _CLOSES else None


def _ends(robot: RobotDescription, links: list[str], hand: str) -> list[str]:
    """Links that most of the others carry: the fingers of a linkage, not what moves them.

    Of each it is, of what is fixed to it, the link that has its pad, or reaches farthest from the hand.
    """
    carried = {link: len(_links_to(robot, link) & set(links)) for link in links}
    poses = robot.link_poses(dict.fromkeys(robot.joints, 0.0))

    def outermost(link: str) -> tuple[bool, float]:
        points = [se3.apply(se3.inverse(poses[hand]) @ poses[link], surface(s)) for s in robot.links[link].collision]
        return _has_pad(robot, link), max((float(np.linalg.norm(p, axis=1).max()) for p in points), default=0.0)

    ends = [link for link in links if carried[link] == max(carried.values())]
    return [max(fixed_to(robot, end), key=outermost) for end in ends]


def _has_pad(robot: RobotDescription, link: str) -> bool:
    return any(shape.name == f"{link}_pad_collision" for shape in robot.links[link].collision)


def mirror_signs(robot: RobotDescription, arms: list[list[str]]) -> list[int]:
    """Return the signs that mirror joint positions of one of two arms to the other; none if they are no mirror images.

    A turn about the axis `a` has, with y negated, the image of a turn by the negative angle about the image of `a`.
    """
    if len(arms) != 2 or len(arms[0]) != len(arms[1]):
        return []
    zero = dict.fromkeys(robot.joints, 0.0)
    signs: list[int] = []
    for first, second in zip(*arms, strict=True):
        (T, a), (S, b) = ((_at(robot, robot.joints[joint], zero)) for joint in (first, second))
        image = a * (1.0, -1.0, 1.0)
        slides = robot.joints[first].type == "prismatic"
        # the place along an axis says nothing, and that of a slide neither
        away = 0.0 if slides else float(np.linalg.norm(np.cross(T * (1.0, -1.0, 1.0) - S, b)))
        if robot.joints[second].type != robot.joints[first].type or away > 1e-4 or abs(image @ b) < 0.999:
            return []
        along = round(float(image @ b))
        signs.append(along if slides else -along)
    return signs


def _at(robot: RobotDescription, joint: Joint, state: Mapping[str, float]) -> tuple[Array, Array]:
    """Place and axis (3,) of a joint in the root frame."""
    T = robot.link_pose(joint.child, state)
    return T[:3, 3], T[:3, :3] @ joint.axis


def _leads(joint: Joint) -> bool:
    return joint.type != "fixed" and joint.mimic is None


def _links_to(robot: RobotDescription, link: str) -> set[str]:
    return {joint.child for joint in robot.chain(link)}


def _first_semantics(robot: RobotDescription, parts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Postures to begin with: all joints as near to 0 as their limits let them, the fingers at both ends.

    Links of one hand may touch that do so there, such as those of a linkage, whose hulls overlap.
    """
    zero = {
        name: [float(np.clip(0.0, robot.joints[j].lower, robot.joints[j].upper)) for j in arm["joints"]]
        for name, arm in parts.items()
    }
    ends: dict[str, dict[str, float]] = {"open": {}, "closed": {}}
    touching: set[tuple[str, ...]] = set()
    contacts = LinkContacts(robot)
    for name, arm in parts.items():
        touching |= {tuple(sorted(pair)) for pair in itertools.pairwise(arm["fingers"])}
        if arm["finger_joint"]:
            joint = robot.joints[arm["finger_joint"]]
            ends["closed"][name], ends["open"][name] = sorted(
                (joint.lower, joint.upper), key=lambda q: (round(_gap(robot, arm, {joint.name: q}), 6), abs(q))
            )
            hand = {link for link in robot.links if arm["flange"] in _links_to(robot, link)}
            for end in (joint.lower, joint.upper, float(np.clip(0.0, joint.lower, joint.upper))):
                found = contacts.at({joint.name: end}) - adjacent_pairs(robot)
                touching |= {tuple(sorted(pair)) for pair in found if pair <= hand}
    gripper = ends if any(ends.values()) else {}
    pairs = [list(pair) for pair in sorted(touching)]
    return {"postures": {"home": zero, "zero": zero}, "gripper": gripper, "may_touch": pairs}


def _mostly_touching(robot: RobotDescription, parts: Mapping[str, Mapping[str, Any]]) -> set[frozenset[str]]:
    """Pairs of links that touch in nearly all states, be it only where a lift is at an end."""
    contacts, carried = LinkContacts(robot), [robot.joints[joint] for joint in lift(robot, parts)]
    states = [{}, *({joint.name: end} for joint in carried for end in (joint.lower, joint.upper))]
    found = set[frozenset[str]]().union(*(contacts.always_touching(_MOSTLY, held) for held in states))
    return found - contacts.always_touching() - adjacent_pairs(robot)


def _free_home(
    robot: RobotDescription, zero: Mapping[str, list[float]], parts: Mapping[str, Mapping[str, Any]]
) -> dict[str, list[float]] | None:
    """Return postures of all arms in which no links touch, near to those given; None where these do, or none does."""
    contacts, rng = LinkContacts(robot), np.random.default_rng(0)
    joints = [robot.joints[joint] for arm in parts.values() for joint in arm["joints"]]
    given = np.concatenate([zero[arm] for arm in parts])
    low, high = (np.clip([getattr(j, end) for j in joints], -np.pi, np.pi) for end in ("lower", "upper"))
    for share in np.linspace(0.0, 1.0, _DRAWS):
        q = (given + share * (rng.uniform(low, high) - given)).round(3)
        if not contacts.at({j.name: float(v) for j, v in zip(joints, q, strict=True)}) - robot.allowed_collisions:
            rows = np.split(q, np.cumsum([len(zero[arm]) for arm in parts])[:-1])
            return {arm: row.tolist() for arm, row in zip(parts, rows, strict=True)} if share else None
    return None


def _gap(robot: RobotDescription, arm: Mapping[str, Any], state: Mapping[str, float]) -> float:
    """Mean distance of an arm's fingers, or of its only one from the tool centre point, m."""
    poses = robot.link_poses({**dict.fromkeys(robot.joints, 0.0), **state})
    middles = [poses[arm["tcp"]][:3, 3]] if len(arm["fingers"]) == 1 else []
    for finger in arm["fingers"]:
        shapes = robot.links[finger].collision
        places = [shape.T_link_primitive[:3, 3] for shape in shapes] or [np.zeros(3)]
        middles.append(se3.apply(poses[finger], np.mean(places, axis=0)[None])[0])
    return float(np.mean([np.linalg.norm(a - b) for a, b in itertools.combinations(middles, 2)]))


def _stand(
    robot: RobotDescription, parts: Mapping[str, Mapping[str, Any]], edits: Edits
) -> tuple[float, float, float] | None:
    """Place of a URDF's root over the floor: as the edits say, or on a stand, where arms are lower than tables."""
    if "stand" in edits.model_fields_set:
        return edits.stand
    poses = robot.link_poses(dict.fromkeys(robot.joints, 0.0))
    lowest = min(float(poses[arm["base"]][2, 3]) for arm in parts.values())
    return None if lowest >= _LOWEST_TABLE else (0.0, 0.0, _STAND)


def _write_urdf(path: Path, root: ET.Element, *, licensed: bool) -> None:
    ET.indent(root)
    head = f'<?xml version="1.0"?>\n{_LICENCE}' if licensed else ""
    path.write_text(head + ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")


def write_yaml(path: Path, content: Mapping[str, Any], head: str = "") -> None:
    """Write a YAML file below the lines of comment that it begins with, or those of `head`."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
    head = head or "".join(itertools.takewhile(lambda line: line.startswith("#"), lines)) or _LICENSED
    path.write_text(head + yaml_text(content), encoding="utf-8")


def yaml_text(content: Mapping[str, Any]) -> str:
    """Return YAML as files of robots have it: numbers in rows, no aliases."""
    return yaml.dump(dict(content), Dumper=_Dumper, sort_keys=False, width=120, default_flow_style=None)
