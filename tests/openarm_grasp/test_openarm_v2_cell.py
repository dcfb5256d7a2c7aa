# SPDX-License-Identifier: Apache-2.0
"""OpenArm v2 grasps in the Cell: from the camera under the roof, and from depth that its stereo head gives."""

from __future__ import annotations

import pytest

from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import ROBOT
from openarm_common.scene.scene import load_scene, parse_scene
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig
from openarm_grasp.requests.request import GraspRequest
from openarm_grasp.requests.task import Task as GraspTask
from openarm_grasp.strategies.registry import carry_out

pytestmark = [pytest.mark.long, pytest.mark.requirement("R-05")]

FAR = {"name": "red_cube", "shape": "box", "size": [0.05] * 3, "color": "red", "mass": 0.1, "position": [0.52, -0.36]}


@pytest.mark.parametrize(("camera", "label", "side"), [("ceiling", "blue", "left"), ("head_left", "red", "right")])
def test_it_places_an_object_of_its_scene(monkeypatch: pytest.MonkeyPatch, camera: str, label: str, side: str) -> None:
    """`head_left` has no depth of its own: it is matched with `head_right`."""
    monkeypatch.setenv(ROBOT, "openarm_v2_cell")
    senses = SimulatedSenses(depth_noise=True, sets=(f"detector.camera={camera}", f"octomap.cameras=[{camera}]"))
    trials = Trials(Task("nominal", 1, load_scene("demo"), (label,)), senses, GraspConfig(camera=camera))
    (grasp,) = trials.run()["grasps"]
    assert (grasp["outcome"], grasp["arm"], grasp["attempts"]) == ("placed", side, 1), grasp["message"]
    assert grasp["place_error_mm"] < 8.0
    assert f"observing with the {side}_wrist camera" in " ".join(step.reason for step in trials.steps)


def test_where_nothing_is_in_reach_the_lift_goes_to_another_height(monkeypatch: pytest.MonkeyPatch) -> None:
    """It starts too high for what is that far; the way is planned first, and a dry run moves nothing."""
    monkeypatch.setenv(ROBOT, "openarm_v2_cell")
    lift, high = RobotDescription.load().joint("openarm_lifter_joint"), 0.2
    senses = SimulatedSenses(depth_noise=True)
    task = Task("nominal", 1, parse_scene({"objects": [FAR]}, "far"), ("red",), posture={lift.name: high})
    trials = Trials(task, senses, GraspConfig())
    trials.robot.pass_time(0.5)
    request = GraspRequest("red", dry_run=True)
    answer = trials.link.run(carry_out(GraspTask(trials.session, trials.skills, request, lambda status: None)))
    assert (answer.code, answer.message.startswith("can be done: the lift goes from 0.200")) == (Code.OK, True)
    assert trials.skills.lift_position() == pytest.approx(high, abs=0.005)
    (grasp,) = trials.run()["grasps"]
    assert (grasp["outcome"], grasp["route"], grasp["attempts"]) == ("placed", "height", 1), grasp["message"]
    assert trials.skills.lift_position() < high - 0.05


def test_arms_that_touch_the_cell_are_said_so_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the lift at its top no arm can move: no other route is planned from there."""
    monkeypatch.setenv(ROBOT, "openarm_v2_cell")
    lift = RobotDescription.load().joint("openarm_lifter_joint")
    near = {**FAR, "position": [0.42, -0.30]}
    task = Task("nominal", 1, parse_scene({"objects": [near]}, "near"), ("red",), posture={lift.name: lift.upper})
    trials = Trials(task, SimulatedSenses(depth_noise=True), GraspConfig())
    trials.robot.pass_time(0.5)
    request = GraspRequest("red", dry_run=True)
    answer = trials.link.run(carry_out(GraspTask(trials.session, trials.skills, request, lambda status: None)))
    assert (answer.code, "starts in collision" in answer.message) == (Code.IN_COLLISION, True)
    assert "height" not in answer.message
    assert answer.duration < 2.0
