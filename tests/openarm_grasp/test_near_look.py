# SPDX-License-Identifier: Apache-2.0
"""A-35: coarse from the camera over the table, fine from the one on the hand. On the robot of a campaign."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.errors import Code
from openarm_common.scene.scene import Scene, SceneObject
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.judge_near import move_to_pregrasp
from openarm_grasp.evidence.observation import Detection, Frame
from openarm_grasp.strategy.effects import Frames, Outcome
from openarm_grasp.strategy.states import Event

CUBE = SceneObject(name="red_cube", shape="box", size=(0.06, 0.06, 0.05), color="red", position=(0.27, -0.22), yaw=0.3)


def grasp(*, enabled: bool, off: tuple[float, float]) -> tuple[Trials, dict, float]:
    """Grasp the cube with the overhead camera believed elsewhere; also how far the hand was from the cube, m."""
    camera = load_cameras()["overhead"]
    config = GraspConfig()
    config = config.model_copy(update={"near": config.near.model_copy(update={"enabled": enabled})})
    task = Task("nominal", 1, Scene(name="near", objects=(CUBE,)), ("red",))
    mounts = {"overhead": se3.make(p=(*off, 0.0)) @ camera.T_parent_link}
    trials = Trials(task, SimulatedSenses(depth_noise=False), config, mounts=mounts)
    errors: list[float] = []
    tell = trials._tell

    def look() -> None:
        tell()
        memory = trials.machine.memory
        if trials.machine.state.value == "MOVE_TO_GRASP" and memory is not None:
            aim = memory.need_candidate().T_base_tcp[:2, 3]
            true = trials.robot.world.objects()[0].T_world_object[:2, 3]
            errors.append(float(np.linalg.norm(aim - true)))

    trials._tell = look
    return trials, trials.run(), errors[0]


@pytest.mark.requirement("A-35")
def test_the_second_look_removes_the_error_of_the_first() -> None:
    _, _, coarse = grasp(enabled=False, off=(0.009, 0.008))
    trials, row, fine = grasp(enabled=True, off=(0.009, 0.008))
    assert coarse == pytest.approx(0.012, abs=0.002)
    assert fine < 0.0015
    assert row["grasps"][0]["attempts"] == 1
    said = " ".join(step.reason for step in trials.steps)
    assert "the wrist camera sees it 12" in said or "the wrist camera sees it 11" in said
    assert "correcting to red/" in said


@pytest.mark.parametrize("what", ["nothing", "another", "failed"])
@pytest.mark.requirement("A-35")
def test_a_second_look_that_does_not_help_changes_nothing(what: str) -> None:
    task = Task("nominal", 1, Scene(name="near", objects=(CUBE,)), ("red",))
    trials = Trials(task, SimulatedSenses(depth_noise=False), GraspConfig())
    machine, tell, verdicts = trials.machine, trials._tell, []

    def look() -> None:
        tell()
        memory = machine.memory
        if memory is None or memory.hand.near != "look" or verdicts:
            return
        before = memory.need_candidate()
        far = Detection("red", 1.0, se3.make(p=(0.34, -0.22, 0.425)), np.array([0.06, 0.06, 0.05]))
        frames = {"nothing": (), "another": (far,)}.get(what, ())
        answer = Outcome(results=(Frames((Frame(1, frames), Frame(2, frames)), "base"),), done=1)
        if what == "failed":
            answer = Outcome(Code.NOT_READY, "nobody publishes /wrist/detections_3d")
        kept = replace(memory)
        verdicts.append((move_to_pregrasp(kept, answer, trials.robot.t_ns, machine._around), kept.candidate is before))

    trials._tell = look
    trials.run()
    ((event, reason), same) = verdicts[0]
    assert event is Event.DONE
    assert same
    assert "second look" in reason
