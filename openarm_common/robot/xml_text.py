# SPDX-License-Identifier: Apache-2.0
"""What the readers of URDF and SRDF share: attributes and numbers of XML elements; errors name the element."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from typing import TypeVar

from openarm_common.errors import Code, OpenArmError

KeyT = TypeVar("KeyT", str, tuple[str, str])
ItemT = TypeVar("ItemT")


def fault(message: str) -> OpenArmError:
    """Build the error for a faulty robot description."""
    return OpenArmError(Code.CONFIG_INVALID, f"robot description: {message}")


def parse_root(text: str, what: str) -> ET.Element:
    """Parse the <robot> document; `what` is its kind, for the error."""
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise fault(f"{what} is not XML: {error}") from error
    if root.tag != "robot":
        raise fault(f"{what} starts with <{root.tag}>, expected <robot>")
    return root


def by_name(kind: str, items: Iterable[tuple[KeyT, ItemT]]) -> dict[KeyT, ItemT]:
    """Collect items by their names; `kind` is what they are, for the error at a name that is used twice."""
    found: dict[KeyT, ItemT] = {}
    for name, item in items:
        if name in found:
            text = name if isinstance(name, str) else " ".join(name)
            raise fault(f"{kind} name {text!r} is used twice; names must be unique")
        found[name] = item
    return found


def attribute(element: ET.Element, key: str) -> str:
    """Return an attribute that has to be there."""
    value = element.get(key)
    if value is None:
        raise fault(f"<{element.tag} {element.attrib}> has no attribute {key!r}")
    return value


def child(element: ET.Element, tag: str) -> ET.Element:
    """Return the child of this tag, which is made where there is none."""
    found = element.find(tag)
    return ET.SubElement(element, tag) if found is None else found


def floats(text: str, count: int, element: ET.Element) -> tuple[float, ...]:
    """Read `count` finite numbers; `element` is named in the error."""
    try:
        values = tuple(float(part) for part in text.split())
    except ValueError as error:
        raise fault(f"<{element.tag} {element.attrib}>: {text!r} is not a list of numbers") from error
    if len(values) != count or not all(math.isfinite(v) for v in values):
        raise fault(f"<{element.tag} {element.attrib}>: expected {count} finite numbers, got {text!r}")
    return values
