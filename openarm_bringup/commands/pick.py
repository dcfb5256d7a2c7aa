# SPDX-License-Identifier: Apache-2.0
"""`openarm pick` and `order`: ask the running graph for grasps."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from openarm_bringup.commands.connect import Domain, check_arms, join_graph, requires_node
from openarm_bringup.outcome import Outcome, as_text, console
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_interfaces.msg import GraspStatus

    from openarm_grasp.planning.options import Option
    from openarm_grasp.requests.request import GraspRequest
    from openarm_grasp.requests.state_times import StateTime
    from openarm_grasp.ros.client import GraspResult, PairResult


T = TypeVar("T")

#: Requests of an order that are cancelled are asked to stop again after this, s.
_CANCEL_S = 0.2


def pick(
    label: str = "",
    second: str = "",
    *,
    arm: list[str] | None = None,
    at: list[tuple[float, float]] | None = None,
    place: list[tuple[float, float, float]] | None = None,
    place_on: list[str] | None = None,
    yaw: list[float] | None = None,
    phase: Literal["all", "pick", "place", "aside"] = "all",
    time_limit: float = 0.0,
    speed: float = 0.0,
    dry_run: bool = False,
    confirm: bool = False,
    domain: Domain = None,
    timeout: float = 300.0,
) -> Outcome:
    """Pick an object and place it, or two simultaneously; the states are shown while it runs, Ctrl-C cancels it.

    A second Ctrl-C, before the robot holds, is the emergency stop.

    `openarm pick red blue` picks two objects with both arms in parallel, or one after the other where the arms would
    come too near to each other. Options of two objects are given once for each: `--arm left --arm right`.

    Args:
        label: Object to pick: its class, colour or shape, such as cola, red or can, or several words such as "red cube
            left of the can"; without one, the first object that is detected.
        second: Another object, picked in parallel.
        arm: Arm to use: auto when not given.
        at: x y near the object, base frame, m: selects one of several alike.
        place: Place: x y z of the footprint centre, base frame, m (z is not read: the table); chosen when not given.
            Or on or in something in view: --place on:"blue box", --place in:tray.
        place_on: Object to place it on or in, as --place on:THING.
        yaw: Yaw of the object where it is put down, degrees about the vertical; unconstrained when not given.
        phase: pick ends with the object in the hand, place puts down what the hand holds; all does both. aside pushes
            the object away from where it is.
        time_limit: Time limit of the robot, s; then it holds, and the hand keeps what it holds. 0 is none.
        speed: Share of the limits of the joints, 0.001 to 1; 0 is that of the graph: 1 simulated, 0.5 on a real robot.
        dry_run: Plan and report, do not move.
        confirm: Show each plan and ask before it is executed; without a terminal, /grasp/confirm is to answer.
        timeout: Longest wait, s.
    """
    labels = (label, second) if second else (label,)
    arms, spots = _each("arm", arm, labels), _each("at", at, labels)
    places, yaws = _each("place", place, labels), _each("yaw", yaw, labels)
    supports = _each("place-on", place_on, labels)
    if second and phase != "all":
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--phase {phase} is of one object; two are picked and placed")
    if second and confirm:
        raise OpenArmError(Code.INVALID_ARGUMENT, "--confirm is of one object; use --dry-run to see the plan of two")
    join_graph(domain)
    check_arms(*(arm or ()))
    from openarm_grasp.requests.request import GraspRequest
    from openarm_grasp.ros.client import GraspClient

    wanted = [
        GraspRequest.of(
            name,
            arm=which or "auto",
            place=where,
            place_yaw=None if turn is None else math.radians(turn),
            object_at=spot,
            phase=phase,
            dry_run=dry_run,
            timeout=time_limit,
            velocity_scale=speed,
            **({} if on is None else {"place_on": on}),
        )
        for name, which, where, on, turn, spot in zip(labels, arms, places, supports, yaws, spots, strict=True)
    ]
    steps = _Steps(labels)
    with requires_node("grasp", "sim"), GraspClient() as client:
        try:
            if second:
                how: dict[str, Any] = {"dry_run": dry_run, "time_limit": time_limit, "speed": speed}
                both = client.pick_two(*wanted, **how, timeout=timeout, on_feedback=steps)
                return _of_two(both, dry_run=dry_run)
            ask = confirm and (_runs if sys.stdin.isatty() else True)
            result = client.carry_out(wanted[0], confirm=ask, timeout=timeout, on_feedback=steps)
        except KeyboardInterrupt as interrupt:
            asked = {"labels": labels} if second else {"label": label}
            if isinstance(interrupt.__context__, KeyboardInterrupt):  # the second, before the goal has ended
                from openarm_bringup.ros.stop_client import emergency_stop

                return Outcome(False, f"emergency stop: {emergency_stop()[1]}", Code.STOPPED, asked)
            return Outcome(False, "cancelled by Ctrl-C; the robot holds where it is", Code.CANCELLED, asked)
    times = _times_line(result.state_times)
    data, options = {**_result_row(result), "dry_run": dry_run}, result.options if dry_run else ()
    if dry_run:
        data["options"] = [_option_row(option) for option in options]
    text = _options_table(options) + times + _kept(result.recording)
    return Outcome(result.success, result.message, result.code, data, text)


def _kept(recording: str) -> str:
    return f"recording: {recording} (openarm check, openarm replay)\n" if recording else ""


def _each(name: str, given: list[T] | None, labels: Sequence[str]) -> Sequence[T | None]:
    """Return the value of an option for each object; None where it is not given."""
    if given is None:
        return [None] * len(labels)
    if len(given) != len(labels):
        of = " and ".join(repr(label) for label in labels)
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"--{name} is given {len(given)} times, expected {len(labels)}: once for each of {of}",
        )
    return given


def _runs(plan: GraspStatus) -> bool:
    """Show a plan on the terminal, and return whether it is to be executed."""
    shown = console()
    for line in (f"plan {plan.plan_id}:", *(f"  {part}" for part in plan.reason.split("; ")[:-1])):
        shown.print(line, markup=False)
    shown.print("run this plan? [y/N] ", end="", markup=False)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


class _Steps:
    """Prints each state as it is entered, at robot time since the first."""

    def __init__(self, labels: Sequence[str]) -> None:
        self._console = console()
        self._width = max(map(len, labels)) if len(labels) > 1 else 0
        self._first_s: float | None = None

    def __call__(self, status: GraspStatus) -> None:
        stamp = status.header.stamp.sec + status.header.stamp.nanosec * 1e-9
        self._first_s = stamp if self._first_s is None else self._first_s
        label = f"{status.label:<{self._width}}  " if self._width else ""
        line = f"{stamp - self._first_s:7.2f} s  {label}[cyan]{status.state:<18}[/cyan]"
        self._console.print(line, end=" ")
        self._console.print(status.reason, markup=False)
        if status.plan_id and not sys.stdin.isatty():
            call = f'openarm service call /grasp/confirm "{{plan_id: {status.plan_id}, accept: true}}"'
            self._console.print(f"confirm it by: {call}", markup=False, soft_wrap=True)


def _option_row(option: Option) -> dict[str, Any]:
    margin = option.limit_margin
    return {**asdict(option), "code": str(option.code), "limit_margin": None if math.isnan(margin) else margin}


def _options_table(options: Sequence[Option]) -> str:
    """Return a table of the candidates that were rated: the terms of each score, and why it was not chosen."""
    from rich.markup import escape
    from rich.table import Table

    if not options:
        return ""
    parts = list(dict.fromkeys(name for option in options for name in option.parts))
    table = Table(box=None, pad_edge=False)
    table.add_column("candidate", no_wrap=True)
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
    lines = (line.rstrip() for line in as_text(table, width=160).splitlines())
    return "\n".join(lines) + "\n(margin: to the nearest joint limit, on the approach and the retreat)\n"


def _times_line(times: Sequence[StateTime]) -> str:
    """Return a line of the time in each state; visits that took longer than expected say so."""
    parts = [
        f"{one.state} {one.duration:.1f}" + (f" (a visit of {one.longest:.1f} over {one.budget:g})" * one.exceeded)
        for one in times
    ]
    return f"time in states, s: {', '.join(parts)}\n" if parts else ""


def _result_row(result: GraspResult) -> dict[str, Any]:
    names = ("outcome", "label", "arm", "route", "attempts", "duration", "recording")
    row = {name: getattr(result, name) for name in names}
    times = [asdict(one) for one in result.state_times]
    return {**row, "place_position": list(result.place_position), "state_times": times}


def _of_two(result: PairResult, *, dry_run: bool) -> Outcome:
    answers = [
        {"success": one.success, "code": str(one.code), "message": one.message, **_result_row(one)}
        for one in result.results
    ]
    data = {name: getattr(result, name) for name in ("outcome", "simultaneous", "duration", "recording")}
    data |= {"answers": answers, "dry_run": dry_run}
    text = "".join(f"{one.label}: {_times_line(one.state_times)}" for one in result.results)
    return Outcome(result.success, result.message, result.code, data, text + _kept(result.recording))


def order(
    *labels: str,
    bins: Path | None = None,
    each: int = 0,
    speed: float = 0.0,
    domain: Domain = None,
    timeout: float = 300.0,
) -> Outcome:
    """Pick several objects of the running graph and place them, until nothing is left or nothing can be done.

    Of several arms each takes the next object as soon as it is free.

    `openarm order anything` clears the table, `openarm order red` takes all that is red; the easiest comes first. What
    cannot be taken is tried again when something else has been taken away, and listed at the end with the reason. With
    --bins, each class goes into its bin, on a place that is free.

    Args:
        labels: Objects to pick, in this order: each words as for `pick`.
        bins: YAML with `bins` (rectangles x, y on the table, m), `classes` (bin of a label) and `rest` (bin of others).
        each: Most objects of each label; 0 is all.
        speed: Share of the limits of the joints, as for `pick`.
        timeout: Longest wait for one object, s.
    """
    from openarm_grasp.requests.bins import load_bins
    from openarm_grasp.requests.orders import GONE, Order

    join_graph(domain)
    from openarm_common.robot.description import RobotDescription
    from openarm_grasp.ros.client import GraspClient

    arms = RobotDescription.load().arm_names
    work = Order(labels, load_bins(bins) if bins is not None else None, each, arms)
    shown, results = console(), list[dict[str, Any]]()
    running: dict[Future[GraspResult], GraspRequest] = {}
    with requires_node("grasp", "sim"), GraspClient() as client, ThreadPoolExecutor(len(arms)) as pool:
        try:
            while True:
                while (ask := work.next()) is not None:
                    asked = replace(ask, velocity_scale=speed)
                    running[pool.submit(client.carry_out, asked, timeout=timeout)] = ask
                if not running:
                    break
                for answer in wait(running, return_when=FIRST_COMPLETED).done:
                    ask, result = running.pop(answer), answer.result()
                    seen = result.object_position
                    how = {"touched": result.attempts > 0, "held": result.outcome == "PARTIAL"}
                    ends = result.place_position, seen
                    left = work.done(ask, result.code, result.message, *ends, **how, by=result.arm)
                    label = work.label_of(ask)
                    row = {"label": label, "position": seen and list(seen), "code": result.code}
                    place = list(result.place_position) if result.success else None
                    results.append({**row, "message": result.message, "place": place})
                    if left is not None or result.code not in GONE:
                        shown.print(f"{label}: {result.code}: {result.message}", markup=False)
        except BaseException as error:
            while running and wait(running, _CANCEL_S).not_done:  # one that was just begun, too
                client.cancel()
            if not isinstance(error, KeyboardInterrupt):
                raise
            data = {"placed": work.placed, "results": results}
            return Outcome(False, "cancelled by Ctrl-C; the robot holds where it is", Code.CANCELLED, data)
    faults = work.faults()
    remain = [{**asdict(one), "code": str(one.code)} for one in work.left]
    data = {"outcome": work.outcome, "placed": work.placed, "left": remain, "faults": list(faults), "results": results}
    message = f"{work.outcome}: {len(work.placed)} placed, {len(work.left)} left"
    return Outcome(
        not faults, message, Code.OK if not faults else Code.PLACE_FAILED, data, "".join(f"left: {t}\n" for t in faults)
    )
