# SPDX-License-Identifier: Apache-2.0
"""Other timings of joint polylines: without stops in the corners, and quintic polynomials as the simple choice.

A corner is rounded by beginning its second segment before the first has ended: the two motions add up, so the path
stays in the triangle of the corner, and the sum is checked against the limits. A path so rounded is not the one that
was planned: it needs a validation of its own. s, rad, rad/s, rad/s², rad/s³.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from openarm_common.types import Array
from openarm_motion.timing.trajectory import (
    SPACING,
    JointLimits,
    Profile,
    Trajectory,
    at_rest,
    joined,
    segments,
    straight_profile,
    time_polyline,
)

#: Shares of the longest overlap of two segments that are tried, and checks of each.
_SHARES = (1.0, 0.8, 0.65, 0.5, 0.35, 0.2, 0.1)
_CHECKS = 60
#: Excess over a limit that is rounding.
_ROUNDING = 1.0 + 1e-6
#: Greatest derivatives of 10 u³ - 15 u⁴ + 6 u⁵ over 0 to 1.
_QUINTIC = (1.875, 10.0 / np.sqrt(3.0), 60.0)


@dataclass(frozen=True, eq=False)
class _Segment:
    """A straight segment (n,) under way from `begin`, from rest to rest."""

    way: Profile
    difference: Array
    begin: float

    def at(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """Way gone, velocity, acceleration, jerk (k, n) at times (k,), of the whole trajectory."""
        own = t - self.begin
        s, v, a, j = self.way.at(own)
        under = (own >= 0.0) & (own < self.way.duration)
        return (
            s[:, None] * self.difference,
            np.where(under, v, 0.0)[:, None] * self.difference,
            np.where(under, a, 0.0)[:, None] * self.difference,
            np.where(under, j, 0.0)[:, None] * self.difference,
        )


def timings(
    how: Literal["blended", "stops", "quintic"],
    names: Sequence[str],
    waypoints: Array,
    limits: JointLimits,
    period: float,
) -> Iterator[Trajectory]:
    """Timed polylines, the best first; the last one is at rest in the corners, where nothing leaves the path.

    Args:
        how: Corners rounded where that is possible, or with a stop, or quintic with a stop.
        names: Joints.
        waypoints: (m, n) rad.
        limits: What no joint exceeds.
        period: Greatest time between two samples, s.
    """
    if how == "quintic":
        yield time_quintic(names, waypoints, limits, period)
        return
    if how == "blended" and len(waypoints) > 2:
        yield time_blended(names, waypoints, limits, period)
    yield time_polyline(names, waypoints, limits, period)


def time_blended(names: Sequence[str], waypoints: Array, limits: JointLimits, period: float = 0.02) -> Trajectory:
    """Time a polyline without stops in its corners where limits allow it.

    Args:
        names: Joints.
        waypoints: (m, n) rad.
        limits: What no joint exceeds.
        period: Greatest time between two samples, s.
    """
    under_way: list[_Segment] = []
    for _, _, difference in segments(waypoints):
        way = straight_profile(difference, limits)
        begin = 0.0
        if under_way:
            last = under_way[-1]
            ends = last.begin + last.way.duration
            begin = ends - _overlap(last, way, difference, ends, limits)
        under_way.append(_Segment(way, difference, begin))
    if not under_way:
        return joined(tuple(names), [], waypoints[0], period)
    end = max(segment.begin + segment.way.duration for segment in under_way)
    borders = np.concatenate([segment.begin + segment.way.t for segment in under_way])
    t = _thinned(np.linspace(0.0, end, max(2, int(np.ceil(end / period)) + 1)), borders)
    parts = [segment.at(t) for segment in under_way]
    q, v, a = (np.sum([part[k] for part in parts], axis=0) for k in range(3))
    q += waypoints[0]
    q[-1] = waypoints[-1]
    return at_rest(tuple(names), t, q, v, a)


def time_quintic(names: Sequence[str], waypoints: Array, limits: JointLimits, period: float = 0.02) -> Trajectory:
    """Time straight joint segments as quintic polynomials, velocity and acceleration zero in every way point.

    Args:
        names: Joints.
        waypoints: (m, n) rad.
        limits: What no joint exceeds.
        period: Greatest time between two samples, s.
    """
    parts: list[Trajectory] = []
    for start, end, difference in segments(waypoints):
        peaks = zip(_QUINTIC, limits, strict=True)
        ratios = [float(np.max(peak * np.abs(difference) / limit)) for peak, limit in peaks]
        duration = max(ratio ** (1.0 / order) for order, ratio in enumerate(ratios, start=1))
        rest = np.zeros((2, difference.size))
        # between two samples a trajectory is a quintic polynomial already
        whole = Trajectory(tuple(names), np.array([0.0, duration]), np.stack([start, end]), rest, rest)
        t = np.linspace(0.0, duration, max(2, int(np.ceil(duration / period)) + 1))
        parts.append(Trajectory(tuple(names), t, *whole.at(t)))
    return joined(tuple(names), parts, waypoints[0], period)


def _overlap(last: _Segment, way: Profile, difference: Array, ends: float, limits: JointLimits) -> float:
    """How long before the end of one segment the next may begin, s; at most half of either."""
    longest = 0.5 * min(last.way.duration, way.duration)
    for share in _SHARES:
        overlap = share * longest
        fresh = _Segment(way, difference, ends - overlap)
        borders = np.concatenate([last.begin + last.way.t, fresh.begin + way.t])
        borders = borders[(borders > ends - overlap) & (borders < ends)]
        t = np.concatenate([np.linspace(ends - overlap, ends - 1e-9, _CHECKS), borders, borders - 1e-9])
        one, two = last.at(t), fresh.at(t)
        if all(np.all(np.abs(one[k] + two[k]) <= limit * _ROUNDING) for k, limit in enumerate(limits, start=1)):
            return overlap
    return 0.0


def _thinned(grid: Array, borders: Array) -> Array:
    """Both together in order, none nearer than `SPACING` to its predecessor; borders go before grid, the ends stay."""
    end = float(grid[-1])
    inner = np.sort(borders[(borders > SPACING) & (borders < end - SPACING)])
    keep: list[float] = []
    for border in inner:
        if not keep or border - keep[-1] >= SPACING:
            keep.append(float(border))
    fixed = np.array([0.0, *keep, end])
    far = np.min(np.abs(grid[:, None] - fixed[None, :]), axis=1) >= SPACING
    return np.sort(np.concatenate([fixed, grid[far]]))
