# SPDX-License-Identifier: Apache-2.0
"""The ten states of a grasp, and the table that says which follows which: a YAML file, read and checked here."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from types import MappingProxyType
from typing import Any

from openarm_common.config import load_yaml
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import config_dir


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
    SKIP = "skip"
    """What lies between is not asked for: a hand that holds its object already, a pick without a place."""
    AGAIN = "again"
    """It did not work, and another try may."""
    END = "end"
    """No further try: a refusal, or all that was asked for."""
    CANCEL = "cancel"
    """The user withdraws the request; the arm holds where it is."""
    LOST = "lost"
    """The robot no longer answers."""


Transitions = Mapping[State, Mapping[Event, State]]

#: States in which the arm is, or may be, among the objects.
AT_WORK = (State.MOVE_TO_PREGRASP, State.MOVE_TO_GRASP, State.CLOSE_GRIPPER, State.LIFT, State.PLACE)
_LOOKING = (State.DETECT, State.TRANSFORM, State.PLAN)
_TABLE = "grasp_transitions.yaml"


def load_transitions(path: Path | None = None) -> Transitions:
    """Read a table and check it: ``table[state][event]`` is the next state, and every pair is defined.

    Args:
        path: YAML file; None is the suite's `config/params/grasp_transitions.yaml`.

    Raises:
        OpenArmError: CONFIG_INVALID, with every fault: a pair that is missing, a name that does not exist, and a
            transition that a grasp must not make.
    """
    source = path or config_dir() / "params" / _TABLE
    data = load_yaml(source)
    faults: list[str] = []
    table = {state: _row(state, data.get(state.value), faults) for state in State}
    faults += [f"there is no state {name!r}; states: {_names(State)}" for name in data if name not in State.__members__]
    if not faults:
        faults = _broken_rules(table)
    if faults:
        raise OpenArmError(Code.CONFIG_INVALID, "; ".join(f"{source}: {fault}" for fault in faults))
    return MappingProxyType({state: MappingProxyType(row) for state, row in table.items()})


def _row(state: State, data: Any, faults: list[str]) -> dict[Event, State]:
    if not isinstance(data, dict):
        faults.append(f"{state.value}: expected a mapping from each event ({_names(Event)}) to a state")
        return {}
    row: dict[Event, State] = {}
    for event in Event:
        name = str(data.get(event.value))
        if name in State.__members__:
            row[event] = State[name]
        else:
            faults.append(f"{state.value}.{event.value} is {name!r}, expected one of {_names(State)}")
    known = {event.value for event in Event}
    faults += [f"{state.value}: there is no event {key!r}; events: {_names(Event)}" for key in data if key not in known]
    return row


def _names(kind: type[Enum]) -> str:
    return ", ".join(str(member.value) for member in kind)


def _broken_rules(table: Transitions) -> list[str]:
    """What no table may change, so that an edited one still ends, goes home, and counts nothing without evidence."""
    order = list(State)
    faults: list[str] = []

    def require(state: State, event: Event, allowed: tuple[State, ...], why: str) -> None:
        found = table[state][event]
        if found not in allowed:
            names = " or ".join(s.value for s in allowed)
            faults.append(f"{state.value}.{event.value} is {found.value}, expected {names}: {why}")

    for i, state in enumerate(order):
        require(state, Event.DONE, (order[(i + 1) % len(order)],), "a grasp goes through all states in order")
        require(state, Event.MORE, (state, State.IDLE), "more of the same work is the same state")
        for event in (Event.CANCEL, Event.LOST):
            require(state, event, (State.IDLE,), "the arm holds where it is")
        if state is not State.IDLE:
            require(state, Event.REQUEST, (state,), "a request changes nothing while a grasp runs")
    require(State.IDLE, Event.REQUEST, (State.DETECT,), "nothing is grasped that was not looked for")
    for event in (Event.SKIP, Event.AGAIN, Event.END):
        require(State.IDLE, event, (State.IDLE,), "nothing runs")
    for state in _LOOKING:
        require(state, Event.AGAIN, (State.IDLE, State.DETECT), "the next try looks anew")
        require(state, Event.END, (State.IDLE,), "the arm has not moved")
        skip = (State.PLACE,) if state is State.TRANSFORM else (State.IDLE,)
        require(state, Event.SKIP, skip, "only a hand that holds its object already goes on to PLACE")
    for state in AT_WORK:
        require(state, Event.AGAIN, (State.RESET,), "a hand among the objects goes home before it tries again")
        ends = (State.RESET, State.IDLE) if state is State.PLACE else (State.RESET,)
        require(state, Event.END, ends, "the arm goes home")
        held = state in (State.LIFT, State.PLACE)
        require(state, Event.SKIP, (State.IDLE,) if held else (State.RESET,), "only a held object may stay in the hand")
    require(State.RESET, Event.AGAIN, (State.DETECT, State.IDLE), "the next try looks anew")
    require(State.RESET, Event.END, (State.IDLE,), "all that could be done is done")
    require(State.RESET, Event.SKIP, (State.IDLE,), "all that could be done is done")
    return faults


#: The table of the suite.
TRANSITIONS = load_transitions()


def mermaid(table: Transitions) -> str:
    """The table as a Mermaid state diagram; what every state does alike (request, cancel, lost) is left out."""
    everywhere = (Event.REQUEST, Event.CANCEL, Event.LOST)
    lines = ["stateDiagram-v2", "  [*] --> IDLE", f"  IDLE --> {table[State.IDLE][Event.REQUEST].value}: request"]
    for state, row in table.items():
        followers: dict[State, list[str]] = {}
        for event, follower in row.items():
            if event not in everywhere and follower is not state:
                followers.setdefault(follower, []).append(event.value)
        lines += [f"  {state.value} --> {follower.value}: {', '.join(names)}" for follower, names in followers.items()]
    return "\n".join(lines)


def as_text(table: Transitions) -> str:
    """The table with a row a state and a column an event; a dot stays where it is."""
    width = max(len(state.value) for state in State) + 1
    head = " " * width + "".join(f"{event.value:<{width}}" for event in Event)
    rows = [
        f"{state.value:<{width}}"
        + "".join(f"{'.' if follower is state else follower.value:<{width}}" for follower in row.values())
        for state, row in table.items()
    ]
    return "\n".join(line.rstrip() for line in (head, *rows))
