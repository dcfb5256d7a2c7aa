# SPDX-License-Identifier: Apache-2.0
"""Robots of one arm, with six or seven joints, fingers on slides or a linkage; their grasps and those of OpenArm v2."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import mujoco
import pytest

from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import ROBOT
from openarm_common.scene.scene import Scene, SceneObject
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.suites import make_task
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig
from openarm_grasp.requests.request import GraspRequest
from openarm_grasp.strategies.hand_over import hand_over
from openarm_grasp.strategies.pair import _an_arm_for_each
from openarm_sim_bridge.world.model import PhysicsConfig, robot_spec
from openarm_sim_bridge.world.world import start_qpos

ROBOTS = ("panda", "ur5e")


@pytest.fixture(params=ROBOTS)
def robot(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> RobotDescription:
    monkeypatch.setenv(ROBOT, request.param)
    return RobotDescription.load()


@pytest.mark.requirement("B-13")
def test_pads_close_on_each_other_and_stand_apart_as_the_table_of_the_hand_says(robot: RobotDescription) -> None:
    """By the compiled model with its couplings, for every joint that follows the driven one."""
    (arm,) = robot.arm_names
    hand, model = robot.hand(arm), robot_spec(robot, PhysicsConfig()).compile()
    data = mujoco.MjData(model)
    pads = [model.geom(f"{link}_pad_collision").id for link in robot.arm(arm).fingers]
    data.qpos[:] = start_qpos(model, robot.group_state(f"{arm}_arm", "home"))
    model.opt.gravity[:] = 0.0
    servo = model.actuator(hand.joint).id
    for finger in (0.01, 0.025, hand.parts.opening):
        for actuator in range(model.nu):
            data.ctrl[actuator] = data.qpos[model.jnt_qposadr[model.actuator_trnid[actuator, 0]]]
        data.ctrl[servo] = hand.position(finger)
        mujoco.mj_step(model, data, 800)
        a, b = (data.geom_xpos[pad] for pad in pads)
        axis = data.site_xmat[model.site(robot.tcp_link(arm)).id].reshape(3, 3)[:, 1]
        thick = 2.0 * float(min(model.geom_size[pads[0]]))
        assert abs(float((a - b) @ axis)) - thick == pytest.approx(2.0 * finger, abs=1e-3)


def test_what_takes_two_arms_is_not_offered(robot: RobotDescription) -> None:
    context = SimpleNamespace(shoulders={robot.arm_names[0]: (0.0, 0.0)})
    findings = SimpleNamespace(place_refused=True)
    task = SimpleNamespace(
        context=context, outcome=object(), request=SimpleNamespace(place=(0.4, 0.0)), findings=findings
    )
    assert asyncio.run(hand_over(cast("Any", task))) is None
    both, session = (GraspRequest("red"), GraspRequest("blue")), SimpleNamespace(context=context)
    shared = asyncio.run(_an_arm_for_each(cast("Any", session), cast("Any", SimpleNamespace(now_ns=1)), both))
    assert shared == (both, "the robot has one arm: one after the other")
    for suite in ("handover", "push", "pairs"):
        with pytest.raises(OpenArmError, match="needs two arms"):
            make_task(suite, 0)


@pytest.mark.long
@pytest.mark.requirement("B-13", "R-04")
@pytest.mark.parametrize(
    ("name", "arm", "camera", "position", "most_mm"),
    [
        ("panda", "panda", "wrist", (0.5, 0.15), 6.0),
        ("ur5e", "ur5e", "wrist", (0.5, 0.15), 6.0),
        ("openarm_v2", "left", "left_wrist", (0.26, 0.22), 5.0),
        ("openarm_v2", "right", "right_wrist", (0.26, -0.22), 5.0),
    ],
)
def test_a_robot_places_an_object_and_looks_with_the_camera_on_its_hand(
    monkeypatch: pytest.MonkeyPatch, name: str, arm: str, camera: str, position: tuple[float, float], most_mm: float
) -> None:
    monkeypatch.setenv(ROBOT, name)
    item = SceneObject(name="box", shape="box", size=(0.05, 0.06, 0.06), color="red", position=position, yaw=0.3)
    scene = Scene(name="one", objects=(item,))
    trials = Trials(Task("nominal", 1, scene, ("red",)), SimulatedSenses(depth_noise=True, sets=()), GraspConfig())
    (grasp,) = trials.run()["grasps"]
    assert (grasp["outcome"], grasp["arm"], grasp["attempts"]) == ("placed", arm, 1), grasp["message"]
    assert grasp["place_error_mm"] < most_mm
    assert f"the {camera} camera sees it" in " ".join(step.reason for step in trials.steps)
