# SPDX-License-Identifier: Apache-2.0
"""Agreement of two campaigns of the same scenes: one in process, one through the node graph.

A scene agrees when it ended alike (placed, refused or failed, with the same code) and each object in it was grasped by
the same arm in as many attempts. Times and place errors are compared, but decide nothing: they depend on the machine.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from openarm_common.errors import Code, OpenArmError
from openarm_evaluation.campaign.rows import ROWS, CompareRow, read_lines
from openarm_evaluation.judging.statistics import interval

Row = Mapping[str, Any]


def rows_of(folder: Path) -> list[Row]:
    """Read the rows of a campaign that has ended, or been interrupted.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the folder has none.
    """
    path = folder / ROWS
    if not path.is_file():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{folder} is no folder of a campaign: it has no {path.name}")
    return [*read_lines(path, CompareRow)[0]]


def compare(rows: Sequence[Row], others: Sequence[Row]) -> dict[str, Any]:
    """Compare two campaigns on the scenes that both have.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when they share no scene, or a seed means different scenes in them.
    """
    there = {(row["set"], row["seed"]): row for row in others}
    pairs = [(row, there[row["set"], row["seed"]]) for row in rows if (row["set"], row["seed"]) in there]
    if not pairs:
        raise OpenArmError(Code.INVALID_ARGUMENT, "the two campaigns have no scene in common")
    changed = [a["seed"] for a, b in pairs if a["scene_hash"] != b["scene_hash"]]
    if changed:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"seeds {changed} mean other scenes there: it was made with another version"
        )
    differ = {a["seed"]: why for a, b in pairs if (why := _difference(a, b))}
    errors = [abs(x - y) for a, b in pairs for x, y in _both(a, b, "place_error_mm")]
    times = [x / y for a, b in pairs for x, y in _both(a, b, "sim_s") if y > 0.0]
    return {
        "agree": interval(len(pairs) - len(differ), len(pairs)),
        "differ": differ,
        "place_error_difference_mm": round(statistics.median(errors), 2) if errors else None,
        "time_ratio": round(statistics.median(times), 3) if times else None,
    }


def _difference(a: Row, b: Row) -> str:
    """Return what differs; "" when nothing does."""
    faults: list[str] = []
    for key in ("outcome", "code"):
        if a[key] != b[key]:
            faults.append(f"{key} {a[key]}, there {b[key]}")
    for x, y in zip(a["grasps"], b["grasps"], strict=False):
        faults += [f"{x['label']}: {key} {x[key]}, there {y[key]}" for key in ("arm", "attempts") if x[key] != y[key]]
    if len(a["grasps"]) != len(b["grasps"]):
        faults.append(f"{len(a['grasps'])} objects were requested, there {len(b['grasps'])}")
    return "; ".join(faults)


def _both(a: Row, b: Row, key: str) -> list[tuple[float, float]]:
    """Values of the objects that were placed in both."""
    pairs = zip(a["grasps"], b["grasps"], strict=False)
    return [(float(x[key]), float(y[key])) for x, y in pairs if x["placed"] and y["placed"]]


def text_of(result: Mapping[str, Any]) -> str:
    """Return lines for people."""
    agree = result["agree"]
    lines = [
        f"agree on {agree['count']} of {agree['n']} scenes = {100 * agree['rate']:.1f} % (95 %:"
        f" {100 * agree['low']:.1f} to {100 * agree['high']:.1f} %)",
        f"place errors differ by {result['place_error_difference_mm']} mm (median), times by a factor of"
        f" {result['time_ratio']} (median)",
    ]
    return "\n".join([*lines, *(f"seed {seed}: {why}" for seed, why in result["differ"].items())])
