# SPDX-License-Identifier: Apache-2.0
"""`openarm order`: several objects, one after the other, to free spots or into bins."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError


def order(
    *labels: str,
    bins: Path | None = None,
    each: int = 1,
    domain: int | None = None,
    timeout: float = 300.0,
) -> Outcome:
    """Pick several objects of the running graph and place them, until nothing is left or nothing can be done.

    `openarm order red --each 9` takes all that is red; with --bins, each class goes into its bin.

    Args:
        labels: What to pick, in this order.
        bins: YAML with `bins` (rectangles x, y on the table, m), `classes` (bin of a label) and `rest` (bin of others).
        each: Most objects of one label.
        domain: ROS_DOMAIN_ID of the graph; found by itself when one graph runs on this machine.
        timeout: Longest wait for one object, s.
    """
    from rich.console import Console

    from openarm_bringup.commands.pick import meet_graph, needing
    from openarm_grasp.strategy.orders import Order, load_bins

    work = Order(labels, load_bins(bins) if bins is not None else None, each)
    meet_graph(domain)
    from openarm_grasp.ros.client import GraspClient

    console = Console(stderr=True, highlight=False)
    results: list[dict[str, Any]] = []
    with needing("grasp", "sim"), GraspClient() as client:
        while ask := work.next():
            try:
                result = client.pick(ask.label, place=ask.place, leave=ask.leave, timeout=timeout)
            except KeyboardInterrupt:
                data = {"placed": work.placed, "results": results}
                return Outcome(False, "cancelled by Ctrl-C; the arm holds where it is", Code.CANCELLED, data)
            work.done(ask, result.code, result.message, result.place_position)
            results.append({"label": ask.label, "place": ask.place, "code": result.code, "message": result.message})
            console.print(f"{ask.label}: {result.code}: {result.message}", markup=False)
            if result.code in (Code.CANCELLED, Code.ROBOT_LOST, Code.NOT_READY):
                raise OpenArmError(result.code, f"the order was stopped at {ask.label!r}: {result.message}")
    faults = work.faults()
    data = {"outcome": work.outcome, "placed": work.placed, "faults": dict(faults), "results": results}
    text = "; ".join(f"{label}: {why}" for label, why in faults.items())
    message = f"{work.outcome}: {len(work.placed)} placed" + (f"; {text}" if text else "")
    return Outcome(not faults, message, Code.OK if not faults else Code.PLACE_FAILED, data)
