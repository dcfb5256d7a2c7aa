# SPDX-License-Identifier: Apache-2.0
"""Timings of joint polylines: corners rounded where that is proven free, or with a stop, or quintic with a stop.

A path with rounded corners is not the one that was planned: it needs a validation of its own, and where that fails the
corner is rounded less, at last not at all. s, rad, rad/s, rad/s², rad/s³.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from openarm_common.types import Array
from openarm_motion.timing.trajectory import JointLimits, Trajectory, at_rest, distinct, resting, split, time_rounded

#: Shares of the greatest speed that a corner is tried with, one after the other; the last one is a stop.
_CAPS = (1.0, 0.5, 0.25, 0.0)
#: Greatest derivatives of 10 u³ - 15 u⁴ + 6 u⁵ over 0 to 1.
_QUINTIC = (1.875, 10.0 / np.sqrt(3.0), 60.0)


class PolylineTiming:
    """Timings of one polyline, the fastest first.

    Args:
        how: Corners rounded ("blended"), or with a stop ("stops"), or quintic with a stop.
        names: Joints.
        waypoints: (m, n) rad.
        limits: Limits that no joint exceeds.
        period: Greatest time between two samples, s.
    """

    def __init__(
        self,
        how: Literal["blended", "stops", "quintic"],
        names: Sequence[str],
        waypoints: Array,
        limits: JointLimits,
        period: float,
    ) -> None:
        self._how, self._names, self._waypoints, self._limits, self._period = how, names, waypoints, limits, period
        # which of the shares each way point is tried with; the ends are no corners
        self._tried = np.full(len(waypoints), len(_CAPS) - 1)
        if how == "blended":
            self._tried[1:-1] = 0
        #: When the last trajectory is in each of the way points, s; zeros, where it is quintic.
        self.moments = np.zeros(len(waypoints))

    def trajectory(self) -> Trajectory:
        """The polyline timed, its corners rounded as far as is left to try."""
        if self._how == "quintic":
            return time_quintic(self._names, self._waypoints, self._limits, self._period)
        caps = np.array(_CAPS)[self._tried]
        found, self.moments = time_rounded(self._names, self._waypoints, self._limits, caps, self._period)
        return found

    def round_less(self, t: float) -> bool:
        """Round the corner that the last trajectory passes next to `t`, s, less; all of them when `t` is not finite.

        Returns:
            Whether there is another trajectory to try.
        """
        left = np.flatnonzero(self._tried < len(_CAPS) - 1)
        if not left.size:
            return False
        if np.isfinite(t):
            left = left[np.argmin(np.abs(self.moments[left] - t))]
        self._tried[left] += 1
        return True


def time_quintic(names: Sequence[str], waypoints: Array, limits: JointLimits, period: float = 0.02) -> Trajectory:
    """Time straight joint segments as quintic polynomials, velocity and acceleration zero in every way point.

    Args:
        names: Joints.
        waypoints: (m, n) rad.
        limits: Limits that no joint exceeds.
        period: Greatest time between two samples, s.
    """
    path = waypoints[distinct(waypoints)]
    if len(path) == 1:
        return resting(names, path[0], period)
    size = np.abs(np.diff(path, axis=0))
    peaks = zip(_QUINTIC, limits, strict=True)
    ratios = [np.max(peak * size / limit, axis=1) ** (1.0 / order) for order, (peak, limit) in enumerate(peaks, 1)]
    # a nanosecond more, since times are rounded to that
    borders = np.append(0.0, np.cumsum(np.max(ratios, axis=0) + 1e-9)).round(9)
    # between two samples a trajectory is a quintic polynomial already
    rest = np.zeros_like(path)
    whole = Trajectory(tuple(names), borders, path, rest, rest)
    t = split(borders, period)
    return at_rest(names, t, *whole.at(t))
