# SPDX-License-Identifier: Apache-2.0
"""Rates with their Wilson intervals, spreads, and the summary of judged rows."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def wilson_low(successes: int, n: int, z: float = 1.96) -> float:
    """Return the lower bound of the Wilson interval of a success rate (95 % at z = 1.96); 0 for n = 0."""
    if n == 0:
        return 0.0
    rate = successes / n
    centre = rate + z * z / (2 * n)
    margin = z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    return (centre - margin) / (1 + z * z / n)


def interval(successes: int, n: int) -> dict[str, Any]:
    """Return a rate with its 95 % Wilson interval, 0 to 1."""
    low, high = wilson_low(successes, n), 1.0 - wilson_low(n - successes, n)
    rate = successes / n if n else 0.0
    return {"n": n, "count": successes, "rate": round(rate, 4), "low": round(low, 4), "high": round(high, 4)}


def rate_of(outcomes: Iterable[object]) -> dict[str, Any]:
    """Return the share of outcomes that are true, with its interval."""
    counted = [bool(outcome) for outcome in outcomes]
    return interval(sum(counted), len(counted))


def spread(values: Iterable[float]) -> dict[str, float] | None:
    """Return median, 95th percentile (nearest rank) and maximum; None without values."""
    ordered = sorted(map(float, values))
    if not ordered:
        return None
    p95 = ordered[math.ceil(0.95 * len(ordered)) - 1]
    return {"median": round(statistics.median(ordered), 2), "p95": round(p95, 2), "max": round(ordered[-1], 2)}


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Sum up rows with placed, attempts, false_success, place_error_mm and sim_s; figures of nothing are None."""
    placed = [row for row in rows if row["placed"]]
    return {
        "n": len(rows),
        "success": len(placed),
        "first_attempt": sum(row["attempts"] == 1 for row in placed),
        "false_success": sum(bool(row["false_success"]) for row in rows),
        "wilson_low": round(wilson_low(len(placed), len(rows)), 3),
        "place_error_mm": spread(row["place_error_mm"] for row in placed),
        "cycle_s": spread(row["sim_s"] for row in placed),
    }
