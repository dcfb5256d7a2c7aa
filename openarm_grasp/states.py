# SPDX-License-Identifier: Apache-2.0
"""The ten states of a grasp and the table that says which follows which."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType


class State(Enum):
    """Where a grasp stands."""

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


class Event(Enum):
    """What a state's result comes down to."""

    REQUEST = "request"
    """Somebody asks for a grasp."""
    DONE = "done"
    """The state has done its work; in IDLE: the next frame has come."""
    MORE = "more"
    """One part of the state's work is done, another follows."""
    AGAIN = "again"
    """It did not work, and another try may."""
    END = "end"
    """No further try: a refusal, or all that was asked for."""
    CANCEL = "cancel"
    """The user withdraws the request; the arm holds where it is."""
    LOST = "lost"
    """The robot no longer answers."""


def _table() -> Mapping[State, Mapping[Event, State]]:
    columns = (Event.REQUEST, Event.DONE, Event.MORE, Event.AGAIN, Event.END, Event.CANCEL, Event.LOST)
    idle, detect, transform, plan, reset = State.IDLE, State.DETECT, State.TRANSFORM, State.PLAN, State.RESET
    pregrasp, grasp, close = State.MOVE_TO_PREGRASP, State.MOVE_TO_GRASP, State.CLOSE_GRIPPER
    lift, place = State.LIFT, State.PLACE
    # A request that comes while a grasp runs is refused (BUSY) and changes nothing.
    # PLACE ends in IDLE when it must: a hand that can put its object nowhere keeps it and says so.
    # fmt: off
    rows = (
        #           REQUEST    DONE       MORE       AGAIN   END    CANCEL  LOST
        (idle,      detect,    detect,    idle,      idle,   idle,  idle,   idle),
        (detect,    detect,    transform, detect,    idle,   idle,  idle,   idle),
        (transform, transform, plan,      transform, detect, idle,  idle,   idle),
        (plan,      plan,      pregrasp,  plan,      detect, idle,  idle,   idle),
        (pregrasp,  pregrasp,  grasp,     pregrasp,  reset,  reset, idle,   idle),
        (grasp,     grasp,     close,     grasp,     reset,  reset, idle,   idle),
        (close,     close,     lift,      close,     reset,  reset, idle,   idle),
        (lift,      lift,      place,     lift,      reset,  reset, idle,   idle),
        (place,     place,     reset,     place,     reset,  idle,  idle,   idle),
        (reset,     reset,     idle,      reset,     detect, idle,  idle,   idle),
    )
    # fmt: on
    return MappingProxyType({row[0]: MappingProxyType(dict(zip(columns, row[1:], strict=True))) for row in rows})


#: ``TRANSITIONS[state][event]`` is the next state; every pair is defined.
TRANSITIONS = _table()
