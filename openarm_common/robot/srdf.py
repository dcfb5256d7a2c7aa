# SPDX-License-Identifier: Apache-2.0
"""Read SRDF text into frozen data: named postures, and the collisions that are not checked."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from openarm_common.robot.xml_text import attribute, by_name, floats, parse_root


@dataclass(frozen=True)
class Semantics:
    """What the SRDF adds to the URDF. `states` is (group, state) → joint → position.

    `members` is group → (`joint`, name), (`group`, name), or (`chain`, base link, tip link).
    """

    groups: frozenset[str]
    members: Mapping[str, tuple[tuple[str, ...], ...]]
    states: Mapping[tuple[str, str], Mapping[str, float]]
    allowed_collisions: frozenset[frozenset[str]]


def parse_srdf(text: str) -> Semantics:
    """Read SRDF text; "" gives empty semantics.

    Raises:
        OpenArmError: CONFIG_INVALID, when it is not XML or an attribute is missing.
    """
    root = parse_root(text, "SRDF") if text else ET.Element("robot")
    groups = frozenset(attribute(e, "name") for e in root.findall("group"))
    states = by_name("group_state", map(_state, root.findall("group_state")))
    pairs = frozenset(
        frozenset((attribute(e, "link1"), attribute(e, "link2"))) for e in root.findall("disable_collisions")
    )
    members = {attribute(e, "name"): tuple(map(_member, e)) for e in root.findall("group")}
    return Semantics(groups, MappingProxyType(members), MappingProxyType(states), pairs)


def _member(element: ET.Element) -> tuple[str, ...]:
    keys = ("base_link", "tip_link") if element.tag == "chain" else ("name",)
    return (element.tag, *(attribute(element, key) for key in keys))


def shifted(text: str, offsets: Mapping[str, float]) -> str:
    """Return SRDF text with the named postures as joints report them that are at `position + offset` then.

    Args:
        text: SRDF, or "".
        offsets: Offsets by joint, rad or m.
    """
    if not text:
        return text
    root = parse_root(text, "SRDF")
    for element in root.findall("group_state/joint"):
        if offset := offsets.get(attribute(element, "name")):
            element.set("value", repr(floats(attribute(element, "value"), 1, element)[0] - offset))
    return ET.tostring(root, encoding="unicode")


def _state(element: ET.Element) -> tuple[tuple[str, str], Mapping[str, float]]:
    joints = {attribute(e, "name"): floats(attribute(e, "value"), 1, e)[0] for e in element.findall("joint")}
    return (attribute(element, "group"), attribute(element, "name")), MappingProxyType(joints)
