# SPDX-License-Identifier: Apache-2.0
"""Write the SRDF of a robot folder: groups, postures, and the collisions that need no check.

A pair of links is not checked for one of four reasons. *Adjacent*: joined by a joint. *Default*: `may_touch` says so.
*Always*: it touches in every one of many random states, so that a check says nothing. *Never*: not nearer than `margin`
in any of the random states, and neither is the mirror image of the pair. `always_checked` stays checked, whatever the
samples say. The same description gives the same file.
"""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from pydantic import Field

from openarm_common.collision.self_collision import LinkContacts, Pair
from openarm_common.config import Config, load_config, read_text
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import read_folder
from openarm_sim_bridge.drafting.collisions import adjacent_pairs, mirror_links

#: File of the robot's folder that the SRDF is written from.
SOURCE = "semantics.yaml"


class SemanticsSource(Config):
    """What `semantics.yaml` says. In names of links, `{arm}` is each arm and `{other}` each of the others."""

    postures: Mapping[str, Mapping[str, tuple[float, ...] | Literal["mirrored"]]] = Field(
        description="by name and arm, rad; `mirrored` is the mirror image of the other arm"
    )
    gripper: Mapping[str, float | Mapping[str, float]] = Field(
        default_factory=dict, description="position of the finger joint by posture, or by posture and arm; rad or m"
    )
    aliases: Mapping[str, str] = Field(default_factory=dict, description="further names of groups, such as a client's")
    may_touch: tuple[tuple[str, str], ...] = Field(
        default=(), description="pairs of links whose shapes touch where the parts do not, or by design"
    )
    always_checked: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = Field(
        default=(), description="each link of the first list against each of the second"
    )
    margin: float = Field(default=0.01, ge=0.0, description="of what never touches, m")
    samples: int = Field(default=60_000, ge=1, description="random states")
    seed: int = Field(default=1, description="of the states")

    def allowed(self, arms: Iterable[str]) -> set[Pair]:
        """Pairs of `may_touch`."""
        return {frozenset(pair) for a, b in self.may_touch for pair in _named((a,), (b,), tuple(arms))}

    def checked(self, arms: Iterable[str]) -> set[Pair]:
        """Pairs of `always_checked`."""
        return {frozenset(pair) for a, b in self.always_checked for pair in _named(a, b, tuple(arms))}


def read_source(folder: Path) -> SemanticsSource:
    """Read `semantics.yaml` of a robot's folder.

    Raises:
        OpenArmError: CONFIG_INVALID, naming what is wrong.
    """
    path = folder / SOURCE
    return load_config(path, SemanticsSource)


def write_srdf(folder: Path, out: Path | None = None) -> tuple[Path, dict[Pair, str]]:
    """Write the SRDF of a robot's folder.

    Args:
        folder: Folder with `robot.yaml` and `semantics.yaml`.
        out: Another file than that of the folder.

    Returns:
        The file, and why each pair of links in it may touch.

    Raises:
        OpenArmError: CONFIG_INVALID, when a file of the folder is faulty.
    """
    parts, source = read_folder(folder), read_source(folder)
    description = RobotDescription.from_files(folder / (parts.xacro or parts.urdf)).of_folder(folder.name, parts)
    reasons = classify(description, source)
    target = out or folder / parts.srdf
    target.write_text(srdf_text(description, source, reasons), encoding="utf-8")
    return target, reasons


def rewrite_states(folder: Path) -> None:
    """Write the SRDF of a robot's folder with other postures and the collision matrix that it has.

    Raises:
        OpenArmError: CONFIG_INVALID, when a file of the folder is faulty.
    """
    parts, source = read_folder(folder), read_source(folder)
    description = RobotDescription.from_files(folder / parts.urdf).of_folder(folder.name, parts)
    old = ET.fromstring(read_text(folder / parts.srdf)).findall("disable_collisions")
    reasons = {frozenset((pair.get("link1", ""), pair.get("link2", ""))): pair.get("reason", "") for pair in old}
    (folder / parts.srdf).write_text(srdf_text(description, source, reasons), encoding="utf-8")


def classify(description: RobotDescription, source: SemanticsSource) -> dict[Pair, str]:
    """Return the reason of every pair of links whose collision is not checked.

    Raises:
        OpenArmError: CONFIG_INVALID, naming links of the source that the robot does not have.
    """
    checked, allowed = source.checked(description.arms), source.allowed(description.arms)
    if unknown := sorted({link for pair in checked | allowed for link in pair} - set(description.links)):
        raise OpenArmError(Code.CONFIG_INVALID, f"{SOURCE} of {description.name!r}: no link {', '.join(unknown)}")
    touching = LinkContacts(description, source.margin).touching(source.samples, source.seed)
    always = LinkContacts(description).always_touching()
    adjacent, image = adjacent_pairs(description), mirror_links(description)
    shaped = [name for name, link in description.links.items() if link.collision]
    reasons: dict[Pair, str] = {}
    for pair in map(frozenset, itertools.combinations(shaped, 2)):
        if pair in adjacent:
            reasons[pair] = "Adjacent"
        elif pair in allowed:
            reasons[pair] = "Default"
        elif pair in checked:
            continue
        elif pair in always:
            reasons[pair] = "Always"
        elif not {pair, frozenset(image[link] for link in pair)} & touching:
            reasons[pair] = "Never"
    return reasons


