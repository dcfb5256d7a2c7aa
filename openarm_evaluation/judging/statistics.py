# SPDX-License-Identifier: Apache-2.0
"""Rates with their Wilson intervals, spreads, and the summary of judged rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest


def interval(successes: int, n: int) -> dict[str, Any]:
    """Return a rate with its 95 % Wilson interval, 0 to 1; nothing is known for n = 0."""
    low, high = binomtest(successes, n).proportion_ci(method="wilson") if n else (0.0, 1.0)
    rate = successes / n if n else 0.0
    bounds = {"low": round(float(low), 4), "high": round(float(high), 4)}
    return {"n": n, "count": successes, "rate": round(rate, 4), **bounds}


def rate_of(outcomes: Iterable[object]) -> dict[str, Any]:
    """Return the share of outcomes that are true, with its interval."""
    counted = [bool(outcome) for outcome in outcomes]
    return interval(sum(counted), len(counted))


def spread(values: Iterable[float]) -> dict[str, float] | None:
    """Return median, 95th percentile (nearest rank) and maximum; None without values."""
    found = list(values)
    if not found:
        return None
    p95 = np.percentile(found, 95, method="inverted_cdf")
    return {"median": round(float(np.median(found)), 2), "p95": round(float(p95), 2), "max": round(max(found), 2)}


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Sum up rows with placed, attempts, false_success, place_error_mm and sim_s; figures of nothing are None."""
    placed = [row for row in rows if row["placed"]]
    return {
        "n": len(rows),
        "success": len(placed),
        "first_attempt": sum(row["attempts"] == 1 for row in placed),
        "false_success": sum(bool(row["false_success"]) for row in rows),
        "wilson_low": round(interval(len(placed), len(rows))["low"], 3),
        "place_error_mm": spread(row["place_error_mm"] for row in placed),
        "cycle_s": spread(row["sim_s"] for row in placed),
    }
