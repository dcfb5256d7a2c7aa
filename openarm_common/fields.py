# SPDX-License-Identifier: Apache-2.0
"""Whether the fields of a message hold what their types say.

The setters of rclpy do not check unless a variable of the environment says so, and the conversion to C ends the process
(an assertion) at a text or NaN in an integer, or sends 300 as 44 in a uint8.
"""

from __future__ import annotations

import re
from typing import Any

from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief

#: A field of several values: `of` and `most`, or `array` and `size`.
SEQUENCE = re.compile(r"^sequence<(?P<of>.+?)(, (?P<most>\d+))?>$|^(?P<array>.+)\[(?P<size>\d+)\]$")
_INTEGER = re.compile(r"(?P<unsigned>u?)int(?P<bits>8|16|32|64)")
_TEXT = re.compile(r"w?string(<(?P<most>\d+)>)?")


def check_message(message: Any, where: str = "") -> None:
    """Refuse a message with a field that its type can't hold.

    Args:
        message: A message, request or goal.
        where: Path of the message, for the error.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the field, its value and what was expected.
    """
    for name, kind in message.get_fields_and_field_types().items():
        check_field(kind, getattr(message, name), f"{where}.{name}" if where else name)


def check_field(kind: str, value: Any, where: str) -> None:
    """Refuse what a field can't hold.

    Args:
        kind: Type of the field, as messages name it.
        value: Value in Python.
        where: Path of the field, for the error.

    Raises:
        OpenArmError: INVALID_ARGUMENT.
    """
    match = SEQUENCE.match(kind)
    if match is None:
        expected = _expected(kind, value, where)
        if expected:
            raise wrong(where, value, expected)
        return
    inner = match["of"] or match["array"]
    if isinstance(value, str) or not hasattr(value, "__len__"):
        raise wrong(where, value, f"a list of {inner}")
    check_length(match, len(value), where, value)
    if hasattr(value, "typecode") or hasattr(value, "dtype"):
        return  # its setter has made it of numbers of the type
    for index, item in enumerate(value):
        check_field(inner, item, f"{where}[{index}]")


def check_length(match: re.Match[str], length: int, where: str, value: Any) -> None:
    """Refuse a wrong number of values for a field of several, a match of `SEQUENCE`.

    Raises:
        OpenArmError: INVALID_ARGUMENT.
    """
    if (match["size"] and length != int(match["size"])) or length > int(match["most"] or length):
        raise wrong(where, value, f"{match['size'] or 'at most ' + match['most']} values")


def wrong(where: str, value: Any, expected: str) -> OpenArmError:
    """Return the error of a field: its path, what it is, and what was expected."""
    return OpenArmError(Code.INVALID_ARGUMENT, f"{where} is {brief(value)}; expected {expected}")


def _expected(kind: str, value: Any, where: str) -> str:
    """Return what was expected in place of one value; empty where it is right."""
    if "/" in kind:
        of = type(value)
        if f"{of.__module__.partition('.')[0]}/{of.__name__}" != kind:
            return f"a message of type {kind}"
        check_message(value, where)
        return ""
    if integer := _INTEGER.fullmatch(kind):
        bits = int(integer["bits"])
        lowest, highest = (0, 2**bits - 1) if integer["unsigned"] else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        right = isinstance(value, int) and not isinstance(value, bool) and lowest <= value <= highest
        return "" if right else f"a whole number from {lowest} to {highest}"
    if kind in ("float", "double"):
        return "" if isinstance(value, float) else "a number (a float)"
    if kind == "boolean":
        return "" if isinstance(value, bool) else "true or false"
    if kind == "octet":
        return "" if isinstance(value, bytes) and len(value) == 1 else "one byte, 0 to 255"
    if text := _TEXT.fullmatch(kind):
        return _expected_text(value, text["most"])
    return ""


def _expected_text(value: Any, most: str | None) -> str:
    if not isinstance(value, str):
        return "text (put it in quotes)"
    try:
        value.encode()
    except UnicodeEncodeError:
        return "text that UTF-8 can hold"
    return "" if len(value) <= int(most or len(value)) else f"at most {most} characters"
