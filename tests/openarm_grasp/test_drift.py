# SPDX-License-Identifier: Apache-2.0
"""The drift alarm: on residuals in the head, and on grasps with a camera whose mount has moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_evaluation.campaign.robot import Known, SimulatedSenses
from openarm_evaluation.campaign.tasks.suites import make_task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import DriftConfig, GraspConfig
from openarm_grasp.evidence.drift import DriftWatch

pytestmark = pytest.mark.requirement("N-06")


def watched(bias: tuple[float, float], noise: float, n: int = 10, seed: int = 0) -> DriftWatch:
    rng = np.random.default_rng(seed)
    watch = DriftWatch(DriftConfig(), "overhead")
    for _ in range(n):
        angle = rng.uniform(0.0, np.pi)
        axis = np.array([np.cos(angle), np.sin(angle)])
        watch.add("left", axis, float(axis @ np.array(bias)) + rng.normal(0.0, noise))
    return watch


def of_both(biases: dict[str, tuple[float, float]], noise: float, seed: int) -> DriftWatch:
    """Five grasps of each arm, in turn, with hands turned at random."""
    rng = np.random.default_rng(seed)
    watch = DriftWatch(DriftConfig(), "overhead")
    for k in range(10):
        arm = ("left", "right")[k % 2]
        angle = rng.uniform(0.0, np.pi)
        axis = np.array([np.cos(angle), np.sin(angle)])
        watch.add(arm, axis, float(axis @ np.array(biases[arm])) + rng.normal(0.0, noise))
    return watch


@pytest.mark.parametrize("seed", range(5))
def test_a_bias_of_8_mm_is_found_and_named_within_10_grasps(seed):
    drift = watched((0.008, 0.0), 0.002, seed=seed).drift()
    assert drift.alarm
    assert drift.bias == pytest.approx((0.008, 0.0), abs=0.003)
    assert "'overhead'" in drift.message
    assert "calibrate it again" in drift.message


@pytest.mark.parametrize("seed", range(20))
def test_noise_alone_raises_no_alarm(seed):
    assert not watched((0.0, 0.0), 0.003, seed=seed).drift().alarm


def test_few_grasps_say_nothing():
    assert not watched((0.008, 0.0), 0.001, n=4).drift().alarm


def test_old_grasps_are_forgotten():
    watch = watched((0.008, 0.0), 0.001)
    for k in range(10):
        watch.add("left", np.array([1.0, 0.0]) if k % 2 else np.array([0.0, 1.0]), 0.0)
    assert not watch.drift().alarm


@pytest.mark.parametrize("seed", range(5))
def test_arms_that_differ_are_said_with_both_causes(seed):
    drift = of_both({"left": (0.008, 0.0), "right": (-0.008, 0.006)}, 0.001, seed).drift()
    assert drift.alarm
    assert set(drift.arms) == {"left", "right"}
    assert "it has turned, or the joint zeros of an arm are wrong" in drift.message


@pytest.mark.parametrize("seed", range(20))
def test_what_is_wrong_with_the_camera_is_no_difference_of_the_arms(seed):
    drift = of_both({"left": (0.008, -0.004), "right": (0.008, -0.004)}, 0.001, seed).drift()
    assert drift.alarm
    assert not drift.arms
    assert "calibrate it again" in drift.message


def test_arms_that_measured_different_directions_are_not_compared():
    watch = DriftWatch(DriftConfig(), "overhead")
    for _ in range(5):
        watch.add("left", np.array([1.0, 0.0]), 0.006)
        watch.add("right", np.array([0.0, 1.0]), 0.006)
    assert watch.drift().alarm
    assert not watch.drift().arms


@pytest.mark.long
def test_grasps_with_a_mount_8_mm_off_raise_the_alarm() -> None:
    camera = load_cameras()["overhead"]
    believed = se3.make(p=(0.006, 0.0053, 0.0)) @ camera.T_parent_link
    task = replace(make_task("nominal", 10001), labels=("red", "green") * 3)
    senses = SimulatedSenses(depth_noise=False, sets=("mujoco_bridge.profile=ideal",))  # the hand knows where it is
    trials = Trials(task, senses, GraspConfig(), Known({"overhead": believed}))
    row = trials.run()
    assert row["placed"], row["message"]
    drift = trials.session.drift.drift()
    assert drift.grasps == 6
    assert drift.alarm, drift.message
    assert drift.bias == pytest.approx((0.006, 0.0053), abs=0.003)
