# SPDX-License-Identifier: Apache-2.0
"""Numba kernels that choose the speeds of a polyline: on each straight segment, and before and after each corner.

A change of velocity takes three pieces of constant jerk: the acceleration rises, stays, falls, of all joints at the
same moments. In a corner the velocity changes from that before it to that after it, around the moment at which the
joints would reach the corner: the path is rounded within its triangle (Taylor, "Planning and execution of straight
line manipulator trajectories", 1979; Kunz and Stilman, "Time-optimal trajectory generation for path following with
bounded acceleration and velocity", 2012; here with limited jerk). Speeds are in segments per second, 1/s. Limits
(3, n) are velocities, accelerations, jerks: rad/s, rad/s², rad/s³.
"""

from __future__ import annotations

import math

import numpy as np

from openarm_common.kernels import kernel
from openarm_common.types import Array

#: No piece is shorter, s: between samples that are nearer to each other positions are too coarse for a jerk.
SPACING = 1e-3
_BISECTIONS = 60
#: The search of speeds: steps of its grid, how often it goes through the corners, and its last step, a share.
_GRID, _SWEEPS, _LAST = 4, 4, 0.004
#: Searches of which the best counts, each from other speeds.
_STARTS = 3


@kernel
def change(acceleration: float, jerk: float) -> tuple[float, float]:
    """Shortest change of velocity: time until the acceleration begins to fall, and time that it rises (and falls), s.

    Args:
        acceleration: The change over the limit of the acceleration, the greatest of all joints, s.
        jerk: The change over the limit of the jerk, the greatest of all joints, s².
    """
    if jerk <= 0.0:
        return 0.0, 0.0
    until = max(acceleration, math.sqrt(jerk), SPACING)
    rise = max(jerk / until, SPACING)
    # a piece between that would be too short is left out, or made long enough
    if until - rise < 0.5 * SPACING:
        rise = until
    elif until - rise < SPACING:
        until = rise + SPACING
    return until, rise


@kernel
def _change_time(speed: float, most: Array) -> float:
    """Time of a change of speed on a segment whose greatest speed, acceleration and jerk are `most`, s."""
    until, rise = change(abs(speed) / most[1], abs(speed) / most[2])
    return until + rise


@kernel
def segment(first: float, last: float, length: float, most: Array) -> tuple[float, float]:
    """Shortest time of a segment between two speeds, and the speed in its middle.

    Args:
        first: Speed at its begin, 1/s.
        last: Speed at its end, 1/s.
        length: Share of the segment.
        most: (3,) greatest speed, acceleration and jerk.

    Returns:
        Time, s, infinite where there is no room to change the speed; and the speed, which stays for `SPACING` or more.
    """
    low, high, peak = max(first, last), most[0], most[0]
    if low > high:
        return np.inf, low
    if _way(first, peak, last, most) > length:
        if low > 0.0 and _way(first, low, last, most) > length:
            return np.inf, low
        for _ in range(_BISECTIONS):
            peak = 0.5 * (low + high)
            if _way(first, peak, last, most) > length:
                high = peak
            else:
                low = peak
        peak = low
    rise, fall = _change_time(peak - first, most), _change_time(peak - last, most)
    if peak <= 0.0:
        return np.inf, peak
    return rise + fall + (length - 0.5 * ((first + peak) * rise + (peak + last) * fall)) / peak, peak


@kernel
def _way(first: float, peak: float, last: float, most: Array) -> float:
    """Share of a segment that is gone while the speed goes from one to another by a peak that stays for `SPACING`."""
    rise, fall = _change_time(peak - first, most), _change_time(peak - last, most)
    return 0.5 * ((first + peak) * rise + (peak + last) * fall) + SPACING * peak


@kernel
def corner(before: Array, after: Array, speeds: Array, limits: Array) -> tuple[float, float]:
    """`change` in a corner between two segments (n,), with speeds (2,) before and after it."""
    acceleration, jerk = 0.0, 0.0
    for i in range(before.shape[0]):
        size = abs(speeds[1] * after[i] - speeds[0] * before[i])
        acceleration, jerk = max(acceleration, size / limits[1, i]), max(jerk, size / limits[2, i])
    return change(acceleration, jerk)


