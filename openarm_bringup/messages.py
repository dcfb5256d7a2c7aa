# SPDX-License-Identifier: Apache-2.0
"""Messages of any installed type as plain data (YAML, JSON) and back, with errors that say which field is wrong."""

from __future__ import annotations

import importlib
import importlib.util
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from openarm_bringup.suggest import unknown
from openarm_common.config import parse_yaml
from openarm_common.errors import Code, OpenArmError
from openarm_common.fields import SEQUENCE, check_field, check_length, wrong
from openarm_common.printable import brief

_KINDS = ("msg", "srv", "action")


def interface(name: str) -> Any:
    """Return the class of a type such as `openarm_interfaces/srv/Grasp`.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is not installed.
    """
    parts = name.split("/")
    if len(parts) == 3 and parts[1] in _KINDS and parts[0].isidentifier():
        # A name may come from a file: of a package without messages not even its `__init__` is executed.
        package = importlib.util.find_spec(parts[0])
        folders = (package and package.submodule_search_locations) or ()
        if not any((Path(folder) / parts[1]).is_dir() for folder in folders):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"the package {parts[0]!r} is not installed")
        known = vars(importlib.import_module(f"{parts[0]}.{parts[1]}"))
        if not isinstance(known.get(parts[2]), type):
            raise unknown(f"type in {parts[0]}/{parts[1]}", parts[2], [k for k in known if k[0].isupper()])
        return known[parts[2]]
    raise OpenArmError(
        Code.INVALID_ARGUMENT, f"{name!r} is not the name of a type; expected package/msg/Name (or srv, action)"
    )


def to_data(value: Any, longest: int | None = None) -> Any:
    """Return a message, or a value of one, as dictionaries, lists and plain values.

    Args:
        value: A message or a field of one.
        longest: Arrays above this length become their size in words; None keeps them whole.
    """
    if hasattr(value, "get_fields_and_field_types"):
        return {name: to_data(getattr(value, name), longest) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes | bytearray):
        value = list(value)
    value = value.tolist() if hasattr(value, "tolist") else value  # arrays, and scalars of numpy
    if not isinstance(value, list | tuple):
        return value
    items: Sequence[Any] = value
    if longest is not None and len(items) > longest:
        return f"<{len(items)} values>"
    return [to_data(item, longest) for item in items]


def to_yaml(data: Any) -> str:
    """Return plain data as YAML, fields in their order."""
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None)


def fill(message: Any, data: Any, where: str = "") -> Any:
    """Fill a message from plain data; fields that are not named keep their defaults.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the field, what was given and what was expected.
    """
    fields: dict[str, str] = message.get_fields_and_field_types()
    if data is None:
        return message
    if not isinstance(data, dict):
        raise wrong(where or "the message", data, f"a mapping of {', '.join(fields) or 'nothing'}")
    for name, value in data.items():
        path = f"{where}.{name}" if where else str(name)
        if name not in fields:
            raise unknown(f"field of {where or type(message).__name__}", str(name), fields)
        try:
            setattr(message, name, _value(getattr(message, name), fields[name], value, path))
        except (AssertionError, TypeError, ValueError, OverflowError) as error:
            raise wrong(path, value, f"{fields[name]} ({error})") from error
    return message


def _value(present: Any, kind: str, value: Any, where: str) -> Any:
    match = SEQUENCE.match(kind)
    if match is not None:
        inner = match["of"] or match["array"]
        if not isinstance(value, list | tuple):
            raise wrong(where, value, f"a list of {inner}")
        check_length(match, len(value), where, value)
        return [_value(None, inner, item, f"{where}[{i}]") for i, item in enumerate(value)]
    if "/" in kind:
        package, _, short = kind.partition("/")
        fresh = present if present is not None else interface(f"{package}/msg/{short}")()
        return fill(fresh, value, where)
    if kind in ("float", "double"):
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise wrong(where, value, "a number")
        return float(value)  # YAML reads 1e-3 as text
    if kind == "octet" and type(value) is int and 0 <= value < 256:
        return value.to_bytes(1, "little")
    check_field(kind, value, where)
    return value


def fields_of(words: tuple[str, ...], name: str, kind: str) -> Any:
    """Return what to fill in: YAML, after the type or without it.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another type, for two mappings, or what is not YAML.
    """
    asked, fields = type_and_fields(words)
    if asked and asked != kind:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{name} has the type {kind}, not {asked}")
    return fields


def type_and_fields(words: tuple[str, ...]) -> tuple[str, Any]:
    """Split `TYPE FIELDS`, as ros2 takes them; each may be missing.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for two mappings, or what is not YAML.
    """
    asked = words[0] if words and re.fullmatch(r"\w+/\w+/\w+", words[0]) else ""
    rest = words[1:] if asked else words
    if len(rest) > 1:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"expected one YAML mapping, got {' '.join(rest)!r}; put it in quotes"
        )
    return asked, _parse(rest[0] if rest else "{}")


def _parse(text: str) -> Any:
    return parse_yaml(text, brief(text), Code.INVALID_ARGUMENT)
