# SPDX-License-Identifier: Apache-2.0
"""`openarm pick`: ask the running graph for a grasp."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_interfaces.msg import GraspStatus


def pick(
    label: str = "",
    *,
    arm: Literal["auto", "left", "right"] = "auto",
    at: tuple[float, float] | None = None,
    place: tuple[float, float, float] | None = None,
    yaw: float | None = None,
    phase: Literal["all", "pick", "place"] = "all",
    time_limit: float = 0.0,
    dry_run: Annotated[bool, Parameter(negative=())] = False,
    domain: int | None = None,
    timeout: float = 300.0,
) -> Outcome:
    """Pick an object and place it; the states are shown while it runs, Ctrl-C cancels it.

    Args:
        label: What to pick, such as red; without one, what is seen best.
        arm: Which arm.
        at: x y near which the object stands, base frame, m: which of several alike.
        place: Where to: x y z of the footprint centre, base frame, m (z is not read: the table); chosen when not given.
        yaw: Of the object where it is put down, degrees about the vertical; as the hand likes when not given.
        phase: pick ends with the object in the hand, place puts down what the hand holds; all does both.
        time_limit: Of the robot, s; then it holds, and the hand keeps what it holds. 0 is none.
        dry_run: Plan and report, do not move.
        domain: ROS_DOMAIN_ID of the graph; found by itself when one graph runs on this machine.
        timeout: Longest wait, s.
    """
    from rich.console import Console

    meet_graph(domain)
    from openarm_grasp.client import GraspClient

    console = Console(stderr=True, highlight=False)
    first: list[float] = []

    def show(status: GraspStatus) -> None:
        stamp = status.header.stamp.sec + status.header.stamp.nanosec * 1e-9
        first.append(stamp)
        console.print(f"{stamp - first[0]:7.2f} s  [cyan]{status.state:<18}[/cyan]", end=" ")
        console.print(status.reason, markup=False)

    with GraspClient() as client:
        try:
            result = client.pick(
                label,
                arm=arm,
                object_at=at,
                place=place,
                place_yaw=None if yaw is None else math.radians(yaw),
                phase=phase,
                dry_run=dry_run,
                time_limit=time_limit,
                timeout=timeout,
                on_feedback=show,
            )
        except KeyboardInterrupt:
            return Outcome(False, "cancelled by Ctrl-C; the arm holds where it is", Code.CANCELLED, {"label": label})
    data: dict[str, Any] = {
        "outcome": result.outcome,
        "label": result.label,
        "arm": result.arm,
        "route": result.route,
        "attempts": result.attempts,
        "place_position": list(result.place_position),
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
