# SPDX-License-Identifier: Apache-2.0
"""What the judge of a graph under faults calls a violation."""

import math

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_evaluation.chaos.judge import claims, fall_of, since_reset, unasked_speed
from openarm_evaluation.judging.judge import Sample

_G, _DT = 9.81, 0.05


def sample(t: float, z: float, vz: float = 0.0, x: float = 0.0) -> Sample:
    return Sample(round(t * 1e9), np.array([x, 0.0, z]), np.array([0.0, 0, 0, 1]), np.array([0.0, 0, vz]), np.zeros(3))


def dropped(height: float, phase: float) -> list[Sample]:
    """Sample an object at rest that falls from a height, from `phase` of a period after a sample."""
    lasts, track = math.sqrt(2.0 * height / _G), list[Sample]()
    for k in range(12):
        t = k * _DT - 2 * _DT - phase * _DT
        falling = 0.0 <= t < lasts
        z = height if t < 0.0 else max(0.0, height - 0.5 * _G * t * t)
        track.append(sample(k * _DT, z, -_G * t if falling else 0.0))
    return track


@pytest.mark.parametrize("phase", np.linspace(0.0, 0.95, 20))
@pytest.mark.parametrize("height", [0.012, 0.12])
def test_a_fall_is_seen_wherever_the_samples_lie(height: float, phase: float) -> None:
    assert fall_of(dropped(height, phase)) > 0.01


def test_a_hand_may_lower_and_a_restarted_simulation_may_move_an_object() -> None:
    lowered = [sample(k * _DT, 0.3 - 0.4 * k * _DT, -0.4) for k in range(10)]
    assert fall_of([sample(-_DT, 0.3), *lowered]) == 0.0
    again = [sample(5.0, 0.3), sample(0.0, 0.0), sample(0.1, 0.0)]
    assert fall_of(again) == 0.0
    assert since_reset(again) == again[1:]


def test_speed_is_measured_over_a_tenth_of_a_second() -> None:
    moving = [(k * 10_000_000, {"joint4": 0.003 * k, "finger_joint1": k}) for k in range(60)]
    speed, joint = unasked_speed(moving)
    assert (speed, joint) == (pytest.approx(0.3), "joint4")
    noisy = [(k * 10_000_000, {"joint4": 0.001 * (k % 2)}) for k in range(60)]
    assert unasked_speed(noisy)[0] < 0.05
    assert unasked_speed([(9_000_000_000, {"joint4": 1.0}), *noisy])[0] == 0.0


def test_an_answer_must_say_what_is_so() -> None:
    still = [sample(k * _DT, 0.0) for k in range(30)]
    moved = [*still, sample(2.0, 0.0, x=0.1)]
    assert not claims(still, False, Code.UNREACHABLE, "REFUSED", (math.nan, math.nan))
    assert "never lifted" in claims(still, True, Code.OK, "SUCCESS", (0.0, 0.0))[0].text
    assert "it moved 0.100 m" in claims(moved, False, Code.UNREACHABLE, "REFUSED", (math.nan, math.nan))[0].text
    assert "defect" in claims(still, False, Code.INTERNAL, "FAILED", (math.nan, math.nan))[0].text
