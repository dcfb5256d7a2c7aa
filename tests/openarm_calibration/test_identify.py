# SPDX-License-Identifier: Apache-2.0
"""Servos are identified from their targets and joint states, on simulated arms that were drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from openarm_calibration.dynamics import excite
from openarm_calibration.dynamics.excite import AMPLITUDE, postures, waves
from openarm_calibration.dynamics.identify import ServoLog, identify
from openarm_common.errors import Code, OpenArmError
from openarm_common.records import RecordStore
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.servo_store import StoredServos
from openarm_common.robot.servos import ArmLoad
from openarm_evaluation.campaign import dynamics
from openarm_evaluation.campaign.dynamics import DynamicsBench
from openarm_sim_bridge.world.hardware import HardwareConfig, drawn


@pytest.fixture(scope="module")
def load() -> ArmLoad:
    description = RobotDescription.load()
    return ArmLoad(description, description.arm_joints("right"), description.tcp_link("right"))


SHIPPED, GAINS = HardwareConfig(mass_error=0.0).of_seed(31), HardwareConfig(mass_error=0.0, gain_error=0.3).of_seed(32)
BOTH = ("left", "right")


@pytest.mark.long
@pytest.mark.parametrize(
    ("hardware", "sides", "places", "cycles"),
    [
        (SHIPPED, ("left",), 2, 4),
        (SHIPPED, BOTH, 6, 8),
        (GAINS, BOTH, 6, 8),
    ],
    ids=["one arm", "as shipped", "gains 30 % off"],
)
def test_the_servos_of_drawn_arms_are_found(
    hardware: HardwareConfig, sides: tuple[str, ...], places: int, cycles: int, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(dynamics, "_POSTURES", places)
    monkeypatch.setattr(excite, "_CYCLES", cycles)
    description, bench = RobotDescription.load(), DynamicsBench(hardware)
    made, store = drawn(hardware, description), RecordStore(tmp_path, StoredServos)
    monkeypatch.setattr(RobotDescription, "arm_names", sides)
    for side, found in bench.identified().items():
        joints = description.arm_joints(side)
        truth = {name: np.array([getattr(made, name)[joint] for joint in joints]) for name in ("stiffness", "friction")}
        latency = made.latency_s[joints[0]]
        servos = found.servos
        np.testing.assert_allclose(servos.stiffness, truth["stiffness"], rtol=0.1)
        np.testing.assert_allclose(servos.friction, truth["friction"], atol=0.25)
        np.testing.assert_allclose(servos.latency_s, latency, atol=0.008)
        assert np.all(found.stiffness_std / servos.stiffness < 0.05)
        store.save(found.record(side, 31))
        np.testing.assert_allclose(store.load(side).model().damping, servos.damping, atol=1e-6)


def test_all_joints_of_a_wave_come_back_and_none_goes_further(load: ArmLoad) -> None:
    middle = np.linspace(-0.5, 0.5, 7)
    t, q = waves(middle)
    assert np.all(np.diff(t) > 0.0)
    np.testing.assert_allclose(q[[0, -1]], [middle, middle])
    np.testing.assert_allclose(np.abs(q - middle).max(axis=0), AMPLITUDE, rtol=0.02)
    speeds = np.abs(np.diff(q, axis=0)) / np.diff(t)[:, None]
    assert speeds.max() < 1.5


def test_motions_that_show_nothing_are_refused(load: ArmLoad) -> None:
    still = np.zeros((400, 7))
    with pytest.raises(OpenArmError, match="joint 1 moved in 0 windows") as caught:
        identify([ServoLog(0.01, still, still)], load)
    assert caught.value.code is Code.INVALID_ARGUMENT


def test_a_robot_that_is_walled_in_has_no_postures(load: ArmLoad) -> None:
    lower, upper = RobotDescription.load().limits(RobotDescription.load().arm_joints("right"))
    with pytest.raises(OpenArmError, match="0 postures are free, expected 4"):
        postures(lower, upper, load, lambda q: False, 4, np.random.default_rng(0))
