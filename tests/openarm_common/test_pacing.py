# SPDX-License-Identifier: Apache-2.0
"""Pacing: due times, hiccups, real-time factor, percentiles. The clock is an argument, so nothing here waits."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.pacing import AdaptiveShare, Pacer, PeriodMeter, RateDivider, RealTimeFactor

MS = 1_000_000


def drive(pacer: Pacer, ticks: int, now: int = 0) -> list[int]:
    """Run ticks as early as the pacer allows; the times they begin at."""
    begun = []
    for _ in range(ticks):
        now += max(0, pacer.wait_ns(now))
        pacer.ticked(now)
        begun.append(now)
    return begun


@pytest.mark.requirement("A-18")
def test_ticks_are_a_period_apart_and_do_not_drift() -> None:
    assert drive(Pacer(10 * MS), 5) == [0, 10 * MS, 20 * MS, 30 * MS, 40 * MS]


@pytest.mark.parametrize(("speed", "step"), [(0.5, 20 * MS), (2.0, 5 * MS), (5.0, 2 * MS)])
def test_speed_scales_the_period(speed: float, step: int) -> None:
    assert drive(Pacer(10 * MS, speed), 3) == [0, step, 2 * step]


def test_speed_zero_never_waits() -> None:
    assert drive(Pacer(10 * MS, 0.0), 3, now=7) == [7, 7, 7]


def test_a_short_hiccup_is_made_up_at_once() -> None:
    pacer = Pacer(10 * MS)
    drive(pacer, 2)
    late = 55 * MS
    assert drive(pacer, 5, late) == [late, late, late, late, 60 * MS]
    assert pacer.skipped_ns == 0


def test_a_long_halt_is_forgiven() -> None:
    pacer = Pacer(10 * MS, max_debt_ns=500 * MS)
    drive(pacer, 2)
    late = 20 * MS + 3000 * MS
    assert drive(pacer, 3, late) == [late, late + 10 * MS, late + 20 * MS]
    assert pacer.skipped_ns == 3000 * MS


def test_nothing_is_made_up_after_a_pause() -> None:
    pacer = Pacer(10 * MS)
    drive(pacer, 2)
    pacer.restart()
    assert drive(pacer, 2, 300 * MS) == [300 * MS, 310 * MS]


@pytest.mark.requirement("A-19")
def test_real_time_factor_is_simulated_over_wall_time_of_the_window() -> None:
    factor = RealTimeFactor(1000 * MS)
    assert factor.value == 0.0
    for i in range(300):  # half speed for two seconds, then full speed
        factor.add(i * 10 * MS, i * 5 * MS if i < 200 else 1000 * MS + (i - 200) * 10 * MS)
    assert factor.value == pytest.approx(1.0, abs=0.01)


def test_period_figures() -> None:
    meter = PeriodMeter(capacity=100)
    assert meter.figures().n == 0
    now = 0
    for i in range(101):
        meter.add(now)
        now += (30 if i == 50 else 10) * MS
    figures = meter.figures()
    assert (figures.p50_ms, figures.max_ms, figures.n) == (10.0, 30.0, 100)
    meter.restart()
    meter.add(now + 10**12)
    assert meter.figures().max_ms == 30.0


@pytest.mark.parametrize("rate", [5.0, 15.0, 30.0, 33.3, 100.0])
@pytest.mark.requirement("P-24")
def test_frames_keep_their_mean_rate_though_it_does_not_divide_the_ticks(rate: float) -> None:
    divider = RateDivider(rate)
    start = 123_450_000_000
    due = [t for t in range(start, start + 60 * 10**9, 10_000_000) if divider.due(t)]
    assert len(due) == pytest.approx(60 * rate, abs=1)
    gaps = np.diff(due) * 1e-9
    assert gaps.max() <= 1.0 / rate + 0.010 + 1e-9
    assert gaps.min() >= 1.0 / rate - 0.010 - 1e-9


def test_fewer_frames_are_asked_for_until_they_are_made_and_more_again() -> None:
    share, made, lost = AdaptiveShare(), 6, 0
    assert share.update(made, lost) == 1.0
    assert share.update(made, lost) == 1.0  # without a new frame there is nothing to go by

    def settled(frames_per_update: int) -> float:
        """Share that a machine settles at which makes so many of at most twelve frames."""
        nonlocal made, lost
        value = share.update(made, lost)
        for _ in range(200):
            asked = round(12 * value)
            made, lost = made + min(asked, frames_per_update), lost + max(0, asked - frames_per_update)
            value = share.update(made, lost)
        return value

    assert 0.4 < settled(6) < 0.65
    assert settled(0) == pytest.approx(0.1)  # so that it is soon back
    assert settled(12) == 1.0
