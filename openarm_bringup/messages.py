# SPDX-License-Identifier: Apache-2.0
"""Messages of any installed type as plain data (YAML, JSON) and back, with errors that say which field is wrong."""

from __future__ import annotations

import importlib
import re
from collections.abc import Sequence
from typing import Any

import yaml

from openarm_bringup.suggest import unknown
from openarm_common.config import brief, parse_yaml
from openarm_common.errors import Code, OpenArmError

_KINDS = ("msg", "srv", "action")
_INTEGER = re.compile(r"(?P<unsigned>u?)int(?P<bits>8|16|32|64)|octet")
#: A field of several values: `of` and `most`, or `array` and `size`.
SEQUENCE = re.compile(r"^sequence<(?P<of>.+?)(, (?P<most>\d+))?>$|^(?P<array>.+)\[(?P<size>\d+)\]$")


def interface(name: str) -> Any:
    """Return the class of a type such as `openarm_interfaces/srv/Grasp`.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is not installed.
    """
    parts = name.split("/")
    if len(parts) == 3 and parts[1] in _KINDS:
        try:
            return getattr(importlib.import_module(f"{parts[0]}.{parts[1]}"), parts[2])
        except ModuleNotFoundError:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"the package {parts[0]!r} is not installed") from None
        except AttributeError:
            known = vars(importlib.import_module(f"{parts[0]}.{parts[1]}"))
            raise unknown(f"type in {parts[0]}/{parts[1]}", parts[2], [k for k in known if k[0].isupper()]) from None
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
        raise _wrong(where or "the message", data, f"a mapping of {', '.join(fields) or 'nothing'}")
    for name, value in data.items():
        path = f"{where}.{name}" if where else str(name)
        if name not in fields:
            raise unknown(f"field of {where or type(message).__name__}", str(name), fields)
        try:
            setattr(message, name, _value(getattr(message, name), fields[name], value, path))
        except (AssertionError, TypeError, ValueError, OverflowError) as error:
            raise _wrong(path, value, f"{fields[name]} ({error})") from error
    return message


def _value(present: Any, kind: str, value: Any, where: str) -> Any:
    match = SEQUENCE.match(kind)
    if match is not None:
        inner = match["of"] or match["array"]
        if not isinstance(value, list | tuple):
            raise _wrong(where, value, f"a list of {inner}")
        # The setters of rclpy do not check unless a variable of the environment says so.
        if (match["size"] and len(value) != int(match["size"])) or len(value) > int(match["most"] or len(value)):
            raise _wrong(where, value, f"{match['size'] or 'at most ' + match['most']} values")
        return [_value(None, inner, item, f"{where}[{i}]") for i, item in enumerate(value)]
    if "/" in kind:
        package, _, short = kind.partition("/")
        fresh = present if present is not None else interface(f"{package}/msg/{short}")()
        return fill(fresh, value, where)
    if kind in ("float", "double"):
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise _wrong(where, value, "a number")
        return float(value)  # YAML reads 1e-3 as text
    if kind == "boolean" and not isinstance(value, bool):
        raise _wrong(where, value, "true or false")
    if integer := _INTEGER.fullmatch(kind):
        lowest, highest = _limits(integer)
        if isinstance(value, bool) or not isinstance(value, int) or not lowest <= value <= highest:
            raise _wrong(where, value, f"a whole number from {lowest} to {highest}")
    if kind.startswith(("string", "wstring")) and not isinstance(value, str):
        raise _wrong(where, value, "text (put it in quotes)")
    return int(value).to_bytes(1, "little") if kind == "octet" else value


def _limits(integer: re.Match[str]) -> tuple[int, int]:
    bits = int(integer["bits"] or 8)
    return (0, 2**bits - 1) if integer["unsigned"] or not integer["bits"] else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def _wrong(where: str, value: Any, expected: str) -> OpenArmError:
    return OpenArmError(Code.INVALID_ARGUMENT, f"{where} is {value!r}; expected {expected}")


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
