# SPDX-License-Identifier: Apache-2.0
"""OpenArm v2 grasps, with either hand and its camera, on the robot of a campaign: its arms as owners have them."""

from __future__ import annotations

import pytest

from openarm_common.robot.folder import ROBOT
from openarm_common.scene.scene import Scene, SceneObject
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig


@pytest.mark.long
@pytest.mark.requirement("R-04")
@pytest.mark.parametrize(("side", "y"), [("left", 0.22), ("right", -0.22)])
def test_it_places_an_object_with_either_hand_and_looks_with_its_camera(
    monkeypatch: pytest.MonkeyPatch, side: str, y: float
) -> None:
    monkeypatch.setenv(ROBOT, "openarm_v2")
    item = SceneObject(name="box", shape="box", size=(0.05, 0.06, 0.06), color="red", position=(0.26, y), yaw=0.3)
    scene = Scene(name="v2", objects=(item,))
    assert scene.table.top_z == 0.45
    trials = Trials(Task("nominal", 1, scene, ("red",)), SimulatedSenses(depth_noise=True, sets=()), GraspConfig())
    (grasp,) = trials.run()["grasps"]
    assert (grasp["outcome"], grasp["arm"], grasp["attempts"]) == ("placed", side, 1), grasp["message"]
    assert grasp["place_error_mm"] < 5.0
    assert f"the {side}_wrist camera sees it" in " ".join(step.reason for step in trials.steps)