@kernel
def _around(k: int, segments: Array, most: Array, speeds: Array, limits: Array) -> float:
    """Time of segment k with half of the corners at its ends, s."""
    m, head, tail = segments.shape[0], 0.0, 0.0
    if k > 0:
        until, rise = corner(segments[k - 1], segments[k], speeds[k - 1], limits)
        head = 0.5 * (until + rise)
    if k < m - 1:
        until, rise = corner(segments[k], segments[k + 1], speeds[k], limits)
        tail = 0.5 * (until + rise)
    first = speeds[k - 1, 1] if k > 0 else 0.0
    last = speeds[k, 0] if k < m - 1 else 0.0
    return head + tail + segment(first, last, 1.0 - head * first - tail * last, most[k])[0]


@kernel
def _improve(
    c: int,
    new: tuple[float, float],
    segments: Array,
    most: Array,
    caps: Array,
    limits: Array,
    speeds: Array,
    best: Array,
) -> bool:
    """Take new speeds (shares of the greatest ones) in corner c where the segments around it take less time so."""
    old = speeds[c, 0], speeds[c, 1]
    for side in range(2):
        speeds[c, side] = min(max(new[side], 0.0), caps[c]) * most[c + side, 0]
    if speeds[c, 0] == old[0] and speeds[c, 1] == old[1]:
        return False
    one = _around(c, segments, most, speeds, limits)
    two = _around(c + 1, segments, most, speeds, limits) if one < np.inf else np.inf
    if one + two < best[c] + best[c + 1] - 1e-9:
        best[c], best[c + 1] = one, two
        return True
    speeds[c, 0], speeds[c, 1] = old
    return False


@kernel
def choose(segments: Array, most: Array, caps: Array, limits: Array) -> tuple[Array, float]:
    """Speeds before and after each corner (m - 1, 2) with which a polyline takes little time, and that time, s.

    From stops in all corners, and from two speeds in all of them, each corner in turn takes the best of a grid; a
    pattern search follows.

    Args:
        segments: (m, n) rad.
        most: (m, 3) greatest speed, acceleration and jerk of each segment.
        caps: (m - 1,) shares of the greatest speeds that are allowed in the corners; 0 is a stop.
        limits: (3, n).
    """
    count = segments.shape[0] - 1
    chosen, least = np.zeros((count, 2)), np.inf
    for start in range(_STARTS):
        speeds, best = np.empty((count, 2)), np.empty(count + 1)
        for c in range(count):
            for side in range(2):
                speeds[c, side] = start / _STARTS * caps[c] * most[c + side, 0]
        for k in range(count + 1):
            best[k] = _around(k, segments, most, speeds, limits)
        _search(segments, most, caps, limits, speeds, best)
        if best.sum() < least:
            chosen, least = speeds, best.sum()
        if caps.sum() == 0.0:
            break
    return chosen, least


@kernel
def _search(segments: Array, most: Array, caps: Array, limits: Array, speeds: Array, best: Array) -> None:
    """Improve speeds and the times of the segments in place."""
    count = segments.shape[0] - 1
    for _ in range(_SWEEPS):
        better = False
        for c in range(count):
            for one in range(_GRID + 1):
                for two in range(_GRID + 1):
                    new = (caps[c] * one / _GRID, caps[c] * two / _GRID)
                    better |= _improve(c, new, segments, most, caps, limits, speeds, best)
        if not better:
            break
    step = 0.5 / _GRID
    while step > _LAST:
        better = False
        for c in range(count):
            for one in range(-1, 2):
                for two in range(-1, 2):
                    now = (speeds[c, 0] / most[c, 0], speeds[c, 1] / most[c + 1, 0])
                    new = (now[0] + one * step, now[1] + two * step)
                    better |= _improve(c, new, segments, most, caps, limits, speeds, best)
        if not better:
            step *= 0.5
