# SPDX-License-Identifier: Apache-2.0
"""The physics thread and the controller on a small model: pace, pause, steps, faults, commands."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.servos import ServoModel
from openarm_control.arm import End, TrajectoryConfig, TrajectoryOutcome
from openarm_control.carrier import Carrier
from openarm_control.controller import RobotController
from openarm_control.gripper import GripperConfig
from openarm_control.joints import JointReadout
from openarm_control.trajectory import JointGroup, Trajectory
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.simulation import Simulation
from openarm_sim_bridge.world.world import World
from tests.conftest import DEADLINE_S
from tests.refusals import refused, refuses

MODEL = """
<mujoco><compiler angle="radian"/><option timestep="0.002" gravity="0 0 0" integrator="implicitfast"/><worldbody>
<body name="arm"><joint name="j1" axis="0 1 0" damping="1" armature=".05"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
<body name="tip" pos=".3 0 0"><joint name="f1" type="slide" axis="0 1 0" range="0 .044" limited="true"/>
<geom type="box" size=".01 .01 .01"/></body></body></worldbody>
<actuator><position name="f1" joint="f1" kp="2000" kv="40" forcerange="-30 30" ctrlrange="0 .044"/>
<position name="j1" joint="j1" kp="200" kv="3" forcerange="-40 40"/></actuator></mujoco>"""
ARM = JointGroup(("j1",), np.array([-1.0]), np.array([1.0]), np.array([5.0]))
GRIPPER = JointGroup(("f1",), np.array([0.0]), np.array([0.044]), np.array([1.0]))


def make_controller() -> tuple[World, RobotController]:
    world = World(mujoco.MjSpec.from_string(MODEL), joint_names=("j1", "f1"), home={"f1": 0.01})
    return world, controllers_of(world, TrajectoryConfig(), GripperConfig())


def tick(world: World, controller: RobotController, n: int = 1) -> None:
    for _ in range(n):
        world.set_targets(controller.update(world.read_joints(), world.period_ns))
        world.step(world.steps_per_tick)


def controllers_of(
    world: World, config: TrajectoryConfig, gripper: GripperConfig, arm: JointGroup = ARM
) -> RobotController:
    servos = ServoModel(np.array([200.0]), np.array([4.0]), np.zeros(1), np.zeros(1), np.zeros(1))
    carriers = {"right": Carrier(servos, config.carrier)}
    state, effort = world.read_joints(), {"right": 30.0}
    return RobotController(
        {"right": arm}, {"right": GRIPPER}, world.joint_names, state, effort, config, gripper, carriers
    )


class Bench:
    """A simulation and the states that it published."""

    def __init__(self, speed: float = 1.0) -> None:
        self.world, self.controller = make_controller()
        self.states: list[tuple[float, JointReadout]] = []
        self._changed = threading.Condition()
        robot = SimulatedRobot(RobotDescription.load(), self.world, self.controller)
        self.simulation = Simulation(robot, self._observe, speed=speed)

    def do(self, work: Callable[[], object]) -> Any:
        """What a call in the thread of the physics returns."""
        return self.simulation.call(work).result(DEADLINE_S)

    def _observe(self, state: JointReadout) -> None:
        with self._changed:
            self.states.append((time.monotonic(), state))
            self._changed.notify_all()

    def wait(self, condition: Callable[[], object]) -> None:
        with self._changed:
            assert self._changed.wait_for(condition, DEADLINE_S), "not in time"

    @property
    def t_ns(self) -> int:
        return self.states[-1][1].t_ns if self.states else 0


class Clocked:
    """A simulation that is turned by hand, on a clock that goes on while it waits and by 0.5 ms in a turn."""

    def __init__(self, speed: float = 1.0) -> None:
        self.now_ns = 0
        self.world, controller = make_controller()
        #: When, s, and what.
        self.states: list[tuple[float, JointReadout]] = []
        robot = SimulatedRobot(RobotDescription.load(), self.world, controller)
        self.simulation = Simulation(robot, self._observe, speed=speed, clock=lambda: self.now_ns)

    def _observe(self, state: JointReadout) -> None:
        self.states.append((self.now_ns * 1e-9, state))

    def run(self, seconds: float) -> None:
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < end_ns:
            self.now_ns += max(round(self.simulation._turn() * 1e9), 500_000)


def keeps_pace(simulation: Simulation, share: float, ms: float) -> None:
    """The world is as fast as the clock and its ticks take 10 ms, within these bounds."""
    assert simulation.real_time_factor.value == pytest.approx(1.0, abs=share)
    figures = simulation.periods.figures()
    assert figures.n > 150
    assert figures.p50_ms == pytest.approx(10.0, abs=ms)


def test_a_hinge_without_limits_turns_on_and_commands_of_any_turn_take_the_short_way() -> None:
    world, _ = make_controller()
    endless = JointGroup(("j1",), np.array([-np.inf]), np.array([np.inf]), np.array([5.0]))
    controller = controllers_of(world, TrajectoryConfig(), GripperConfig(), endless)
    follower, ends = controller.arms["right"], list[TrajectoryOutcome]()
    for points, seconds, end in (([0.0, 13.0], 6.0, 13.0), ([13.0 - 4.0 * np.pi, 0.0], 1.0, 4.0 * np.pi)):
        given = Trajectory(("j1",), np.array([0.0, seconds]), np.array([points]).T, np.zeros((2, 1)))
        state = world.read_joints()
        follower.start(follower.check(given), state.t_ns, state.position[:1], ends.append)
        tick(world, controller, round(seconds * 100) + 150)
        assert world.read_joints().position[0] == pytest.approx(end, abs=0.01)
    assert [one.end for one in ends] == [End.SUCCEEDED] * 2
    for _ in range(20):
        controller.command(controller.check_command(["j1"], [3.3]))
        tick(world, controller, 20)
    assert world.read_joints().position[0] == pytest.approx(2.0 * np.pi + 3.3, abs=0.01)


@pytest.mark.requirement("A-18", "A-19")
def test_ticks_of_ten_milliseconds_keep_pace_with_the_clock() -> None:
    bench = Clocked()
    bench.run(2.0)
    assert set(np.diff([state.t_ns for _, state in bench.states])) == {10_000_000}
    np.testing.assert_allclose(np.diff([now for now, _ in bench.states]), 0.01, atol=0.001)
    assert bench.world.t_ns == pytest.approx(2e9, abs=2e7)
    keeps_pace(bench.simulation, 0.01, 0.5)


@pytest.mark.parametrize("speed", [5.0, 1.5, 0.0])
@pytest.mark.requirement("A-20")
def test_a_faster_world_is_still_published_at_a_hundred_hertz(speed: float) -> None:
    bench = Clocked(speed)
    bench.run(2.0)
    assert len(bench.states) == pytest.approx(200, abs=4)
    ratio = bench.world.t_ns * 1e-9 / 2.0
    assert ratio > 6.0 if speed == 0.0 else ratio == pytest.approx(speed, rel=0.02)


@pytest.mark.requirement("P-25")
def test_a_pause_is_not_made_up() -> None:
    bench = Clocked()
    bench.run(1.0)
    for paused in (True, False):
        bench.simulation.set_paused(paused)
        before_ns = bench.world.t_ns
        bench.run(1.0)
        assert bench.world.t_ns - before_ns == pytest.approx(0.0 if paused else 1e9, abs=2e7)


@pytest.mark.parametrize("halt_ms", [60, 150, 300, 450, 2000])
def test_stamps_of_the_wall_clock_never_go_back_after_a_halt(monkeypatch: pytest.MonkeyPatch, halt_ms: int) -> None:
    now, since = [0], 10**18
    monkeypatch.setattr("openarm_sim_bridge.simulation.time.time_ns", lambda: since + now[0])
    world, controller = make_controller()
    world.shift_time(since)
    states: list[JointReadout] = []
    robot = SimulatedRobot(RobotDescription.load(), world, controller)
    simulation = Simulation(robot, states.append, wall_stamps=True, clock=lambda: now[0])
    for turn in range(300):
        now[0] += max(round(simulation._turn() * 1e9), 100_000)
        if turn == 100:
            now[0] += halt_ms * 1_000_000
    assert np.diff([state.t_ns for state in states]).min() > 0
    assert abs(since + now[0] - states[-1].t_ns) < 100_000_000


@pytest.fixture
def bench() -> Iterator[Bench]:
    out = Bench()
    out.simulation.start()
    yield out
    out.simulation.stop()


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.requirement("A-18", "A-19")
def test_ticks_keep_pace_with_the_wall_clock(bench: Bench) -> None:
    bench.wait(lambda: len(bench.states) > 200)
    (wall_0, first), (wall_1, last) = bench.states[50], bench.states[200]
    assert last.t_ns - first.t_ns == 1_500_000_000
    assert wall_1 - wall_0 == pytest.approx(1.5, rel=0.02)
    keeps_pace(bench.simulation, 0.05, 1.0)
    # A window of two seconds: that the machine halts once is not the simulation's.
    bench.wait(lambda: p99(bench.states[-200:]) < 0.015)


def p99(states: list[tuple[float, JointReadout]]) -> float:
    """Of the time from state to state, s."""
    return float(np.percentile(np.diff([wall for wall, _ in states]), 99))


@pytest.mark.requirement("P-25")
def test_a_paused_world_stands_shows_life_and_steps(bench: Bench) -> None:
    bench.wait(lambda: len(bench.states) > 5)
    bench.do(lambda: bench.simulation.set_paused(True))
    t_ns, n = bench.world.t_ns, len(bench.states)
    bench.wait(lambda: len(bench.states) > n + 2)
    assert bench.t_ns == t_ns
    stepping = bench.do(lambda: bench.simulation.advance(13))
    assert stepping.result(DEADLINE_S) == t_ns + 13 * 2_000_000
    bench.wait(lambda: bench.t_ns == t_ns + 26_000_000)
    bench.do(lambda: bench.simulation.set_paused(False))
    bench.wait(lambda: bench.t_ns > t_ns + 500_000_000)


def test_steps_that_are_left_when_time_goes_on_are_not_said_to_be_done(bench: Bench) -> None:
    bench.wait(lambda: bench.states)
    bench.do(lambda: bench.simulation.set_paused(True))
    stepping = bench.do(lambda: bench.simulation.advance(10_000_000))
    bench.do(lambda: bench.simulation.set_paused(False))
    assert refused("stepping ended early", stepping.result, DEADLINE_S).code is Code.CANCELLED


def test_steps_are_refused_where_they_make_no_sense(bench: Bench) -> None:
    for steps, code in ((5, Code.NOT_READY), (0, Code.INVALID_ARGUMENT)):
        assert refused(None, bench.do, lambda n=steps: bench.simulation.advance(n)).code is code


def test_an_error_in_a_call_reaches_the_caller_and_not_the_thread(bench: Bench) -> None:
    def fail() -> None:
        raise ValueError("wrong")

    with pytest.raises(ValueError, match="wrong"):
        bench.do(fail)
    n = len(bench.states)
    bench.wait(lambda: len(bench.states) > n + 3)


def test_a_diverged_world_stands_until_it_is_reset(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning to a file there
    bench.simulation._dump_folder = tmp_path
    bench.wait(lambda: len(bench.states) > 30)
    outcomes: list[TrajectoryOutcome] = []
    arm, state = bench.controller.arms["right"], bench.states[-1][1]
    goal = arm.check(Trajectory(("j1",), np.array([5.0]), np.array([[0.6]])))
    bench.do(lambda: arm.start(goal, bench.world.t_ns, state.position[:1], outcomes.append))
    bench.simulation.check_able()

    def diverge() -> None:
        bench.do(lambda: bench.world.data.qvel.fill(np.nan))
        deadline = time.monotonic() + DEADLINE_S
        while not bench.simulation.fault:
            assert time.monotonic() < deadline
            bench.do(lambda: None)
        assert "diverged" in bench.simulation.fault
        bench.do(lambda: None)  # the tick has ended

    diverge()
    assert outcomes[0].end is End.ABORTED
    assert "diverged" in outcomes[0].text
    with refuses(Code.NOT_READY, r"no command is taken: the physics diverged.*Reset the world"):
        bench.simulation.check_able()
    (dump,) = tmp_path.glob("openarm_diverged_*.npz")
    assert dump.stat().st_mode & 0o777 == 0o600
    assert str(dump) in bench.simulation.fault
    with np.load(dump) as data:
        assert data["joint_names"].tolist() == ["j1", "f1"]
        assert len(data["t_ns"]) == len(data["position"]) == len(data["target"]) > 30
        assert np.all(np.diff(data["t_ns"]) == 10_000_000)

    bench.do(lambda: bench.simulation.restart(bench.world.reset))
    t_ns = bench.world.t_ns
    bench.wait(lambda: bench.t_ns > t_ns + 50_000_000)
    assert np.all(np.isfinite(bench.states[-1][1].position))

    diverge()
    (second,) = set(tmp_path.glob("openarm_diverged_*.npz")) - {dump}
    assert str(second) in bench.simulation.fault


def test_stop_ends_the_thread_and_cancels_what_waits() -> None:
    bench = Bench()
    bench.simulation.start()
    bench.wait(lambda: bench.states)
    bench.simulation.stop()
    n = len(bench.states)
    left = bench.simulation.call(lambda: 1)
    bench.simulation.stop()
    assert left.cancelled()
    assert len(bench.states) == n
    assert "physics" not in [thread.name for thread in threading.enumerate()]


# --- the controller alone
@pytest.mark.requirement("A-23")
def test_commands_may_be_partial_permuted_and_hold_unknown_names() -> None:
    _, controller = make_controller()
    command = controller.check_command(["f1", "tail", "j1"], [0.02, 1.0, 0.3])
    assert dict(command.positions) == {"f1": 0.02, "j1": 0.3}
    assert command.unknown == ("tail",)
    assert controller.check_command(["j1"], [0.1]).unknown == ()


@pytest.mark.parametrize(
    ("names", "positions", "code", "message"),
    [
        (["j1"], [2.0], Code.LIMITS, r"position of j1 is 2\.0000, out of its limits -1\.0000 to 1\.0000"),
        (["j1"], [float("nan")], Code.INVALID_ARGUMENT, "position of j1 is nan"),
        (["j1", "f1"], [0.1], Code.INVALID_ARGUMENT, "2 names and 1 positions"),
    ],
)
def test_bad_commands_are_refused_with_joint_and_value(
    names: list[str], positions: list[float], code: Code, message: str
) -> None:
    _, controller = make_controller()
    assert refused(message, controller.check_command, names, positions).code is code


def test_commands_for_a_joint_that_follows_a_goal_are_reported() -> None:
    world, controller = make_controller()
    arm = controller.arms["right"]
    goal = arm.check(Trajectory(("j1",), np.array([0.5]), np.array([[0.6]])))
    arm.start(goal, world.t_ns, np.zeros(1), lambda _o: None)
    command = controller.check_command(["f1", "j1"], [0.02, -0.3])
    assert controller.busy(command) == ("j1",)
    controller.command(command)
    tick(world, controller, 150)
    np.testing.assert_allclose(world.read_joints().position, [0.6, 0.02], atol=0.01)


@pytest.mark.requirement("P-23")
def test_stale_commands_hold() -> None:
    """Commands that cease leave the arm at rest soon after half a second, short of its target; a stream arrives."""
    world = World(mujoco.MjSpec.from_string(MODEL), joint_names=("j1", "f1"), home={"f1": 0.01})
    config = TrajectoryConfig(command_velocity=0.5)
    controller = controllers_of(world, config, GripperConfig(velocity=0.02))

    def run(seconds: float, again: bool) -> list[float]:
        out: list[float] = []
        for i in range(round(seconds * 100)):
            if i == 0 or (again and i % 20 == 0):
                controller.command(controller.check_command(["j1", "f1"], [0.9, 0.04]))
            tick(world, controller)
            out.append(float(world.read_joints().position[0]))
        return out

    way = run(1.5, again=False)
    assert 0.15 < way[-1] < 0.35
    assert max(way) < way[-1] + 0.01  # no way back
    assert np.ptp(way[-40:]) < 1e-3
    assert 0.015 < world.read_joints().position[1] < 0.03  # the gripper too
    np.testing.assert_allclose([run(3.0, again=True)[-1], world.read_joints().position[1]], [0.9, 0.04], atol=0.01)


@pytest.mark.requirement("P-23")
def test_a_trajectory_needs_no_stream() -> None:
    world, controller = make_controller()
    controller.command(controller.check_command(["j1"], [0.1]))
    arm = controller.arms["right"]
    arm.start(arm.check(Trajectory(("j1",), np.array([1.5]), np.array([[0.6]]))), 0, np.zeros(1), lambda _o: None)
    tick(world, controller, 180)
    assert world.read_joints().position[0] == pytest.approx(0.6, abs=0.01)


def test_targets_stand_in_the_order_of_the_world_and_reset_holds() -> None:
    world, controller = make_controller()
    targets = controller.update(world.read_joints(), world.period_ns)
    np.testing.assert_allclose(targets, [0.0, 0.01])
    controller.command(controller.check_command(["f1"], [0.04]))
    for _ in range(100):
        controller.update(world.read_joints(), world.period_ns)
    world.reset()
    controller.reset(world.read_joints())
    np.testing.assert_allclose(controller.update(world.read_joints(), world.period_ns), [0.0, 0.01])
    assert controller.effort_limits().tolist() == [math.inf, 30.0]


def test_a_fault_of_the_program_in_the_thread_is_reported() -> None:
    world, controller = make_controller()
    errors: queue.Queue[Exception] = queue.Queue()

    def observe(_state: JointReadout) -> None:
        raise ZeroDivisionError("a fault")

    simulation = Simulation(SimulatedRobot(RobotDescription.load(), world, controller), observe, crashed=errors.put)
    simulation.start()
    assert isinstance(errors.get(timeout=DEADLINE_S), ZeroDivisionError)
    simulation.stop()
    assert "a fault" in simulation.fault
