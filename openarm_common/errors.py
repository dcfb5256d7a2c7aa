# SPDX-License-Identifier: Apache-2.0
"""One error tree, one list of codes.

The codes travel as strings in services, actions, reports and the exit messages of the command line, so that a caller
can branch on them; the message says what, which value, what was expected, what to do.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Self


class Code(StrEnum):
    """Why something did not happen; ``OK`` when it did."""

    OK = "OK"
    INVALID_ARGUMENT = "INVALID_ARGUMENT"
    CONFIG_INVALID = "CONFIG_INVALID"
    SCENE_INVALID = "SCENE_INVALID"
    ENVIRONMENT = "ENVIRONMENT"
    NOT_READY = "NOT_READY"
    BUSY = "BUSY"
    CANCELLED = "CANCELLED"
    TIMEOUT = "TIMEOUT"
    UNKNOWN_OBJECT = "UNKNOWN_OBJECT"
    NOTHING_DETECTED = "NOTHING_DETECTED"
    BAD_IMAGE = "BAD_IMAGE"
    INTRINSICS_MISMATCH = "INTRINSICS_MISMATCH"
    TABLE_MISMATCH = "TABLE_MISMATCH"
    MOVING = "MOVING"
    DEGENERATE = "DEGENERATE"
    STALE_DATA = "STALE_DATA"
    NO_TRANSFORM = "NO_TRANSFORM"
    UNREACHABLE = "UNREACHABLE"
    IN_COLLISION = "IN_COLLISION"
    LIMITS = "LIMITS"
    NO_PLAN = "NO_PLAN"
    TOO_WIDE = "TOO_WIDE"
    GRASP_MISSED = "GRASP_MISSED"
    GRASP_LOST = "GRASP_LOST"
    HAND_COLLISION = "HAND_COLLISION"
    PLACE_FAILED = "PLACE_FAILED"
    EXECUTION_FAILED = "EXECUTION_FAILED"
    ROBOT_LOST = "ROBOT_LOST"
    STOPPED = "STOPPED"
    VIOLATION = "VIOLATION"
    INTERNAL = "INTERNAL"


#: Longest message of an error, characters: it may quote what others gave.
_LONGEST = 3000


def said(error: BaseException, longest: int = 300) -> str:
    """Return what an error of a library says, in one line, cut where it is long."""
    text = " ".join(str(error).split())
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


class OpenArmError(Exception):
    """Anything that the suite refuses or could not do.

    Args:
        code: Kind of failure; callers branch on this.
        message: One or two sentences: what, which value, what was expected, what to do.
    """

    def __init__(self, code: Code, message: str) -> None:
        text = message if len(message) <= _LONGEST else f"{message[:_LONGEST]}…"
        super().__init__(f"{code}: {text}")
        self.code = code
        self.message = text

    def settled(self) -> Self:
        """Return the error without the frames that it passed through, for what keeps it.

        They would keep everything that they worked on until the next full garbage collection.
        """
        error: BaseException | None = self
        while error is not None:
            error.__traceback__ = None
            error = error.__cause__ or error.__context__
        return self

    def __reduce__(self) -> tuple[type[OpenArmError], tuple[Code, str]]:
        """Let the error cross process borders (worker pools pickle it)."""
        return (type(self), (self.code, self.message))


@dataclass(frozen=True, eq=False)
class Answer:
    """Outcome of a request; packages add fields.

    Attributes:
        success: The request was fulfilled.
        code: OK, or why not.
        message: A sentence or two on what happened.
    """

    success: bool
    code: Code
    message: str

    def raise_for_code(self) -> Self:
        """Return the answer where the request was fulfilled.

        Raises:
            OpenArmError: The code and message, where it was not.
        """
        if not self.success:
            raise OpenArmError(self.code, self.message)
        return self
