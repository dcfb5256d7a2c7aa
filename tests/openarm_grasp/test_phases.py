# SPDX-License-Identifier: Apache-2.0
"""Requests in parts: pick, place, a yaw, a time limit, and what the answer calls itself. On the robot of a campaign."""

from __future__ import annotations

import math

import numpy as np
import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import Scene, SceneObject
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig, HandConfig, HeldConfig
from openarm_grasp.requests.request import GraspOutcome, GraspRequest
from openarm_grasp.requests.task import GraspSession
from openarm_grasp.strategies.pick_and_place import pick_and_place
from openarm_grasp.strategies.registry import carry_out

BOX = SceneObject(name="blue_box", shape="box", size=(0.045, 0.068, 0.06), color="blue", position=(0.26, -0.2), yaw=0.4)
CUBE = SceneObject(name="red_cube", shape="box", size=(0.05, 0.05, 0.05), color="red", position=(0.26, 0.2))


class Bench:
    """A robot, and requests to it."""

    def __init__(self, *objects: SceneObject, config: GraspConfig | None = None) -> None:
        scene = Scene(name="bench", objects=objects)
        senses = SimulatedSenses(depth_noise=False)
        self.trials = Trials(Task("nominal", 1, scene, ()), senses, config or GraspConfig())
        self.trials.robot.pass_time(0.3)

    def ask(self, label: str = "", **kwargs) -> GraspOutcome:
        t = self.trials
        t.link.cancelled = ""
        task = t.grasp_task(GraspRequest(label, **kwargs))
        return t.link.run(pick_and_place(task, task.request))

    def position(self, name: str) -> np.ndarray:
        poses = {o.object.name: o.T_world_object for o in self.trials.robot.world.objects()}
        return poses[name][:3, 3]

    def yaw(self, name: str) -> float:
        poses = {o.object.name: o.T_world_object for o in self.trials.robot.world.objects()}
        return math.atan2(poses[name][1, 0], poses[name][0, 0])


@pytest.fixture(scope="module")
def picked() -> Bench:
    """A bench whose right hand holds the blue box."""
    bench = Bench(BOX, CUBE)
    outcome = bench.ask("blue", phase="pick")
    assert outcome.success, outcome.message
    assert outcome.kind == "SUCCESS"
    assert outcome.held
    return bench


@pytest.mark.requirement("P-01")
def test_a_pick_ends_with_the_object_in_the_hand(picked: Bench) -> None:
    assert picked.position("blue_box")[2] > 0.40 + 0.03 + 0.08
    assert list(picked.trials.session.kept) == ["right"]
    states = [step.state for step in picked.trials.steps]
    assert "PLACE" not in states
    picked.trials.robot.pass_time(2.0)
    assert picked.position("blue_box")[2] > 0.50  # and it stays there


@pytest.mark.requirement("P-01")
def test_a_full_hand_is_not_opened_by_another_request(picked: Bench) -> None:
    with pytest.raises(OpenArmError, match="still holds 'blue'") as error:
        picked.ask("red")
    assert error.value.code is Code.NOT_READY


@pytest.mark.requirement("P-01")
def test_a_place_that_contradicts_the_hand_is_refused(picked: Bench) -> None:
    with pytest.raises(OpenArmError, match="right hand that holds 'blue'"):
        picked.ask("red", phase="place")


@pytest.mark.requirement("P-01", "P-09")
def test_a_place_puts_it_down_at_position_and_yaw(picked: Bench) -> None:
    outcome = picked.ask("", phase="place", place=(0.30, -0.30), place_yaw=0.6)
    assert outcome.success, outcome.message
    assert outcome.kind == "SUCCESS"
    assert np.linalg.norm(picked.position("blue_box")[:2] - (0.30, -0.30)) < 0.02
    off = (picked.yaw("blue_box") - 0.6 + math.pi / 2.0) % math.pi - math.pi / 2.0
    assert abs(off) < math.radians(15.0)
    assert not picked.trials.session.kept
    with pytest.raises(OpenArmError, match="no hand holds anything"):
        picked.ask("", phase="place")


@pytest.mark.requirement("P-01", "R-21")
def test_a_new_session_takes_up_what_the_hand_holds_and_places_it_or_releases_it() -> None:
    bench = Bench(BOX, CUBE)
    trials = bench.trials
    assert bench.ask("blue", phase="pick").success

    def whole(label: str, **kwargs) -> GraspOutcome:
        return trials.link.run(carry_out(trials.grasp_task(GraspRequest(label, **kwargs))))

    trials.session = GraspSession(trials.session.context)  # as after a restart
    with pytest.raises(OpenArmError, match="right hand still holds 'blue'"):
        whole("red")
    outcome = whole("", phase="place", place=(0.30, -0.30))
    assert outcome.success, outcome.message
    assert np.linalg.norm(bench.position("blue_box")[:2] - (0.30, -0.30)) < 0.02

    assert bench.ask("blue", phase="pick").success
    trials.session = GraspSession(trials.session.context)
    trials.robot.motion.memory.hold("right", ())  # the planner was restarted, too
    for phase in ("all", "place"):
        with pytest.raises(OpenArmError, match=r"right hand presses with .* `openarm grasp release --arm right`"):
            whole("blue", phase=phase)
    assert bench.position("blue_box")[2] > 0.50
    assert trials.link.run(trials.session.release(trials.skills, "")) == "the right hand is open"
    trials.robot.pass_time(1.0)
    assert bench.position("blue_box")[2] < 0.45
    outcome = whole("red")
    assert outcome.success, outcome.message


