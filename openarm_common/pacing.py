# SPDX-License-Identifier: Apache-2.0
"""Pacing of simulated time by the wall clock, and how well it is kept.

Nothing here reads a clock: the wall clock (monotonic, ns) is an argument.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np


class Pacer:
    """When the next control tick is due.

    Missed ticks are made up at once, so that simulated time does not fall behind; but the delay of a long halt (a
    suspended process, an overloaded machine) is dropped.

    Args:
        period_ns: Length of a tick in simulated time.
        speed: Simulated seconds per second of wall time; 0 is as fast as possible.
        max_debt_ns: Largest wall time that is made up.
    """

    def __init__(self, period_ns: int, speed: float = 1.0, max_debt_ns: int = 500_000_000) -> None:
        #: Of wall time; 0: as fast as possible.
        self._step_ns = round(period_ns / speed) if speed > 0.0 else 0
        self._max_debt_ns = max_debt_ns
        self._due_ns: int | None = None
        self.skipped_ns = 0

    def wait_ns(self, now_ns: int) -> int:
        """Return the time until the next tick is due; 0 or less when it is."""
        if self._due_ns is None:
            self._due_ns = now_ns
        return self._due_ns - now_ns if self._step_ns else 0

    def ticked(self, now_ns: int) -> None:
        """Note that a tick has begun; the next one is due a period after this one was."""
        due_ns = now_ns if self._due_ns is None else self._due_ns
        debt_ns = now_ns - due_ns
        if self._step_ns and debt_ns > self._max_debt_ns:
            self.skipped_ns += debt_ns
            due_ns = now_ns
        self._due_ns = due_ns + self._step_ns

    def restart(self) -> None:
        """Start again at the next call: after a pause, nothing is made up."""
        self._due_ns = None


class AdaptiveShare:
    """Share of the frames that a consumer keeps up with: additive increase, multiplicative decrease.

    Source: Chiu and Jain, Analysis of the increase and decrease algorithms for congestion avoidance (1989).
    """

    #: A larger share of lost frames than this is too much.
    _LOST = 0.1
    _LEAST, _MORE, _LESS = 0.1, 0.01, 0.9

    def __init__(self) -> None:
        self._share = 1.0
        self._made = self._lost = 0

    def update(self, made: int, lost: int) -> float:
        """Return the share, by all frames that were made and lost so far; to be called at an even rate."""
        more, fewer = made - self._made, lost - self._lost
        self._made, self._lost = made, lost
        if more + fewer > 0:
            too_many = fewer > self._LOST * (more + fewer)
            self._share = max(self._LEAST, self._LESS * self._share) if too_many else min(1.0, self._share + self._MORE)
        return self._share


class RateDivider:
    """Which control ticks to use, so that the mean rate is exact though it does not divide that of the ticks.

    Args:
        rate: Uses per second of the clock that it is asked with.
    """

    def __init__(self, rate: float) -> None:
        self._period_ns = 1e9 / rate
        self._count: int | None = None

    def due(self, t_ns: int) -> bool:
        """Whether the tick at `t_ns` is the first of a new period. Ask for every tick, in order."""
        before, self._count = self._count, int((t_ns + 1) // self._period_ns)  # + 1: rounding loses no border
        return before is not None and self._count != before


class RealTimeFactor:
    """Simulated over wall time in a sliding window.

    Args:
        window_ns: Length of the window, wall clock.
    """

    def __init__(self, window_ns: int = 1_000_000_000) -> None:
        self._window_ns = window_ns
        self._samples: deque[tuple[int, int]] = deque()

    def add(self, now_ns: int, t_ns: int) -> None:
        """Add a pair of wall clock and simulated time."""
        self._samples.append((now_ns, t_ns))
        # The sample just outside stays: the window is covered whole.
        while len(self._samples) > 2 and self._samples[1][0] <= now_ns - self._window_ns:
            self._samples.popleft()

    @property
    def value(self) -> float:
        """The factor; 0 before there are two samples."""
        if len(self._samples) < 2:
            return 0.0
        (wall_0, sim_0), (wall_1, sim_1) = self._samples[0], self._samples[-1]
        return (sim_1 - sim_0) / (wall_1 - wall_0) if wall_1 > wall_0 else 0.0


@dataclass(frozen=True)
class PeriodFigures:
    """Percentiles of a period, ms, over `n` intervals."""

    p50_ms: float = 0.0
    p99_ms: float = 0.0
    max_ms: float = 0.0
    n: int = 0


class PeriodMeter:
    """Intervals between events on the wall clock: the last `capacity` of them.

    Args:
        capacity: 1000 is 10 s at 100 Hz.
    """

    def __init__(self, capacity: int = 1000) -> None:
        self._intervals_ms: deque[float] = deque(maxlen=capacity)
        self._last_ns: int | None = None

    def add(self, now_ns: int) -> None:
        """Add an event."""
        if self._last_ns is not None:
            self._intervals_ms.append((now_ns - self._last_ns) * 1e-6)
        self._last_ns = now_ns

    def restart(self) -> None:
        """Do not count the interval to the next event (a pause)."""
        self._last_ns = None

    def figures(self) -> PeriodFigures:
        """Compute percentiles of the kept intervals; may be called from another thread than `add`."""
        intervals = np.array(self._intervals_ms.copy())
        if intervals.size == 0:
            return PeriodFigures()
        p50, p99 = np.percentile(intervals, (50, 99))
        return PeriodFigures(float(p50), float(p99), float(intervals.max()), int(intervals.size))
