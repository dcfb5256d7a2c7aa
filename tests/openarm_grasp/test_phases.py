# SPDX-License-Identifier: Apache-2.0
"""Requests in parts: pick, place, a yaw, a time limit, and what the answer calls itself."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import Scene, SceneObject
from openarm_grasp.config import GraspConfig, HandConfig, HeldConfig
from openarm_grasp.requests.request import GraspOutcome, GraspRequest
from tests.openarm_grasp.recorded import Recordings, Requests
from tests.refusals import refused

BOX = SceneObject(name="blue_box", shape="box", size=(0.045, 0.068, 0.06), color="blue", position=(0.26, -0.2), yaw=0.4)
CUBE = SceneObject(name="red_cube", shape="box", size=(0.05, 0.05, 0.05), color="red", position=(0.26, 0.2))


def bench(recorded: Recordings, *objects: SceneObject, config: GraspConfig | None = None) -> Requests:
    return recorded(Scene(name="bench", objects=objects), settle=0.3, clouds=False, config=config)


def turned(robot: Requests, name: str, yaw: float) -> float:
    """How far an object is turned from a yaw or its opposite, rad."""
    T = robot.pose(name)
    return abs((math.atan2(T[1, 0], T[0, 0]) - yaw + math.pi / 2.0) % math.pi - math.pi / 2.0)


@pytest.mark.requirement("P-01", "P-09")
def test_a_pick_ends_with_the_object_in_the_hand_and_a_place_puts_it_down_at_position_and_yaw(
    recorded: Recordings,
) -> None:
    robot = bench(recorded, BOX, CUBE)
    outcome = robot.ask("blue", phase="pick")
    assert (outcome.success, outcome.kind, outcome.held) == (True, "SUCCESS", True), outcome.message
    assert robot.pose("blue_box")[2, 3] > 0.40 + 0.03 + 0.08
    assert list(robot.session.kept) == ["right"]
    assert "PLACE" not in [step.state for step in robot.steps]
    robot.pass_time(2.0)
    assert robot.pose("blue_box")[2, 3] > 0.50  # and it stays there
    assert refused("still holds 'blue'", robot.ask, "red").code is Code.NOT_READY
    refused("right hand that holds 'blue'", robot.ask, "red", phase="place")
    outcome = robot.ask(phase="place", place=(0.30, -0.30), place_yaw=0.6)
    assert (outcome.success, outcome.kind) == (True, "SUCCESS"), outcome.message
    assert np.linalg.norm(robot.pose("blue_box")[:2, 3] - (0.30, -0.30)) < 0.02
    assert turned(robot, "blue_box", 0.6) < math.radians(15.0)
    assert not robot.session.kept
    refused("no hand holds anything", robot.ask, phase="place")


@pytest.mark.requirement("P-01", "R-21")
def test_a_new_session_takes_up_what_the_hand_holds_and_places_it_or_releases_it(recorded: Recordings) -> None:
    robot = bench(recorded, BOX, CUBE)
    assert robot.ask("blue", phase="pick").success
    robot.restart()
    refused("right hand still holds 'blue'", robot.ask, "red")
    robot.succeeds(phase="place", place=(0.30, -0.30))
    assert np.linalg.norm(robot.pose("blue_box")[:2, 3] - (0.30, -0.30)) < 0.02

    assert robot.ask("blue", phase="pick").success
    robot.restart()
    if robot.trials is not None:  # the planner was restarted, too
        robot.trials.robot.motion.memory.hold("right", ())
    for phase in ("all", "place"):
        refused(r"right hand presses with .* `openarm grasp release --arm right`", robot.ask, "blue", phase=phase)
    assert robot.pose("blue_box")[2, 3] > 0.50
    assert robot.link.run(robot.session.release(robot.skills, "")) == "the right hand is open"
    robot.pass_time(1.0)
    assert robot.pose("blue_box")[2, 3] < 0.45
    robot.succeeds("red")


def test_a_yaw_that_one_hold_cannot_give_is_given_by_another(recorded: Recordings) -> None:
    robot = bench(recorded, BOX)
    robot.succeeds("blue", place=(0.30, -0.30), place_yaw=1.2)
    assert "trying another grasp" in robot.said
    assert turned(robot, "blue_box", 1.2) < math.radians(15.0)


@pytest.mark.requirement("P-02")
def test_a_time_limit_ends_a_carry_with_the_object_held_and_a_place_frees_it(recorded: Recordings) -> None:
    whole = bench(recorded, BOX).ask("blue").duration
    robot = bench(recorded, BOX)
    outcome = robot.ask("blue", timeout=0.6 * whole)
    assert outcome.code is Code.TIMEOUT
    assert outcome.kind == "PARTIAL"
    assert robot.pose("blue_box")[2, 3] > 0.43  # not dropped
    robot.succeeds(phase="place")


@pytest.mark.parametrize("state", ["MOVE_TO_PREGRASP", "MOVE_TO_GRASP", "CLOSE_GRIPPER", "LIFT", "PLACE", "RESET"])
@pytest.mark.requirement("P-21")
def test_a_cancel_in_each_state_drops_nothing_and_the_next_request_works(recorded: Recordings, state: str) -> None:
    robot = bench(recorded, BOX)
    entered, heights = list[int](), list[float]()

    def watch() -> None:
        if robot.steps and robot.steps[-1].state == state and not entered:
            entered.append(robot.link.now_ns)
        if entered and robot.link.now_ns - entered[0] > 200_000_000:
            robot.link.cancelled = "cancelled by injection"
        heights.append(float(robot.pose("blue_box")[2, 3]))

    robot.link.watch = watch
    outcome = robot.ask("blue")
    assert outcome.code is Code.CANCELLED
    assert outcome.kind == "CANCELLED"
    for _ in range(150):
        robot.pass_time(0.01)
        watch()
    assert -np.diff(heights).min() < 0.01  # a tick of 10 ms: it never falls at 1 m/s
    robot.link.cancelled, robot.link.watch = "", lambda: None
    holds = bool(robot.session.kept) and robot.skills.aperture("right") < 0.08
    robot.succeeds(phase="place") if holds else robot.succeeds("blue")


@pytest.mark.parametrize("use", [False, True])
@pytest.mark.requirement("A-69")
def test_a_grasp_is_held_with_and_without_the_force_of_the_pads(recorded: Recordings, use: bool) -> None:
    """The simulated pads feel half the closing force each; a hand that is closed on nothing feels none."""
    robot = bench(recorded, CUBE, config=GraspConfig(held=HeldConfig(use_finger_force=use)))
    assert max(robot.link.pads("left")) < 0.1
    robot.succeeds("red", phase="pick")
    assert min(robot.link.pads("left")) > 5.0


@pytest.mark.requirement("N-20")
def test_the_closing_force_can_be_limited(recorded: Recordings) -> None:
    robot = bench(recorded, CUBE, config=GraspConfig(hand=HandConfig(close_effort=12.0)))
    robot.succeeds("red", phase="pick")
    assert 10.0 < abs(robot.link.effort("openarm_left_finger_joint1")) <= 12.001


@pytest.mark.requirement("P-02")
def test_the_five_outcomes() -> None:
    with pytest.raises(OpenArmError, match="valid: all, pick, place"):
        GraspRequest("red", phase="throw").check(("left", "right"))  # type: ignore[arg-type]
    outcome = partial(GraspOutcome, message="", label="red")
    assert outcome(Code.PLACE_FAILED, attempts=1, held=True).kind == "PARTIAL"
    assert outcome(Code.GRASP_MISSED, attempts=3).kind == "FAILED"
    assert outcome(Code.TOO_WIDE).kind == "REFUSED"
    assert outcome(Code.CANCELLED, attempts=1, held=True).kind == "CANCELLED"


def test_an_object_taken_from_the_hand_is_forgotten(recorded: Recordings) -> None:
    robot = bench(recorded, BOX, CUBE)
    assert robot.ask("blue", phase="pick").success
    robot.link.run(robot.link.grip("right", "openarm_right_finger_joint1", 0.044, "open"))
    robot.pass_time(1.0)
    refused("no hand holds anything", robot.ask, phase="place")
