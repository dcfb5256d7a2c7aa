# SPDX-License-Identifier: Apache-2.0
"""Followers against an ideal arm (it is always where commanded), and against arms that lag, stick or are pushed."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common.errors import Code
from openarm_common.robot.servos import ServoModel
from openarm_control.arm import End, FollowerState, TrajectoryConfig, TrajectoryFollower, TrajectoryOutcome
from openarm_control.carrier import Carrier, CarrierConfig
from openarm_control.follower import Tracker
from openarm_control.trajectory import JointGroup, Trajectory, TrajectoryError, TrajectoryResult
from tests.refusals import refused

MS = 1_000_000
GROUP = JointGroup(("j1", "j2"), np.array([-2.0, -2.0]), np.array([2.0, 2.0]), np.array([4.0, 4.0]))
CONFIG = TrajectoryConfig()
START = 1_000 * MS


class Arm:
    """A follower and the joints it moves; `plant` maps (position, target) to the position a tick later."""

    def __init__(
        self,
        plant=lambda q, target: target,
        config: TrajectoryConfig = CONFIG,
        lead: float = 0.0,
        group: JointGroup = GROUP,
    ) -> None:
        servos = ServoModel(np.ones(2), np.full(2, lead), np.zeros(2), np.zeros(2), np.zeros(2))
        self.follower = TrajectoryFollower(group, config, Carrier(servos, config.carrier), np.zeros(2))
        self.plant = plant
        self.q, self.v = np.zeros(2), np.zeros(2)
        self.t_ns = START
        self.outcomes: list[TrajectoryOutcome] = []
        self.history: list[np.ndarray] = []

    def start(self, **changes) -> None:
        given = {"names": GROUP.names, "t": np.array([1.0]), "q": np.array([[0.5, -0.5]])} | changes
        self.follower.start(self.follower.check(Trajectory(**given)), self.t_ns, self.q, self.outcomes.append)

    def tick(self, n: int = 1) -> None:
        for _ in range(n):
            target = self.follower.update(self.t_ns, 10 * MS, self.q, self.v, np.zeros(2))
            q = self.plant(self.q, target)
            self.v, self.q = (q - self.q) / 0.01, q
            self.t_ns += 10 * MS
            self.history.append(target)

    def run(self, limit: int = 1000) -> TrajectoryOutcome:
        n = len(self.outcomes)
        while len(self.outcomes) == n:
            assert limit > 0, "the goal did not end"
            self.tick()
            limit -= 1
        return self.outcomes[-1]


CUBIC = {"t": np.array([0.0, 1.0]), "q": np.array([[0.0, 0.0], [0.5, -0.5]]), "v": np.zeros((2, 2))}


@pytest.fixture
def arm() -> Arm:
    return Arm()


def test_a_trajectory_is_followed_to_its_goal(arm: Arm) -> None:
    arm.start(**CUBIC)
    assert arm.follower.busy
    outcome = arm.run()
    assert (outcome.end, outcome.result) == (End.SUCCEEDED, TrajectoryResult.SUCCESSFUL)
    assert arm.t_ns - START == pytest.approx(1010 * MS, abs=20 * MS)
    np.testing.assert_allclose(arm.q, [0.5, -0.5])
    np.testing.assert_allclose(arm.history[49], [0.25, -0.25], atol=1e-9)  # at half time the cubic is half way
    assert not arm.follower.busy


def test_the_way_to_the_first_point_starts_at_the_present_command(arm: Arm) -> None:
    arm.start(t=np.array([0.5, 1.0]), q=np.array([[0.2, 0.2], [0.4, 0.4]]), v=np.array([[0.4, 0.4], [0.0, 0.0]]))
    arm.run()
    steps = np.abs(np.diff(np.vstack([np.zeros(2), *arm.history]), axis=0))
    assert steps.max() < 0.01  # no jump
    np.testing.assert_allclose(arm.history[49], [0.2, 0.2], atol=1e-9)


def test_a_small_offset_at_the_start_fades_instead_of_jumping(arm: Arm) -> None:
    arm.start(**(CUBIC | {"q": np.array([[0.03, 0.0], [0.5, -0.5]])}))
    arm.tick()
    assert abs(arm.history[0][0]) < 0.002
    assert arm.run().end is End.SUCCEEDED
    np.testing.assert_allclose(arm.q, [0.5, -0.5])


def test_a_start_far_from_the_arm_is_refused_with_joint_and_value(arm: Arm) -> None:
    far = CUBIC | {"q": np.array([[0.0, 0.4], [0.5, -0.5]])}
    error = refused(r"starts with j2 at 0\.400 rad, but it is at 0\.000", arm.start, **far)
    assert error.result is TrajectoryResult.PATH_TOLERANCE_VIOLATED
    assert not arm.follower.busy


def test_a_first_point_that_cannot_be_reached_in_time_is_refused() -> None:
    error = refused(r"j1 would have to move at 50\.00 rad/s to be at the first point", Arm().start, t=np.array([0.01]))
    assert isinstance(error, TrajectoryError)


def test_after_a_lost_turn_the_first_motion_is_slow_and_a_fast_one_refused_with_why(arm: Arm) -> None:
    arm.follower.careful = "a motor lost a turn"
    limit = (
        r"0\.50 rad/s between point 0 and the next, its limit is 0\.30 until this arm has arrived once: a motor lost"
    )
    refused(limit, arm.start)
    arm.follower.set_target(np.array([0.3, 0.0]))
    arm.tick(200)
    assert np.diff(np.array(arm.history), axis=0).max() <= 0.3 * 0.01 + 1e-9
    np.testing.assert_allclose(arm.q, [0.3, 0.0])
    arm.start(t=np.array([2.0]))
    arm.follower.cancel()
    assert arm.run().end is End.CANCELLED
    refused("until this arm has arrived once", arm.start, t=np.array([0.8]))
    arm.start(t=np.array([2.0]))
    assert arm.run().end is End.SUCCEEDED
    assert arm.follower.fastest == np.inf
    arm.start(q=np.zeros((1, 2)))
    assert arm.run().end is End.SUCCEEDED


def test_a_joint_without_end_is_commanded_on_from_where_it_is_whatever_turn_is_asked_for() -> None:
    far = np.array([np.inf, 2.0])
    arm = Arm(group=JointGroup(GROUP.names, -far, far, GROUP.max_velocity))
    arm.start(t=np.array([2.0]), q=np.array([[3.1, 0.0]]))
    arm.run()
    arm.start(t=np.array([0.0, 1.0]), q=np.array([[3.1 - 4.0 * np.pi, 0.0], [3.3 - 4.0 * np.pi, 0.5]]))
    assert arm.run().result is TrajectoryResult.SUCCESSFUL
    np.testing.assert_allclose(arm.q, [3.3, 0.5])
    arm.follower.set_target(np.array([-2.5, np.nan]))
    arm.tick(200)
    np.testing.assert_allclose(arm.q, [2.0 * np.pi - 2.5, 0.5])
    assert np.abs(np.diff(np.array(arm.history), axis=0)).max() < 0.04


def test_targets_lead_by_lag_times_velocity() -> None:
    for lag in (True, False):
        arm = Arm(config=TrajectoryConfig(carrier=CarrierConfig(lag=lag)), lead=0.02)
        arm.start(t=np.array([0.0, 1.0]), q=np.array([[0.0, 0.0], [0.5, -0.5]]))
        arm.tick(50)
        np.testing.assert_allclose(arm.history[49], np.array([0.25, -0.25]) + (0.02 * np.array([0.5, -0.5])) * lag)


def test_a_stamp_in_the_future_delays_the_start(arm: Arm) -> None:
    arm.start(start_ns=START + 300 * MS)
    arm.tick(30)
    np.testing.assert_array_equal(arm.q, 0.0)
    assert arm.run().end is End.SUCCEEDED
    assert arm.t_ns - START == pytest.approx(1310 * MS, abs=20 * MS)


def test_a_stamp_in_the_past_joins_the_trajectory_where_it_should_be(arm: Arm) -> None:
    arm.start(**(CUBIC | {"start_ns": START - 20 * MS}))
    assert arm.run().end is End.SUCCEEDED
    assert arm.t_ns - START == pytest.approx(990 * MS, abs=20 * MS)
    assert np.abs(np.diff(np.array(arm.history), axis=0)).max() < 0.02


def test_a_trajectory_that_is_over_already_is_refused(arm: Arm) -> None:
    error = refused(r"ended 0\.50 s ago", arm.start, start_ns=START - 1500 * MS)
    assert error.result is TrajectoryResult.OLD_HEADER_TIMESTAMP


def test_a_stamp_of_another_clock_is_refused() -> None:
    assert isinstance(refused("use_sim_time", Arm().start, start_ns=1_700_000_000 * 1000 * MS), TrajectoryError)


def test_a_joint_that_is_held_back_ends_the_goal_and_the_arm_holds_there() -> None:
    arm = Arm(plant=lambda q, target: np.minimum(target, 0.2))
    arm.start(**(CUBIC | {"q": np.array([[0.0, 0.0], [0.5, 0.0]])}))
    outcome = arm.run()
    assert (outcome.end, outcome.result) == (End.ABORTED, TrajectoryResult.PATH_TOLERANCE_VIOLATED)
    assert outcome.text.startswith("j1 is 0.05")
    arm.tick(5)
    np.testing.assert_allclose(arm.history[-1], [0.2, 0.0])


@pytest.mark.parametrize("tolerance", [-1.0, 0.5])
def test_path_tolerance_of_the_goal_replaces_the_default(tolerance: float) -> None:
    arm = Arm(plant=lambda q, target: np.minimum(target, 0.2))
    arm.start(**(CUBIC | {"q": np.array([[0.0, 0.0], [0.5, 0.0]]), "path_tolerance": {"j1": tolerance}}))
    outcome = arm.run()
    assert outcome.result is TrajectoryResult.GOAL_TOLERANCE_VIOLATED
    assert arm.t_ns - START == pytest.approx(2010 * MS, abs=30 * MS)  # one second of grace
    assert "j1 is 0.300 rad off its goal" in outcome.text


def test_goal_tolerance_and_goal_time_of_the_goal_replace_the_defaults() -> None:
    arm = Arm(plant=lambda q, target: target - 0.03)
    arm.q = np.full(2, -0.03)
    arm.start(**(CUBIC | {"goal_time_s": 0.2}))
    assert arm.run().result is TrajectoryResult.GOAL_TOLERANCE_VIOLATED
    assert arm.t_ns - START == pytest.approx(1210 * MS, abs=30 * MS)
    loose = dict.fromkeys(GROUP.names, 0.04)
    arm.start(t=np.array([0.5]), q=np.array([[0.4, -0.4]]), goal_tolerance=loose)
    assert arm.run().result is TrajectoryResult.SUCCESSFUL


@pytest.mark.requirement("P-21")
def test_cancel_slows_down_along_the_path_and_holds(arm: Arm) -> None:
    arm.start(**CUBIC)
    arm.tick(50)
    arm.follower.cancel()
    assert arm.run().end is End.CANCELLED
    np.testing.assert_allclose(arm.q[0], -arm.q[1])  # still on the path
    assert 0.25 < arm.q[0] < 0.35
    held = arm.q.copy()
    arm.tick(50)
    np.testing.assert_array_equal(arm.q, held)
    assert np.abs(np.diff(np.array(arm.history), n=2, axis=0)).max() < 0.0015  # less than 15 rad/s2


def test_cancel_before_the_start_holds_at_once(arm: Arm) -> None:
    arm.start(start_ns=START + 1000 * MS)
    arm.follower.cancel()
    assert arm.run(limit=20).end is End.CANCELLED
    np.testing.assert_array_equal(arm.q, 0.0)


def test_a_new_trajectory_takes_over_without_a_jump(arm: Arm) -> None:
    arm.start(**CUBIC)
    arm.tick(50)
    arm.start(t=np.array([1.0]), q=np.array([[0.0, 0.3]]), v=np.zeros((1, 2)))
    assert [o.end for o in arm.outcomes] == [End.ABORTED]
    assert "newer" in arm.outcomes[0].text
    assert arm.run().end is End.SUCCEEDED
    np.testing.assert_allclose(arm.q, [0.0, 0.3])
    assert np.abs(np.diff(np.array(arm.history), n=2, axis=0)).max() < 0.0015


def test_trajectories_that_replace_each_other_keep_the_velocity_of_the_reference(arm: Arm) -> None:
    """As servoing streams them: a reference that rests for a tick at each would brake the arm, and hold it back."""
    ahead, states = 0.05 * np.arange(1, 8), list[FollowerState]()
    for k in range(40):
        q = 0.004 * k + 0.4 * ahead
        v = np.full((7, 2), 0.4)
        v[-1] = 0.0
        for _ in range(2):  # two of them between ticks are one
            arm.start(t=ahead, q=np.stack([q, -q], axis=1), v=v * [1.0, -1.0], start_ns=arm.t_ns)
        arm.tick()
        assert arm.follower.state is not None
        states.append(arm.follower.state)
    velocity = np.array([state.desired_velocity for state in states[10:]])
    np.testing.assert_allclose(velocity, np.tile([0.4, -0.4], (30, 1)), atol=0.02)
    arm.follower.abort("the end")
    arm.tick()
    np.testing.assert_array_equal(arm.follower.state.desired_velocity, 0.0)


@pytest.mark.requirement("P-21")
def test_a_busy_arm_refuses_new_goals_where_that_is_configured() -> None:
    arm = Arm(config=TrajectoryConfig(new_goal="refuse"))
    arm.start(**CUBIC)
    arm.tick(30)
    error = refused(r"another 0\.70 s.*trajectory\.new_goal", arm.start, **CUBIC)
    assert (error.code, error.result) == (Code.BUSY, TrajectoryResult.INVALID_GOAL)
    assert arm.run().end is End.SUCCEEDED
    arm.start(t=np.array([1.0]), q=np.zeros((1, 2)))
    assert arm.follower.busy


def test_reset_aborts_and_holds_the_new_position(arm: Arm) -> None:
    arm.start(**CUBIC)
    arm.tick(10)
    arm.follower.reset(np.array([0.7, 0.7]))
    assert arm.outcomes[0].end is End.ABORTED
    arm.tick()
    np.testing.assert_array_equal(arm.history[-1], [0.7, 0.7])


def test_a_position_command_moves_at_bounded_speed_and_stops_there(arm: Arm) -> None:
    arm.follower.set_target(np.array([1.0, np.nan]))
    arm.tick(200)
    np.testing.assert_array_equal(arm.q, [1.0, 0.0])
    steps = np.diff(np.vstack([np.zeros(2), *arm.history]), axis=0)
    assert np.abs(steps).max() <= CONFIG.command_velocity * 0.01 + 1e-12
    # the last step ends on the target
    assert np.abs(np.diff(steps, axis=0)).max() <= CONFIG.command_acceleration * 1e-4 * 1.2


def test_position_commands_are_ignored_while_a_trajectory_runs(arm: Arm) -> None:
    arm.start(**CUBIC)
    arm.follower.set_target(np.array([-1.0, -1.0]))
    arm.run()
    arm.tick(100)
    np.testing.assert_allclose(arm.q, [0.5, -0.5])


@settings(max_examples=25)
@given(target=st.floats(-3.0, 3.0), v=st.floats(0.1, 5.0), a=st.floats(0.5, 50.0))
def test_the_tracker_arrives_without_overshoot(target: float, v: float, a: float) -> None:
    tracker, goal = Tracker([0.0], [v], [a]), np.array([target])
    furthest = 0.0
    for _ in range(int((abs(target) / v + v / a) * 100) + 20):
        tracker.step(goal, 0.01)
        furthest = max(furthest, abs(tracker.position[0]))
    assert tracker.position[0] == target
    assert furthest <= abs(target) + 1e-12


def test_an_arm_that_swings_about_its_goal_has_not_reached_it() -> None:
    swing = itertools.cycle((0.01, -0.01))
    arm = Arm(plant=lambda q, target: target + next(swing))
    arm.start(**CUBIC, goal_time_s=0.5)
    outcome = arm.run()
    assert (outcome.end, outcome.result) == (End.ABORTED, TrajectoryResult.GOAL_TOLERANCE_VIOLATED)
    assert "moves at 2.000 rad/s" in outcome.text
