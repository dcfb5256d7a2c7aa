# SPDX-License-Identifier: Apache-2.0
"""What the judge of a graph under faults calls a violation."""

import math

import mujoco
import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_evaluation.chaos.judge import TRUTH_HZ, claims, fall_of, fits, since_reset, unasked_speed
from openarm_evaluation.chaos.schedule import Fault
from openarm_evaluation.judging.judge import Sample

_DT = 0.05
BOX = """<mujoco><option timestep="0.002"/><worldbody><geom type="plane" size="2 2 .1"/>
<body pos="0 0 {z}"><freejoint/><geom type="box" size=".02 .02 .04" mass=".1"/></body></worldbody></mujoco>"""


def sample(t: float, z: float, vz: float = 0.0, x: float = 0.0) -> Sample:
    return Sample(round(t * 1e9), np.array([x, 0.0, z]), np.array([0.0, 0, 0, 1]), np.array([0.0, 0, vz]), np.zeros(3))


def let_go(height: float, phase: int, turning: float = 0.0) -> list[Sample]:
    """Let a box go above the ground in MuJoCo, `phase` steps of 2 ms after a sample."""
    model = mujoco.MjModel.from_xml_string(BOX.format(z=0.04 + height))
    data = mujoco.MjData(model)
    held, track, every = data.qpos.copy(), list[Sample](), round(1.0 / TRUTH_HZ / model.opt.timestep)
    for step in range(300):
        mujoco.mj_step(model, data)
        if step <= 10 * every + phase:
            data.qpos[:], data.qvel[:] = held, [0, 0, 0, 0, turning, 0]
        if step % every == 0:
            p, q, v = data.qpos[:3], data.qpos[[4, 5, 6, 3]], data.qvel
            track.append(Sample(round(data.time * 1e9), p.copy(), q.copy(), v[:3].copy(), v[3:].copy()))
    return track


@pytest.mark.parametrize("phase", range(5))
def test_a_fall_is_seen_wherever_the_samples_lie(phase: int) -> None:
    assert fall_of(let_go(0.012, phase)) > 0.0
    assert fall_of(let_go(0.020, phase)) == pytest.approx(0.020, rel=0.25)
    assert fall_of(let_go(0.120, phase)) == pytest.approx(0.120, rel=0.1)
    assert fall_of(let_go(0.005, phase)) == 0.0
    assert fall_of(let_go(0.0, phase, turning=6.0)) == 0.0  # it topples


def test_a_hand_may_lower_and_a_restarted_simulation_may_move_an_object() -> None:
    lowered = [sample(k * _DT, 0.3 - 0.4 * k * _DT, -0.4) for k in range(10)]
    assert fall_of([sample(-_DT, 0.3), *lowered]) == 0.0
    assert fall_of([sample(0.0, 0.3), sample(0.2, 0.1, -1.9)]) == 0.0  # what was between them is not known
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
    ended = [(t_ns + 60_000_000_000, positions) for t_ns, positions in moving]  # the bridge was killed as it moved
    assert unasked_speed([*ended, *noisy], len(ended), 100_000_000)[0] < 0.05


def test_an_answer_must_say_what_is_so() -> None:
    still = [sample(k * _DT, 0.0) for k in range(30)]
    moved = [*still, sample(2.0, 0.0, x=0.1)]
    assert not claims(still, False, "REFUSED", (math.nan, math.nan))
    assert "never lifted" in claims(still, True, "SUCCESS", (0.0, 0.0))[0].text
    assert "it moved 0.100 m" in claims(moved, False, "REFUSED", (math.nan, math.nan))[0].text


@pytest.mark.requirement("P-34")
@pytest.mark.parametrize(
    ("code", "kind", "node", "fitting"),
    [
        (Code.NO_PLAN, None, "", True),
        (Code.ROBOT_LOST, None, "", False),
        (Code.ROBOT_LOST, "kill", "motion", True),
        (Code.BUSY, "rival", "", False),
        (Code.NOT_READY, "kill", "grasp", True),
        (Code.ROBOT_LOST, "kill", "grasp", False),
        (Code.EXECUTION_FAILED, "intruder", "", False),
        (Code.CANCELLED, "stop", "motion", False),
        (Code.TIMEOUT, "services", "", True),
        (Code.INTERNAL, "stop", "motion", False),
    ],
)
def test_the_code_of_a_failure_must_fit_the_fault(code: Code, kind: str | None, node: str, fitting: bool) -> None:
    fault = Fault(kind, "LIFT", 0.1, 1.0, node) if kind else None
    assert bool(fits(code, fault)) is not fitting
