# SPDX-License-Identifier: Apache-2.0
"""The judge: what counts as placed, and every way not to be."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openarm_evaluation.judging.judge import JudgeConfig, Sample, at_rest, judge, rests

TARGET = (0.3, -0.2)


def sample(t: float, x: float, y: float, z: float, roll: float = 0.0, speed: float = 0.0, yaw: float = 0.0) -> Sample:
    c, s = math.cos(yaw / 2), math.sin(yaw / 2)
    q_yaw = np.array([0.0, 0.0, s, c])
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    # roll about world x after the yaw
    q = np.array([sr * q_yaw[3], -sr * q_yaw[2], cr * q_yaw[2], cr * q_yaw[3]])
    return Sample(int(t * 1e9), np.array([x, y, z]), q, np.array([speed, 0.0, 0.0]), np.zeros(3))


def good_track(dx: float = 0.004, roll: float = 0.0, z: float = 0.43, speed: float = 0.0, top: float = 0.55):
    return [
        sample(0.0, 0.2, -0.1, 0.43),
        sample(5.0, 0.2, -0.1, top, speed=0.1),
        sample(9.0, 0.3, -0.2, 0.45, speed=0.05),
        *(sample(10.0 + t, 0.3 + dx - speed * (0.95 - t), -0.2, z, roll, speed, yaw=1.0) for t in 0.05 * np.arange(20)),
    ]


def test_placed_upright_at_rest_within_tolerance() -> None:
    verdict = judge(good_track(), TARGET, claimed=True)
    assert verdict.placed
    assert verdict.reasons == ()
    assert verdict.place_error == pytest.approx(0.004)
    assert verdict.rise == pytest.approx(0.12)
    assert not verdict.false_success


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"dx": 0.021}, "21.0 mm from the target"),
        ({"roll": math.radians(15)}, "tilted by 15 degrees"),
        ({"roll": math.pi / 2}, "tilted by 90 degrees"),
        ({"z": 0.49}, r"centre is \+60 mm higher"),
        ({"speed": 0.003}, r"not at rest: it moved 1.5 mm and 0.0 degrees in the last 0.5 s"),
        ({"top": 0.45}, "never lifted: it rose 20 mm"),
    ],
)
def test_each_fault_is_named_and_a_claim_of_success_is_then_false(changes: dict[str, float], words: str) -> None:
    verdict = judge(good_track(**changes), TARGET, claimed=True)
    assert not verdict.placed
    assert verdict.false_success
    assert len(verdict.reasons) == 1
    assert re.search(words, verdict.reasons[0])


def test_failure_that_was_reported_is_no_false_success() -> None:
    assert not judge(good_track(dx=0.1), TARGET, claimed=False).false_success


def test_object_that_was_already_at_the_target_must_have_been_lifted() -> None:
    track = [sample(0.05 * i, *TARGET, 0.43) for i in range(40)]
    assert judge(track, TARGET, claimed=True).reasons[0].startswith("never lifted")


def test_motion_before_the_last_half_second_does_not_count() -> None:
    assert judge(good_track(), TARGET, claimed=True, rules=JudgeConfig(rest=0.9)).placed
    assert not judge(good_track(), TARGET, claimed=True, rules=JudgeConfig(rest=2.0)).placed


@given(yaw=st.floats(-math.pi, math.pi), dx=st.floats(-0.1, 0.1))
def test_yaw_never_counts_as_tilt_and_the_error_is_horizontal(yaw: float, dx: float) -> None:
    track = [
        sample(0.0, 0.2, 0.1, 0.43),
        sample(1.0, *TARGET, 0.6),
        sample(2.0, TARGET[0] + dx, TARGET[1], 0.43, yaw=yaw),
    ]
    verdict = judge(track, TARGET, claimed=True)
    assert verdict.tilt < 1e-6
    assert verdict.place_error == pytest.approx(abs(dx), abs=1e-12)
    assert verdict.placed == (abs(dx) <= 0.020) or abs(abs(dx) - 0.020) < 1e-9


def test_empty_or_disordered_track_is_refused() -> None:
    with pytest.raises(ValueError, match="order of time, got 0"):
        judge([], TARGET, claimed=False)
    with pytest.raises(ValueError, match="order of time"):
        judge(list(reversed(good_track())), TARGET, claimed=False)


def test_what_a_solver_rocks_by_hundredths_of_a_millimetre_is_at_rest_and_what_turns_on_its_place_is_not() -> None:
    fast = {"linear": np.array([0.007, 0.0, 0.0]), "angular": np.array([0.0, 0.33, 0.0])}
    step = np.array([4e-5, 0.0, 0.0])
    rocking = [replace(one, p_world=one.p_world + (-1) ** i * step, **fast) for i, one in enumerate(good_track())]
    assert judge(rocking, TARGET, claimed=True).placed
    assert rests(rocking)
    assert not at_rest(rocking[-1])
    turning = [*good_track()[:3], *(sample(10.0 + t, *TARGET, 0.43, yaw=0.1 * t) for t in 0.05 * np.arange(20))]
    assert "0.0 mm and 2.9 degrees" in judge(turning, TARGET, claimed=True).reasons[0]
    assert not rests(turning)
    assert not rests(turning[:1])


def test_no_target_is_never_met() -> None:
    verdict = judge(good_track(), (math.nan, math.nan), claimed=False)
    assert not verdict.placed
    assert "no place was chosen for it" in verdict.reasons