def test_a_yaw_that_one_hold_cannot_give_is_given_by_another() -> None:
    bench = Bench(BOX)
    outcome = bench.ask("blue", place=(0.30, -0.30), place_yaw=1.2)
    assert outcome.success, outcome.message
    assert any("trying another grasp" in step.reason for step in bench.trials.steps)
    off = (bench.yaw("blue_box") - 1.2 + math.pi / 2.0) % math.pi - math.pi / 2.0
    assert abs(off) < math.radians(15.0)


@pytest.mark.requirement("P-02")
def test_a_time_limit_ends_a_carry_with_the_object_held_and_a_place_frees_it() -> None:
    bench = Bench(BOX)
    whole = Bench(BOX).ask("blue").duration
    outcome = bench.ask("blue", timeout=0.6 * whole)
    assert outcome.code is Code.TIMEOUT
    assert outcome.kind == "PARTIAL"
    assert bench.position("blue_box")[2] > 0.43  # not dropped
    outcome = bench.ask("", phase="place")
    assert outcome.success, outcome.message


@pytest.mark.parametrize("state", ["MOVE_TO_PREGRASP", "MOVE_TO_GRASP", "CLOSE_GRIPPER", "LIFT", "PLACE", "RESET"])
@pytest.mark.requirement("P-21")
def test_a_cancel_in_each_state_drops_nothing_and_the_next_request_works(state: str) -> None:
    bench = Bench(BOX)
    trials, robot = bench.trials, bench.trials.robot
    entered: list[int] = []
    fastest: list[float] = []

    def watch() -> None:
        if trials.steps and trials.steps[-1].state == state and not entered:
            entered.append(robot.t_ns)
        if entered and robot.t_ns - entered[0] > 400_000_000:
            trials.link.cancelled = "cancelled by injection"
        fastest.append(float(np.linalg.norm(robot.world.objects()[0].linear)))

    trials.link.watch = watch
    outcome = bench.ask("blue")
    trials.link.watch = lambda: None
    assert outcome.code is Code.CANCELLED
    assert outcome.kind == "CANCELLED"
    for _ in range(150):
        robot.tick()
        fastest.append(float(np.linalg.norm(robot.world.objects()[0].linear)))
    assert max(fastest) < 1.0  # a fall of 5 cm ends at 1 m/s
    holds = bool(trials.session.kept) and trials.skills.aperture("right") < 0.08
    outcome = bench.ask("", phase="place") if holds else bench.ask("blue")
    assert outcome.success, outcome.message


@pytest.mark.parametrize("use", [False, True])
@pytest.mark.requirement("A-69")
def test_a_grasp_is_held_with_and_without_the_force_of_the_pads(use: bool) -> None:
    """The simulated pads feel half the closing force each; a hand that is closed on nothing feels none."""
    bench = Bench(CUBE, config=GraspConfig(held=HeldConfig(use_finger_force=use)))
    assert max(bench.trials.link.pads("left")) < 0.1
    outcome = bench.ask("red", phase="pick")
    assert outcome.success, outcome.message
    assert min(bench.trials.link.pads("left")) > 5.0


@pytest.mark.requirement("N-20")
def test_the_closing_force_can_be_limited() -> None:
    bench = Bench(CUBE, config=GraspConfig(hand=HandConfig(close_effort=12.0)))
    outcome = bench.ask("red", phase="pick")
    assert outcome.success, outcome.message
    column = bench.trials.robot.columns(["openarm_left_finger_joint1"])[0]
    pressed = [abs(float(effort[column])) for _, _, effort in bench.trials.robot.trace]
    assert 10.0 < max(pressed) <= 12.001


@pytest.mark.requirement("P-02")
def test_the_five_outcomes() -> None:
    with pytest.raises(OpenArmError, match="valid: all, pick, place"):
        Bench(BOX).ask("", phase="throw")

    def kind(code: Code, attempts: int, held: bool = False) -> str:
        return GraspOutcome(code, "", "red", attempts=attempts, held=held).kind

    assert kind(Code.PLACE_FAILED, 1, held=True) == "PARTIAL"
    assert kind(Code.GRASP_MISSED, 3) == "FAILED"
    assert kind(Code.TOO_WIDE, 0) == "REFUSED"
    assert kind(Code.CANCELLED, 1, held=True) == "CANCELLED"


def test_an_object_taken_from_the_hand_is_forgotten() -> None:
    bench = Bench(BOX, CUBE)
    assert bench.ask("blue", phase="pick").success
    bench.trials.link.run(bench.trials.link.grip("right", "openarm_right_finger_joint1", 0.044, "open"))
    bench.trials.robot.pass_time(1.0)
    with pytest.raises(OpenArmError, match="no hand holds anything"):
        bench.ask("", phase="place")
