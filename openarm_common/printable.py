# SPDX-License-Identifier: Apache-2.0
"""Text of others (labels, names in messages and files) made fit for a log or a terminal, and bounds of such text."""

from __future__ import annotations

import re

from openarm_common.errors import Code, OpenArmError

#: Longest label, name or other text that a request or a detection may hold, characters.
LONGEST_TEXT = 256
#: Longest line of a log, characters.
LONGEST_LINE = 10_000
#: Longest representation of a value in an error, characters.
_BRIEF = 80
#: Colours and weights of a terminal, which move nothing and hide nothing that is copied.
_COLOUR = re.compile(r"(\x1b\[[0-9;]*m)")


def brief(value: object) -> str:
    """Return the representation of a value, cut where it is long."""
    try:
        text = repr(value)
    except ValueError:  # an integer of more than 4300 digits
        return f"a {type(value).__name__}"
    return brief_text(text)


def brief_text(text: str) -> str:
    """Return a text, cut where it is long."""
    return text if len(text) <= _BRIEF else f"{text[: _BRIEF - 1]}…"


def printable(text: str, *, colours: bool = False, longest: int | None = None) -> str:
    r"""Return text in one line: what is not printable (controls, escapes, bidi overrides) becomes `\x1b`, `\u202e`, ….

    Args:
        text: Any.
        colours: Keep the codes of terminals for colours.
        longest: Cut what is longer, characters.
    """
    if longest is not None and len(text) > longest:
        text = f"{text[: longest - 1]}…"
    if text.isprintable():
        return text
    parts = _COLOUR.split(text) if colours else [text]
    return "".join(part if colours and _COLOUR.fullmatch(part) else _escaped(part) for part in parts)


def printable_lines(text: str, indent: str = "", *, colours: bool = True) -> str:
    """Return text of several lines with each made printable; those after the first begin with `indent`."""
    lines = (printable(line.removesuffix("\r"), colours=colours) for line in text.split("\n"))
    return f"\n{indent}".join(lines)


def check_length(text: str, what: str) -> str:
    """Return a text of a message.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it has more than `LONGEST_TEXT` characters.
    """
    if len(text) > LONGEST_TEXT:
        said = f"{what} {brief(text)} has {len(text)} characters; expected at most {LONGEST_TEXT}"
        raise OpenArmError(Code.INVALID_ARGUMENT, said)
    return text


def _escaped(text: str) -> str:
    return "".join(
        one if one.isprintable() or one == "\t" else one.encode("unicode_escape").decode("ascii") for one in text
    )
