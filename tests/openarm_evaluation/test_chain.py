# SPDX-License-Identifier: Apache-2.0
"""What calibration and map are worth to a grasp: the scene of the end-to-end test with both, and without either."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.calibration_matters import shipped_mounts
from openarm_common.scene.scene import load_scene
from openarm_evaluation.campaign.parameters import suite_config
from openarm_evaluation.campaign.robot import Known, SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials

pytestmark = [pytest.mark.long, pytest.mark.requirement("A-01")]


def grasp(*sets: str, calibrated: bool = True) -> tuple[dict[str, Any], float]:
    """The row of the grasp at mount seed 1, and how far the screen was pushed, m."""
    task = Task("chain", 0, load_scene("screen"), ("red",), mount_seed=1, place=(0.26, 0.43))
    if not calibrated:  # it is the grasp that fails here, not the watch of the detector that refuses it
        sets = (*sets, "detector.watch.enabled=false")
    senses = SimulatedSenses(depth_noise=False, sets=("grasp.limits.max_attempts=1", *sets))
    mounts = shipped_mounts() if calibrated else {}
    run = Trials(task, senses, suite_config(senses.parameters()).grasp, Known(mounts))
    row, screen = run.run(), run.robot.tracks["screen"]
    return row, max(float(np.linalg.norm(sample.p_world - screen[0].p_world)) for sample in screen)


def test_with_calibration_and_map_the_box_is_placed_within_5_mm_and_the_screen_is_not_touched() -> None:
    row, pushed = grasp()
    assert row["placed"], row["message"]
    assert row["place_error_mm"] < 5.0
    assert pushed < 0.001


def test_without_calibration_the_grasp_fails_and_says_so() -> None:
    row, _ = grasp(calibrated=False)
    assert not row["placed"]
    assert row["code"] != "OK"
    assert row["reasons"]  # of the judge: never lifted, dropped, or tilted, by where the fingers happen to touch it


def test_without_the_map_the_arm_runs_into_the_screen() -> None:
    row, pushed = grasp("motion.map.use=off")
    assert not row["placed"]
    assert pushed > 0.01
