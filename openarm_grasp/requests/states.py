# SPDX-License-Identifier: Apache-2.0
"""The ten states of a grasp as they are reported, and which may follow which.

Strategies are functions; a state says how far one has come. `check_transition` refuses a step that is not written here,
so that what is reported, what is documented and what is drawn by `openarm grasp graph` cannot differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType

from openarm_common.errors import Code, OpenArmError


class State(Enum):
    """How far a grasp has come."""

    IDLE = "IDLE"
    DETECT = "DETECT"
    TRANSFORM = "TRANSFORM"
    PLAN = "PLAN"
    MOVE_TO_PREGRASP = "MOVE_TO_PREGRASP"
    MOVE_TO_GRASP = "MOVE_TO_GRASP"
    CLOSE_GRIPPER = "CLOSE_GRIPPER"
    LIFT = "LIFT"
    PLACE = "PLACE"
    RESET = "RESET"


class Hand(Enum):
    """Where the hand is, as far as known; it decides the way home."""

    FREE = "away from objects, empty"
    AT_OBJECT = "around the object or straight above its grasp, empty"
    HOLDING = "around the object or straight above its grasp, holding it"
    CARRYING = "elsewhere, holding the object"
    RELEASED = "around the object that it has put down"
    CLEAR = "away from the object that it has put down"


_STOP = "cancelled, timed out, or the robot is lost: the arm holds"

#: The states that may follow each state, and when. A state that follows itself is another step of the same work.
SUCCESSORS: Mapping[State, Mapping[State, str]] = MappingProxyType(
    {
        State.IDLE: {
            State.DETECT: "a request, or the next frame while an object is waited for",
            State.IDLE: "the request ends while an object is waited for",
        },
        State.DETECT: {
            State.TRANSFORM: "the object is in view",
            State.IDLE: "not in view: wait for the next frame, or give up",
        },
        State.TRANSFORM: {
            State.PLAN: "one object that can be trusted",
            State.PLACE: "the hand holds the object already",
            State.DETECT: "no object that can be trusted: observe again",
            State.IDLE: "refused",
        },
        State.PLAN: {
            State.PLAN: "another grasp, the other arm, or the place",
            State.MOVE_TO_PREGRASP: "planned",
            State.DETECT: "no plan: observe again",
            State.IDLE: "refused, or the end of a dry run",
        },
        State.MOVE_TO_PREGRASP: {
            State.MOVE_TO_PREGRASP: "second observation and correction",
            State.MOVE_TO_GRASP: "the open hand is before the object",
            State.RESET: "failed",
            State.IDLE: _STOP,
        },
        State.MOVE_TO_GRASP: {
            State.MOVE_TO_GRASP: "the object has not moved",
            State.CLOSE_GRIPPER: "the hand is at the grasp",
            State.RESET: "failed",
            State.IDLE: _STOP,
        },
        State.CLOSE_GRIPPER: {
            State.LIFT: "the gripper holds something of the right width",
            State.RESET: "failed",
            State.IDLE: _STOP,
        },
        State.LIFT: {
            State.PLACE: "gripper and camera agree that the object was lifted",
            State.RESET: "failed",
            State.IDLE: "the end of phase pick; or a stop: the arm holds",
        },
        State.PLACE: {
            State.PLACE: "planned, carried, or put back where it stood",
            State.RESET: "released or lost",
            State.IDLE: "it can be put down nowhere: the hand keeps it; the end of a dry run; or a stop",
        },
        State.RESET: {
            State.RESET: "another way home; home; observed again",
            State.DETECT: "failed: the next attempt",
            State.IDLE: "the camera sees the object at its place, or no attempt is left",
        },
    }
)


def check_transition(state: State, successor: State) -> None:
    """Refuse a transition that `SUCCESSORS` does not allow.

    Raises:
        OpenArmError: INTERNAL; a defect of the strategy that asks for it.
    """
    allowed = SUCCESSORS[state]
    if successor not in allowed:
        names = ", ".join(other.value for other in allowed)
        raise OpenArmError(
            Code.INTERNAL,
            f"{successor.value} may not follow {state.value}; allowed: {names} (a defect of the strategy)",
        )


def mermaid() -> str:
    """Draw the states as a Mermaid state diagram."""
    lines = ["stateDiagram-v2", "  [*] --> IDLE"]
    for state, successors in SUCCESSORS.items():
        lines += [f"  {state.value} --> {other.value}: {when}" for other, when in successors.items()]
    return "\n".join(lines)


def as_text() -> str:
    """List each state with its successors and when they follow."""
    width = max(len(state.value) for state in State) + 2
    lines: list[str] = []
    for state, successors in SUCCESSORS.items():
        for i, (other, when) in enumerate(successors.items()):
            lines.append(f"{state.value if i == 0 else '':<{width}}{other.value:<{width}}{when}")
    return "\n".join(lines)
