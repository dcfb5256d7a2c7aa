# SPDX-License-Identifier: Apache-2.0
"""OpenArm v2 grasps in the Cell: from the camera under the roof, and from depth that its stereo head gives."""

from __future__ import annotations

import pytest

from openarm_common.robot.folder import ROBOT
from openarm_common.scene.scene import load_scene
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig


@pytest.mark.requirement("R-05")
@pytest.mark.parametrize(("camera", "label", "side"), [("ceiling", "blue", "left"), ("head_left", "red", "right")])
def test_it_places_an_object_of_its_scene(monkeypatch: pytest.MonkeyPatch, camera: str, label: str, side: str) -> None:
    """`head_left` has no depth of its own: it is matched with `head_right`."""
    monkeypatch.setenv(ROBOT, "openarm_v2_cell")
    senses = SimulatedSenses(depth_noise=True, sets=(f"detector.camera={camera}", f"octomap.cameras=[{camera}]"))
    trials = Trials(Task("nominal", 1, load_scene("demo"), (label,)), senses, GraspConfig(camera=camera))
    (grasp,) = trials.run()["grasps"]
    assert (grasp["outcome"], grasp["arm"], grasp["attempts"]) == ("placed", side, 1), grasp["message"]
    assert grasp["place_error_mm"] < 8.0
    assert f"the {side}_wrist camera sees it" in " ".join(step.reason for step in trials.steps)