def srdf_text(description: RobotDescription, source: SemanticsSource, reasons: Mapping[Pair, str]) -> str:
    """Return the whole file."""
    order = {name: index for index, name in enumerate(description.links)}
    rows = sorted(((sorted(pair, key=order.__getitem__), why) for pair, why in reasons.items()),
                  key=lambda row: [order[link] for link in row[0]])  # fmt: skip
    head = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        "<!-- SPDX-License-Identifier: Apache-2.0 -->",
        f"<!-- Written by `openarm model semantics` from {SOURCE}: change that, not this. -->",
        f'<robot name="{ET.fromstring(description.urdf).get("name", "")}">',
    ]
    disabled = [f'  <disable_collisions link1="{a}" link2="{b}" reason="{why}"/>' for (a, b), why in rows]
    return "\n".join([*head, *_groups(description, source), *_states(description, source), *disabled, "</robot>", ""])


def _groups(description: RobotDescription, source: SemanticsSource) -> list[str]:
    """Groups, end effectors, passive joints."""
    lines: list[str] = []
    followers = {
        name: [joint.name for joint in description.joints.values() if joint.mimic == arm.finger_joint]
        for name, arm in description.arms.items()
        if arm.finger_joint
    }
    for name, arm in description.arms.items():
        chain = f'    <chain base_link="{arm.base}" tip_link="{arm.tcp}"/>'
        lines += [f'  <group name="{name}_arm">', chain, "  </group>"]
    for name, others in followers.items():
        joints = [f'    <joint name="{joint}"/>' for joint in (description.finger_joint(name), *others)]
        lines += [f'  <group name="{name}_gripper">', *joints, "  </group>"]
    if len(description.arms) == 2:
        lines += ['  <group name="both_arms">', *(f'    <group name="{name}_arm"/>' for name in description.arms)]
        lines.append("  </group>")
    for name, group in source.aliases.items():
        lines += [f'  <group name="{name}">', f'    <group name="{group}"/>', "  </group>"]
    lines += [
        f'  <end_effector name="{name}_ee" parent_link="{description.arm(name).hand}" group="{name}_gripper"'
        f' parent_group="{name}_arm"/>'
        for name in followers
    ]
    return lines + [f'  <passive_joint name="{joint}"/>' for found in followers.values() for joint in found]


def _states(description: RobotDescription, source: SemanticsSource) -> list[str]:
    """Named postures of each group."""

    def state(group: str, name: str, values: Mapping[str, float]) -> list[str]:
        joints = [f'    <joint name="{joint}" value="{value:.9g}"/>' for joint, value in values.items()]
        return [f'  <group_state name="{name}" group="{group}">', *joints, "  </group_state>"]

    lines: list[str] = []
    for name, by_arm in source.postures.items():
        found: dict[str, dict[str, float]] = {}
        for arm in (arm for arm in description.arm_names if arm in by_arm):
            q = _posture(description, name, arm, by_arm)
            found[arm] = dict(zip(description.arm_joints(arm), q, strict=True))
            lines += state(f"{arm}_arm", name, found[arm])
        if len(found) == len(description.arms) == 2:
            lines += state("both_arms", name, {joint: v for values in found.values() for joint, v in values.items()})
    for arm in (name for name, parts in description.arms.items() if parts.finger_joint):
        for name, opening in source.gripper.items():
            value = opening[arm] if isinstance(opening, Mapping) else opening
            lines += state(f"{arm}_gripper", name, {description.finger_joint(arm): value})
    return lines


def _posture(
    description: RobotDescription, name: str, arm: str, by_arm: Mapping[str, tuple[float, ...] | Literal["mirrored"]]
) -> tuple[float, ...]:
    q = by_arm[arm]
    if q == "mirrored":
        others = [value for value in by_arm.values() if value != "mirrored"]
        if len(others) != 1 or len(description.arms) != 2:
            text = f"{SOURCE} of {description.name!r}: posture {name!r} of {arm!r} is mirrored, expected one other arm"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        return tuple(float(value) + 0.0 for value in description.mirrored(others[0]))
    if len(q) != len(description.arm_joints(arm)):
        text = f"posture {name!r} has {len(q)} values, arm {arm!r} has {len(description.arm_joints(arm))} joints"
        raise OpenArmError(Code.CONFIG_INVALID, f"{SOURCE} of {description.name!r}: {text}")
    return q


def _named(first: Iterable[str], second: Iterable[str], arms: tuple[str, ...]) -> Iterable[tuple[str, str]]:
    """Pairs of two lists of links, with the names of arms filled in."""
    for a, b in itertools.product(first, second):
        for arm in arms or ("",):
            for other in [one for one in arms if one != arm] or [arm]:
                yield a.format(arm=arm, other=other), b.format(arm=arm, other=other)
