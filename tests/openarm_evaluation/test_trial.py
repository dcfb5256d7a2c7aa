# SPDX-License-Identifier: Apache-2.0
"""Trials and reports: targets, scenes recognised, durations, sums."""

from __future__ import annotations

import math

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_common.scene.scene import Scene, load_scene
from openarm_evaluation.judging.judge import Sample, judge
from openarm_evaluation.judging.provenance import machine, scene_hash, versions
from openarm_evaluation.judging.statistics import interval, summarise
from openarm_evaluation.judging.trial import Step, Trial, choose_targets, shows
from openarm_grasp.ros.client import GraspResult
from tests.refusals import refused


def standing(scene: Scene, shift: float = 0.0, speed: float = 0.0) -> dict[str, Sample]:
    return {
        item.name: Sample(
            0,
            np.array([item.position[0] + shift, item.position[1], 0.43]),
            np.array([0.0, 0.0, 0.0, 1.0]),
            np.array([speed, 0.0, 0.0]),
            np.zeros(3),
        )
        for item in scene.objects
    }


def test_target_is_the_first_object_or_the_labelled_one() -> None:
    scene = load_scene("demo")
    assert choose_targets(scene, "") == scene.objects
    assert choose_targets(scene, "blue")[0].label == "blue"
    assert refused(r"no object 'pink'; it has .*red", choose_targets, scene, "pink").code is Code.UNKNOWN_OBJECT


def test_scene_is_recognised_only_when_all_its_objects_rest_at_their_places() -> None:
    scene = load_scene("random", 3)
    assert shows(scene, standing(scene))
    assert not shows(scene, standing(scene, shift=0.03))
    assert not shows(scene, standing(scene, speed=0.1))
    assert not shows(scene, standing(load_scene("random", 4)))
    assert not shows(scene, {})


def test_scene_hash_distinguishes_scenes_and_is_stable() -> None:
    assert len({scene_hash(load_scene("random", seed)) for seed in range(20)}) == 20
    assert scene_hash(load_scene("random", 5)) == scene_hash(load_scene("random", 5))


def trial(*, claimed: bool, rise: float, error: float) -> Trial:
    def at(t: float, x: float, z: float) -> Sample:
        return Sample(int(t * 1e9), np.array([x, 0.0, z]), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3))

    verdict = judge([at(0, 0.2, 0.43), at(1, 0.2, 0.43 + rise), at(3, 0.3 + error, 0.43)], (0.3, 0.0), claimed=claimed)
    code = Code.OK if claimed else Code.GRASP_MISSED
    answer = GraspResult(claimed, code, "", "SUCCESS" if claimed else "FAILED", "red", "left", 1, (0.3, 0.0, 0.4), 12.0)
    steps = [
        Step(0, "DETECT", "IDLE", "asked", 1, "red", "left"),
        Step(500_000_000, "IDLE", "DETECT", "", 1, "red", "left"),
    ]
    return Trial(load_scene("demo"), 1, "red_cube", answer, verdict, steps, wall_s=13.0)


def test_row_says_how_long_each_state_lasted() -> None:
    row = trial(claimed=True, rise=0.12, error=0.002).as_row()
    assert row["states"] == [{"state": "DETECT", "seconds": 0.5, "attempt": 1, "reason": "asked"}]
    assert row["sim_s"] == 0.5


def test_outcomes_and_their_sum() -> None:
    good = trial(claimed=True, rise=0.12, error=0.002)
    missed = trial(claimed=False, rise=0.0, error=0.1)
    lied = trial(claimed=True, rise=0.12, error=0.05)
    assert [t.outcome for t in (good, missed, lied)] == ["placed", "failed", "false success"]
    summary = summarise([t.as_row() for t in (good, missed, lied)])
    assert (summary["n"], summary["success"], summary["first_attempt"], summary["false_success"]) == (3, 1, 1, 1)
    assert summary["place_error_mm"] == {"median": 2.0, "p95": 2.0, "max": 2.0}
    assert summarise([])["place_error_mm"] is None


@pytest.mark.parametrize(("k", "n", "low"), [(20, 20, 0.839), (18, 20, 0.699), (0, 20, 0.0), (99, 100, 0.946)])
def test_wilson_bound_equals_published_values(k: int, n: int, low: float) -> None:
    assert interval(k, n)["low"] == pytest.approx(low, abs=1e-3)


def test_report_says_with_what_and_on_what_it_ran() -> None:
    assert {"mujoco", "ros-jazzy-rclpy", "python"} <= set(versions())
    assert machine()["cores"] >= 1
    assert math.isfinite(machine()["memory_gib"])
