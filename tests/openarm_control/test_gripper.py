# SPDX-License-Identifier: Apache-2.0
"""The follower of a gripper against an ideal finger, and against one that is stopped by an object."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_control.arm import End
from openarm_control.gripper import GripperConfig, GripperFollower, GripperGoal, GripperOutcome
from openarm_control.trajectory import JointGroup
from tests.refusals import refused

MS = 1_000_000
FINGER = JointGroup(("finger",), np.array([0.0]), np.array([0.044]), np.array([10.0]))
START = 1_000 * MS


class Finger:
    """A gripper follower and a finger that an object may stop at `width`; pressing on it costs `effort`."""

    def __init__(self, position: float = 0.044, stop: float = -1.0) -> None:
        self.follower = GripperFollower(FINGER, GripperConfig(), [position], 30.0)
        self.x, self.v, self.stop, self.t_ns = position, 0.0, stop, START
        self.targets: list[float] = []
        self.outcomes: list[GripperOutcome] = []

    def start(self, position: float, **kwargs) -> None:
        goal = self.follower.check(GripperGoal(position, **kwargs))
        self.follower.start(goal, self.x, self.effort, self.outcomes.append)

    def update(self, x: float, v: float, effort: float) -> float:
        measured = (np.array([value]) for value in (x, v, effort))
        return float(self.follower.update(self.t_ns, 10 * MS, *measured)[0])

    @property
    def effort(self) -> float:
        command = self.targets[-1] if self.targets else self.x
        return float(np.clip(2000.0 * (command - self.x), -30.0, 30.0))

    def run(self, limit: int = 400) -> GripperOutcome:
        n = len(self.outcomes)
        while len(self.outcomes) == n:
            assert limit > 0, "the goal did not end"
            self.tick()
            limit -= 1
        return self.outcomes[-1]

    def tick(self, n: int = 1) -> None:
        for _ in range(n):
            self.targets.append(self.update(self.x, self.v, self.effort))
            x = max(self.targets[-1], self.stop)
            self.v, self.x = (x - self.x) / 0.01, x
            self.t_ns += 10 * MS


def test_after_a_lost_turn_the_first_motion_of_a_hand_is_slow() -> None:
    finger = Finger()
    finger.follower.careful = "a motor lost a turn"
    for position, fastest in ((0.035, 0.0075), (0.0, 0.075)):
        finger.targets.clear()
        finger.start(position)
        assert finger.run().reached_goal
        assert np.abs(np.diff(finger.targets)).max() == pytest.approx(fastest * 0.01)


@pytest.mark.parametrize("position", [0.005, 0.035, 0.025, 0.0, 0.044])
@pytest.mark.requirement("P-22")
def test_the_finger_reaches_its_goal(position: float) -> None:
    finger = Finger(position=0.02)
    finger.start(position)
    outcome = finger.run()
    assert (outcome.end, outcome.reached_goal, outcome.stalled) == (End.SUCCEEDED, True, False)
    assert outcome.position == pytest.approx(position, abs=0.001)


@pytest.fixture
def finger() -> Finger:
    return Finger()


@pytest.mark.requirement("B-53")
def test_closing_takes_six_tenths_of_a_second(finger: Finger) -> None:
    finger.start(0.0)
    finger.run()
    assert (finger.t_ns - START) / 1e9 == pytest.approx(0.66, abs=0.06)


def test_an_object_stalls_the_finger_and_is_pressed_on() -> None:
    finger = Finger(stop=0.025)
    finger.tick()
    assert not finger.follower.pressing
    finger.start(0.0)
    outcome = finger.run()
    finger.tick()
    assert finger.follower.pressing
    assert (outcome.end, outcome.reached_goal, outcome.stalled) == (End.SUCCEEDED, False, True)
    assert outcome.position == 0.025
    assert outcome.effort == -30.0
    finger.tick(100)
    assert finger.targets[-1] == 0.0


def test_fingers_that_an_object_stops_have_closed_before_the_command_is_at_its_end() -> None:
    times = []
    for stop in (0.040, 0.025, 0.002):
        finger = Finger(stop=stop)
        finger.start(0.0)
        outcome = finger.run()
        assert (outcome.stalled, outcome.reached_goal) == (True, False)
        times.append((finger.t_ns - START) / 1e9)
        met = (0.044 - stop) / 0.075
        assert times[-1] == pytest.approx(met + GripperConfig().stall_time, abs=0.1)
    assert times == sorted(times)


def test_a_hand_that_presses_opens_from_where_its_fingers_are() -> None:
    finger = Finger(stop=0.025)
    finger.start(0.0)
    finger.run()
    finger.tick(100)
    assert finger.targets[-1] == 0.0
    began, finger.stop = finger.t_ns, -1.0
    finger.start(0.044)
    finger.tick()
    assert finger.targets[-1] == pytest.approx(0.025, abs=0.001)
    assert finger.run().reached_goal
    assert (finger.t_ns - began) / 1e9 == pytest.approx((0.044 - 0.025) / 0.075, abs=0.1)


def test_fingers_that_are_stopped_as_they_open_are_not_taken_for_stopped_before_they_push() -> None:
    finger = Finger(position=0.010)
    finger.start(0.044)
    finger.tick(3)
    assert not finger.outcomes
    assert finger.run().reached_goal


@pytest.mark.parametrize("lever", [0.09, -0.09])
def test_a_hinge_moves_its_finger_as_a_slide_does(lever: float) -> None:
    lower, upper = sorted((0.0, 0.044 / lever))
    group = JointGroup(("hinge",), np.array([lower]), np.array([upper]), np.array([10.0]), lever)
    slide, outcomes = Finger(stop=0.025), list[GripperOutcome]()
    hinge = GripperFollower(group, GripperConfig(), [0.044 / lever], 2.7)
    slide.start(0.0)
    hinge.start(hinge.check(GripperGoal(0.0)), 0.044 / lever, 0.0, outcomes.append)
    while not slide.outcomes:
        at, effort = (np.array([value]) for value in (slide.x / lever, slide.effort * lever))
        target = hinge.update(slide.t_ns, 10 * MS, at, np.array([slide.v / lever]), effort)
        pressing = hinge.pressing
        slide.tick()
        assert target[0] * lever == pytest.approx(slide.targets[-1], abs=1e-9)
        assert pressing == slide.follower.pressing
    assert outcomes[0].stalled
    assert outcomes[0].position * lever == pytest.approx(slide.outcomes[0].position)


def test_effort_is_limited_as_asked_and_by_the_gripper(finger: Finger) -> None:
    for asked, limit in ((10.0, 10.0), (100.0, 30.0), (0.0, 30.0), (-5.0, 30.0)):
        finger.start(0.0, max_effort=asked)
        assert finger.follower.effort_limit == limit


def test_velocity_is_limited_as_asked(finger: Finger) -> None:
    finger.start(0.0, max_velocity=0.022)
    finger.run()
    assert (finger.t_ns - START) / 1e9 == pytest.approx(2.05, abs=0.1)


def test_cancel_stops_the_ramp(finger: Finger) -> None:
    finger.start(0.0)
    finger.tick(20)
    finger.follower.cancel()
    assert finger.run(limit=2).end is End.CANCELLED
    held = finger.targets[-1]
    finger.tick(50)
    assert finger.targets[-1] == pytest.approx(held, abs=0.002)


def test_a_new_gripper_goal_takes_over(finger: Finger) -> None:
    finger.start(0.0)
    finger.tick(5)
    finger.start(0.044)
    assert finger.outcomes[0].end is End.ABORTED
    assert finger.run().reached_goal


def test_a_finger_that_never_rests_times_out(finger: Finger) -> None:
    finger.start(0.02)
    for i in range(600):
        finger.update(0.03, 0.01 * (-1) ** i, 0.0)
        finger.t_ns += 10 * MS
    assert [o.end for o in finger.outcomes] == [End.ABORTED]
    assert "still moves at" in finger.outcomes[0].text


@pytest.mark.parametrize(
    ("kwargs", "code", "message"),
    [
        ({"position": 0.1}, Code.LIMITS, r"position of finger is 0\.1000, out of its limits 0\.000 to 0\.044"),
        ({"position": float("nan")}, Code.INVALID_ARGUMENT, "position of finger is nan"),
        ({"position": 0.01, "max_effort": float("inf")}, Code.INVALID_ARGUMENT, "effort of finger is inf"),
    ],
)
def test_bad_gripper_goals_are_refused_with_joint_and_value(kwargs: dict, code: Code, message: str) -> None:
    assert refused(message, Finger().follower.check, GripperGoal(**kwargs)).code is code


def test_rests_on_the_way_do_not_add_up_to_a_stall(finger: Finger) -> None:
    finger.start(0.0)
    finger.tick(100)
    finger.start(0.0, max_effort=5.0)
    short = int(0.8 * GripperConfig().stall_time / 0.01)
    for velocity in 3 * [*short * [0.0], 0.1]:
        finger.update(0.03, velocity, -5.0)
        finger.t_ns += 10 * MS
    assert len(finger.outcomes) == 1
    for _ in range(2 * short):
        finger.update(0.03, 0.0, -5.0)
    assert finger.outcomes[-1].stalled
