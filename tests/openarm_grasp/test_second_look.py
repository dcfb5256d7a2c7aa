# SPDX-License-Identifier: Apache-2.0
"""A-35: coarse from the camera over the table, fine from the one on the hand. On the robot of a campaign."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import Scene, SceneObject
from openarm_evaluation.campaign.robot import Known, SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig
from openarm_grasp.perception.detections import Frame
from openarm_grasp.requests.task import Status
from openarm_grasp.robot.interface import PlanGrasp
from tests.openarm_grasp.scripted import Follow

pytestmark = pytest.mark.requirement("A-35")

CUBE = SceneObject(name="red_cube", shape="box", size=(0.06, 0.06, 0.05), color="red", position=(0.27, -0.22), yaw=0.3)


def grasp(*, enabled: bool, off: tuple[float, float]) -> tuple[Trials, dict, float]:
    """Grasp the cube with the overhead camera believed elsewhere; also how far the hand was from the cube, m."""
    camera = load_cameras()["overhead"]
    config = GraspConfig()
    config = config.model_copy(update={"near": config.near.model_copy(update={"enabled": enabled})})
    task = Task("nominal", 1, Scene(name="near", objects=(CUBE,)), ("red",))
    mounts = {"overhead": se3.make(p=(*off, 0.0)) @ camera.T_parent_link}
    senses = SimulatedSenses(depth_noise=False, sets=("mujoco_bridge.profile=ideal",))  # the hand knows where it is
    trials = Trials(task, senses, config, Known(mounts))
    errors: list[float] = []
    report = trials._report

    def aim(status: Status) -> None:
        report(status)
        if status.state.value == "CLOSE_GRIPPER":
            p = hand_target(trials, status)
            true = trials.robot.world.objects()[0].T_world_object[:2, 3]
            errors.append(float(np.linalg.norm(p - true)))

    trials._report = aim
    return trials, trials.run(), errors[0]


def hand_target(trials: Trials, status: Status) -> np.ndarray:
    """Where the hand stands at the grasp, seen from above."""
    joints = trials.robot.states.latest()[1]
    return trials.robot.description.link_pose(trials.robot.description.tcp_link(status.arm), joints)[:2, 3]


@pytest.mark.long
def test_the_second_look_removes_the_error_of_the_first() -> None:
    _, _, coarse = grasp(enabled=False, off=(0.009, 0.008))
    trials, row, fine = grasp(enabled=True, off=(0.009, 0.008))
    assert coarse == pytest.approx(0.012, abs=0.002)
    assert fine < 0.0015
    assert row["grasps"][0]["attempts"] == 1
    said = " ".join(step.reason for step in trials.steps)
    assert "the wrist camera sees it 12" in said or "the wrist camera sees it 11" in said
    assert "correcting to red/" in said


@pytest.mark.parametrize("what", ["nothing", "another", "failed", "no plan"])
def test_a_second_look_that_does_not_help_changes_nothing(what: str, worlds, box) -> None:
    world = worlds(box("red", 0.26, -0.2), near={"enabled": True})
    real = world.observe

    async def observe(count: int, *, near: str = "") -> tuple[Frame, ...]:
        seen = await real(count, near=near)
        if not near:
            return seen
        if what == "failed":
            raise OpenArmError(Code.NOT_READY, "no node publishes /wrist/detections_3d")
        found = {"nothing": (), "another": (box("red", 0.34, -0.2),), "no plan": (box("red", 0.27, -0.2),)}[what]
        return tuple(replace(frame, detections=found) for frame in seen)

    world.observe = observe
    if what == "no plan":
        corrects = lambda call: isinstance(call, PlanGrasp) and len(call.candidates) == 1  # noqa: E731
        world.fail(corrects, Code.NO_PLAN)
    world.succeeds()
    (reason,) = [status.reason for status in world.status if status.state.value == "MOVE_TO_GRASP"][:1]
    assert ("going on without" if what == "no plan" else "second observation") in reason
    assert [call.trajectory for call in world.done(Follow)][:2] == ["transfer", "approach"]


def test_a_second_look_corrects_the_grasp_before_the_hand_goes_down(worlds, box) -> None:
    world = worlds(box("red", 0.26, -0.2), near={"enabled": True})
    real = world.observe

    async def observe(count: int, *, near: str = "") -> tuple[Frame, ...]:
        seen = await real(count, near=near)
        if not near:
            return seen
        return tuple(replace(frame, detections=(box("red", 0.27, -0.2),)) for frame in seen)

    world.observe = observe
    world.succeeds()
    first, second = world.done(PlanGrasp)
    assert (len(first.candidates), len(second.candidates)) == (28, 1)
    assert second.candidates[0].T_base_tcp[0, 3] == pytest.approx(0.27)
    assert [call.trajectory for call in world.done(Follow)][:3] == ["transfer", "transfer", "lift"]
