# SPDX-License-Identifier: Apache-2.0
"""A robot behind a stream of positions: what is commanded when joint states come, cease, jump and come again."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_common.robot.servos import ServoModel
from openarm_common.types import Array
from openarm_control.arm import End, TrajectoryConfig, TrajectoryOutcome
from openarm_control.carrier import Carrier
from openarm_control.controller import RobotController
from openarm_control.gripper import GripperConfig, GripperGoal, GripperOutcome
from openarm_control.joints import JointReadout
from openarm_control.streamed import PERIOD_NS, StreamedRobot
from openarm_control.trajectory import JointGroup, Trajectory
from tests.refusals import refused

ARM = JointGroup(("j1",), np.array([-1.0]), np.array([1.0]), np.array([5.0]))
GRIPPER = JointGroup(("f1",), np.array([0.0]), np.array([0.044]), np.array([1.0]))
START = np.array([0.3, 0.02])


class Robot:
    """Joints that are where they were told, but for a finger that something stops."""

    def __init__(self) -> None:
        self.t_ns = 10**18
        self.at: Array = START.copy()
        self.commands: list[Array] = []
        self.known: Array | None = None
        self.known_ns = 2 * 10**18
        self.stop_at = 0.0
        self.silent = False
        self.refuses = ""

    def now_ns(self) -> int:
        return self.t_ns

    def take(self) -> JointReadout | None:
        return None if self.silent else JointReadout(self.t_ns, self.at.copy(), np.zeros(2), np.zeros(2))

    def fault(self) -> str:
        return self.refuses

    def targets(self, since_ns: int) -> Array:
        known = self.at if self.known is None else self.known
        return known if self.known_ns >= since_ns else np.full(2, np.nan)

    def send(self, targets: Array) -> None:
        self.commands.append(targets.copy())
        self.at = np.array([targets[0], max(targets[1], self.stop_at)])


class Bench:
    """The loop without its thread."""

    def __init__(self, arm: JointGroup = ARM) -> None:
        servos = ServoModel(np.array([50.0]), np.array([2.0]), np.zeros(1), np.zeros(1), np.zeros(1))
        config, effort = TrajectoryConfig(), {"right": np.inf}
        start = JointReadout(0, np.zeros(2), np.zeros(2), np.zeros(2))
        carriers = {"right": Carrier(servos, config.carrier)}
        self.controller = RobotController(
            {"right": arm}, {"right": GRIPPER}, ("j1", "f1"), start, effort, config, GripperConfig(), carriers
        )
        self.robot = Robot()
        self.loop = StreamedRobot(self.controller, self.robot, 0.2, lambda _: None)
        self.ends: list[TrajectoryOutcome] = []
        self._wall_ns = 0

    def ticks(self, n: int, each: Callable[[], None] = lambda: None) -> None:
        for _ in range(n):
            self.robot.t_ns += PERIOD_NS
            self._wall_ns += PERIOD_NS
            self.loop._tick(self._wall_ns)
            each()

    def go(self, q: float, seconds: float = 0.5) -> None:
        state = self.loop.read_joints(ARM)
        trajectory = Trajectory(ARM.names, np.array([0.0, seconds]), np.array([state.position, [q]]))
        follower = self.controller.arms["right"]
        follower.start(follower.check(trajectory), state.t_ns, state.position, self.ends.append)

    def sets_out(self, ticks: int, *, q: float = 0.9, seconds: float = 2.0) -> None:
        """Begin a motion, and be under way for some ticks."""
        self.ticks(2)
        self.go(q, seconds)
        self.ticks(ticks)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_without_a_joint_state_nothing_is_commanded_and_a_goal_is_refused(bench: Bench) -> None:
    bench.robot.silent = True
    bench.ticks(5)
    assert bench.robot.commands == []
    assert refused("no joint state yet", bench.loop.check_able).code is Code.NOT_READY


def test_an_encoder_that_starts_again_is_no_jump_and_commands_go_on() -> None:
    endless = JointGroup(("j1",), np.array([-np.inf]), np.array([np.inf]), np.array([5.0]))
    bench = Bench(endless)
    bench.robot.at = np.array([3.0, 0.02])

    def wrap() -> None:
        bench.robot.at[0] = (bench.robot.at[0] + np.pi) % (2.0 * np.pi) - np.pi

    bench.sets_out(0, q=3.4)
    bench.ticks(400, wrap)
    assert [one.end for one in bench.ends] == [End.SUCCEEDED]
    sent = np.array([command[0] for command in bench.robot.commands])
    assert sent[-1] == pytest.approx(3.4, abs=1e-3)
    assert np.abs(np.diff(sent)).max() < 0.05


def test_it_begins_where_the_robot_is(bench: Bench) -> None:
    bench.ticks(20)
    np.testing.assert_allclose(bench.robot.commands[-1], START)
    bench.loop.check_able()


def test_it_begins_with_the_targets_that_the_servos_have(bench: Bench) -> None:
    """An arm that hangs 0.1 rad below its target is not let go of, and a closed hand stays closed."""
    targets = START + np.array([0.1, -0.01])
    bench.robot.known = targets
    bench.ticks(1)
    np.testing.assert_allclose(bench.robot.commands[0], targets, atol=1e-6)
    bench.ticks(300)
    np.testing.assert_allclose(bench.robot.commands[-1], START + np.array([0.0, -0.01]), atol=1e-3)


def test_an_arm_that_is_put_elsewhere_waits_for_the_targets_that_its_servos_have_there(bench: Bench) -> None:
    """Those of the place that it was taken from would throw it back."""
    bench.ticks(2)
    bench.robot.known, bench.robot.known_ns = START, bench.robot.t_ns
    bench.robot.at = np.array([-0.7, 0.02])
    sent = len(bench.robot.commands)
    bench.ticks(5)
    assert len(bench.robot.commands) == sent
    refused("j1 jumped by", bench.loop.check_able)
    bench.robot.known, bench.robot.known_ns = np.array([-0.65, 0.02]), bench.robot.t_ns
    bench.ticks(200)
    begun = np.array([command[0] for command in bench.robot.commands[sent:]])
    assert begun[0] == pytest.approx(-0.65, abs=1e-6)
    assert begun[-1] == pytest.approx(-0.7, abs=1e-3)
    bench.loop.check_able()


def test_a_robot_that_says_nothing_of_its_targets_is_waited_for_a_tenth_of_a_second(bench: Bench) -> None:
    bench.robot.known_ns = 0
    bench.ticks(10)
    assert bench.robot.commands == []
    bench.ticks(1)
    np.testing.assert_allclose(bench.robot.commands[0], START)


def test_every_tick_of_a_motion_is_a_command(bench: Bench) -> None:
    bench.ticks(2)
    bench.go(0.6)
    before = len(bench.robot.commands)
    bench.ticks(60)
    assert [end.end for end in bench.ends] == [End.SUCCEEDED]
    moves = np.diff([command[0] for command in bench.robot.commands[before:]])
    assert len(moves) >= 48
    assert 0.0 < moves.max() < 0.012  # 0.3 rad in 0.5 s


def test_after_a_pause_of_the_process_a_motion_goes_on_where_it_was(bench: Bench) -> None:
    """Not where it would be by now: that would be a blow. It is in time again soon after."""
    bench.sets_out(30, seconds=1.0)
    bench.robot.t_ns += 8 * PERIOD_NS
    bench._wall_ns += 8 * PERIOD_NS
    before = len(bench.robot.commands)
    bench.ticks(70)
    moves = np.diff([command[0] for command in bench.robot.commands[before - 1 :]])
    assert moves.max() < 0.0076  # 6 mrad a tick, and a fifth more
    assert [end.end for end in bench.ends] == [End.SUCCEEDED]


@pytest.mark.requirement("P-23")
def test_joint_states_that_cease_end_the_goal_and_nothing_more_is_commanded(bench: Bench) -> None:
    bench.sets_out(50)
    bench.robot.silent = True
    bench.ticks(22)
    assert bench.ends[0].end is End.ABORTED
    assert "no joint state for 0.2" in bench.ends[0].text
    sent = len(bench.robot.commands)
    bench.ticks(50)
    assert len(bench.robot.commands) == sent
    bench.robot.silent = False
    bench.robot.at = bench.robot.at + np.array([0.05, 0.0])  # it has sunk meanwhile
    bench.ticks(2)
    np.testing.assert_allclose(bench.robot.commands[-1], bench.robot.at)


def test_an_arm_that_is_put_elsewhere_is_held_there(bench: Bench) -> None:
    bench.sets_out(10)
    bench.robot.at = np.array([-0.7, 0.02])
    bench.ticks(1)
    assert "j1 jumped by" in bench.ends[0].text
    assert bench.robot.commands[-1][0] == pytest.approx(-0.7)
    bench.loop.check_able()


@pytest.mark.requirement("P-22")
@pytest.mark.parametrize("width", [0.0, 0.012])
def test_a_hand_is_closed_on_something_when_its_fingers_stop_before_the_end(bench: Bench, width: float) -> None:
    """Where the driver says nothing of velocity and effort, and reports success whatever the fingers met."""
    bench.ticks(2)
    bench.robot.stop_at = width
    ends: list[GripperOutcome] = []
    bench.controller.grippers["right"].start(GripperGoal(0.0), 0.02, 0.0, ends.append)
    bench.ticks(100)
    assert [(end.end, end.stalled, end.reached_goal) for end in ends] == [(End.SUCCEEDED, width > 0.0, width == 0.0)]
    assert ends[0].position == pytest.approx(width)
    assert bench.controller.grippers["right"].pressing == (width > 0.0)


def test_a_robot_that_takes_no_commands_says_why_and_begins_where_it_is_then(bench: Bench) -> None:
    bench.sets_out(50)
    bench.robot.refuses = "the arm one_3 sinks"
    before = len(bench.robot.commands)
    bench.ticks(20)
    assert bench.ends[0].text == "the arm one_3 sinks"
    assert len(bench.robot.commands) == before
    refused("one_3 sinks", bench.loop.check_able)
    bench.robot.refuses, bench.robot.at = "", np.array([-0.2, 0.02])
    bench.ticks(20)
    assert bench.robot.commands[-1][0] == pytest.approx(-0.2, abs=0.01)


def test_the_emergency_stop_holds_the_command(bench: Bench) -> None:
    bench.sets_out(50)
    bench.loop.stop_motion()
    held = bench.robot.commands[-1].copy()
    bench.ticks(50)
    assert bench.ends[0].end is End.ABORTED
    np.testing.assert_allclose(bench.robot.commands[-1], held, atol=0.03)
    refused("emergency stop", bench.loop.check_able)
