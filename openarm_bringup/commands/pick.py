# SPDX-License-Identifier: Apache-2.0
"""`openarm pick`: ask the running graph for a grasp."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from cyclopts import Parameter

from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_interfaces.msg import GraspStatus

    from openarm_grasp.planning.options import Option
    from openarm_grasp.ros.answers import GraspResult, PairResult


Arm = Literal["auto", "left", "right"]
Flag = Annotated[bool, Parameter(negative=())]
T = TypeVar("T")


def pick(
    label: str = "",
    second: str = "",
    *,
    arm: list[Arm] | None = None,
    at: list[tuple[float, float]] | None = None,
    place: list[tuple[float, float, float]] | None = None,
    yaw: list[float] | None = None,
    phase: Literal["all", "pick", "place"] = "all",
    time_limit: float = 0.0,
    dry_run: Flag = False,
    domain: int | None = None,
    timeout: float = 300.0,
) -> Outcome:
    """Pick an object and place it, or two at once; the states are shown while it runs, Ctrl-C cancels it.

    `openarm pick red blue` picks both with both arms at the same time; one after the other where the arms would be in
    each other's way. Where something is said of two objects, it is said of each: `--arm left --arm right`.

    Args:
        label: What to pick: a label such as red, or words such as "red cube left of the can"; without one, what is seen
            best.
        second: Another object, at the same time.
        arm: Which arm: auto when not given.
        at: x y near which the object stands, base frame, m: which of several alike.
        place: Where to: x y z of the footprint centre, base frame, m (z is not read: the table); chosen when not given.
        yaw: Of the object where it is put down, degrees about the vertical; as the hand likes when not given.
        phase: pick ends with the object in the hand, place puts down what the hand holds; all does both.
        time_limit: Of the robot, s; then it holds, and the hand keeps what it holds. 0 is none.
        dry_run: Plan and report, do not move.
        domain: ROS_DOMAIN_ID of the graph; found by itself when one graph runs on this machine.
        timeout: Longest wait, s.
    """
    labels = (label, second) if second else (label,)
    arms, spots = _each("arm", arm, labels), _each("at", at, labels)
    places, yaws = _each("place", place, labels), _each("yaw", yaw, labels)
    if second and phase != "all":
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--phase {phase} is of one object; two are picked and placed")
    meet_graph(domain)
    labels, spots = _meant(labels, spots)
    from openarm_grasp.ros.answers import Wanted
    from openarm_grasp.ros.client import GraspClient

    wanted = [
        Wanted(name, which or "auto", where, None if turn is None else math.radians(turn), spot)
        for name, which, where, turn, spot in zip(labels, arms, places, yaws, spots, strict=True)
    ]
    show = _Steps(labels)
    with needing("grasp", "sim"), GraspClient() as client:
        try:
            if second:
                first, other = wanted
                both = client.pick_two(
                    first, other, dry_run=dry_run, time_limit=time_limit, timeout=timeout, on_feedback=show
                )
                return _of_two(both, dry_run=dry_run)
            (one,) = wanted
            result = client.pick(
                one.label,
                arm=one.arm,
                object_at=one.object_at,
                place=one.place,
                place_yaw=one.place_yaw,
                phase=phase,
                dry_run=dry_run,
                time_limit=time_limit,
                timeout=timeout,
                on_feedback=show,
            )
        except KeyboardInterrupt:
            asked = {"labels": labels} if second else {"label": label}
            return Outcome(False, "cancelled by Ctrl-C; the robot holds where it is", Code.CANCELLED, asked)
    if not dry_run:
        return Outcome(result.success, result.message, result.code, {**_told(result), "dry_run": False})
    data = {**_told(result), "dry_run": True, "options": [_fared(option) for option in result.options]}
    return Outcome(result.success, result.message, result.code, data, _weighed(result.options))


def _meant(
    labels: Sequence[str], spots: Sequence[tuple[float, float] | None]
) -> tuple[Sequence[str], Sequence[tuple[float, float] | None]]:
    """Labels and places of what is asked for; who asks in several words means one object of those in view."""
    worded = [i for i, label in enumerate(labels) if " " in label.strip()]
    if not worded:
        return labels, spots
    from openarm_bringup.ros import things_client

    names, places = list(labels), list(spots)
    for i, thing in zip(worded, things_client.find([labels[i] for i in worded]), strict=True):
        if places[i] is not None:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{labels[i]!r} says where it stands; leave --at out")
        names[i], places[i] = thing.label, (float(thing.position[0]), float(thing.position[1]))
    return names, places


def _each(name: str, given: list[T] | None, labels: Sequence[str]) -> Sequence[T | None]:
    """What an option says of each object; None where it says nothing."""
    if given is None:
        return [None] * len(labels)
    if len(given) != len(labels):
        of = " and ".join(repr(label) for label in labels)
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"--{name} is given {len(given)} times, expected {len(labels)}: once for each of {of}",
        )
    return given


class _Steps:
    """Shows each state as it is entered, at robot time since the first."""

    def __init__(self, labels: Sequence[str]) -> None:
        from rich.console import Console

        self._console = Console(stderr=True, highlight=False)
        self._width = max(map(len, labels)) if len(labels) > 1 else 0
        self._first_s: float | None = None

    def __call__(self, status: GraspStatus) -> None:
        stamp = status.header.stamp.sec + status.header.stamp.nanosec * 1e-9
        self._first_s = stamp if self._first_s is None else self._first_s
        who = f"{status.label:<{self._width}}  " if self._width else ""
        line = f"{stamp - self._first_s:7.2f} s  {who}[cyan]{status.state:<18}[/cyan]"
        self._console.print(line, end=" ")
        self._console.print(status.reason, markup=False)


def _fared(option: Option) -> dict[str, Any]:
    margin = option.limit_margin
    return {**asdict(option), "code": str(option.code), "limit_margin": None if math.isnan(margin) else margin}


def _weighed(options: Sequence[Option]) -> str:
    """Every way to grasp that was weighed: what its score is made of, and why it was not chosen."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    if not options:
        return ""
    parts = list(dict.fromkeys(name for option in options for name in option.parts))
    table = Table(box=None, pad_edge=False)
    table.add_column("way to grasp", no_wrap=True)
    table.add_column("arm", no_wrap=True)
    for name in ("score", *parts, "margin"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("")
    for option in options:
        values = (f"{option.parts[name]:+z.2f}" if name in option.parts else "" for name in parts)
        margin = "" if math.isnan(option.limit_margin) else f"{math.degrees(option.limit_margin):.0f}°"
        score = f"{option.score:+.2f}" if option.parts else ""
        code = f"{option.code}: " if option.code not in ("", Code.OK) else ""
        table.add_row(option.id, option.arm, score, *values, margin, escape(f"{code}{option.message}"))
    console = Console(width=160, color_system=None)
    with console.capture() as shown:
        console.print(table)
    lines = (line.rstrip() for line in shown.get().splitlines())
    return "\n".join(lines) + "\n(margin: to the nearest joint limit, on the way down and up again)\n"


def _told(result: GraspResult) -> dict[str, Any]:
    return {
        "outcome": result.outcome,
        "label": result.label,
        "arm": result.arm,
        "route": result.route,
        "attempts": result.attempts,
        "place_position": list(result.place_position),
        "duration": result.duration,
    }


def _of_two(result: PairResult, *, dry_run: bool) -> Outcome:
    answers = [
        {"success": one.success, "code": str(one.code), "message": one.message, **_told(one)} for one in result.answers
    ]
    data = {
        "outcome": result.outcome,
        "at_once": result.at_once,
        "answers": answers,
        "duration": result.duration,
        "dry_run": dry_run,
    }
    return Outcome(result.success, result.message, result.code, data)


def meet_graph(domain: int | None) -> None:
    """Set this process up to meet the graph: of that domain, or the only one that runs here."""
    from openarm_bringup.supervision import runs
    from openarm_bringup.supervision.environment import ACROSS_MACHINES, PROFILE, network_profile

    try:
        record = runs.the_running(domain)
    except OpenArmError as error:
        if error.code != Code.NOT_READY:
            raise
        # It may run elsewhere, or have been started by other means: the environment says where.
        if domain is not None:
            os.environ["ROS_DOMAIN_ID"] = str(domain)
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        return
    os.environ["ROS_DOMAIN_ID"] = str(record.domain)
    if record.discovery != "system_default":
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = record.discovery.upper()
    if record.discovery in ACROSS_MACHINES:
        os.environ.setdefault(PROFILE, str(network_profile()))


@contextmanager
def needing(node: str, graph: str) -> Iterator[None]:
    """Where a node does not answer because the graph that runs here has none of the name, say that, and who has.

    Args:
        node: Its name.
        graph: That has it.

    Raises:
        OpenArmError: NOT_READY.
    """
    from openarm_bringup.supervision import runs

    try:
        yield
    except OpenArmError as error:
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        here = [run for run in runs.running() if str(run.domain) == domain]
        if error.code != Code.NOT_READY or not here or any(node in run.nodes for run in here):
            raise
        names = " and ".join(run.graph for run in here)
        raise OpenArmError(
            Code.NOT_READY,
            f"what runs here in domain {domain} ({names}) has no node `{node}`, and no other answers: stop it, and "
            f"start one that has it, `openarm up {graph}`",
        ) from error
