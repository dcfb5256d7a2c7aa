# SPDX-License-Identifier: Apache-2.0
"""Carrying arms by position commands: the weight, the lag, what is corrected, and how strongly it may be."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from openarm_common.robot.description import RobotDescription
from openarm_common.robot.servos import ServoModel
from openarm_common.scene.scene import load_scene
from openarm_control.arm import TrajectoryConfig, TrajectoryOutcome
from openarm_control.carrier import Carrier, CarrierConfig
from openarm_control.gripper import GripperFollower
from openarm_control.loop_gains import LoopGains, safe_gains
from openarm_control.trajectory import Trajectory, TrajectoryResult
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.world.hardware import HardwareConfig
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage

OFF = CarrierConfig(weight=False, lag=False, correction=0.0, settle=False)
ARM = slice(8, 15)


class Bench:
    """The right arm of a drawn robot, sent from home to a posture that reaches out, and back."""

    def __init__(self, carrier: CarrierConfig, hardware: HardwareConfig) -> None:
        self.description = RobotDescription.load()
        self.stage = Stage(self.description, {}, None, PhysicsConfig(), hardware)
        self.robot = SimulatedRobot.on(self.stage, load_scene("empty"), TrajectoryConfig(carrier=carrier))
        self.follower = self.robot.controller.arms["right"]
        self.peak = 0.0

    def tick(self, n: int) -> None:
        for _ in range(n):
            self.robot.tick()

    def go(self, offset: float, near: float = -1.0) -> TrajectoryOutcome:
        q = self.follower.state.desired if self.follower.state else self.robot.state.position[ARM]
        points = np.stack([q, q + offset * np.array([0.3, 0.4, -0.3, 0.5, 0.3, 0.2, -0.3])])
        loose, goal = (dict.fromkeys(self.follower.group.names, x) for x in (-1.0, near))
        goal = Trajectory(
            self.follower.group.names, np.array([0.0, 0.8]), points, np.zeros((2, 7)), np.zeros((2, 7)), 0, loose, goal
        )
        ends: list[TrajectoryOutcome] = []
        self.follower.start(self.follower.check(goal), self.robot.world.t_ns, q, ends.append)
        while not ends:
            self.robot.tick()
            state = self.follower.state
            assert state is not None
            self.peak = max(self.peak, float(np.abs(state.desired - state.actual).max()))
        return ends[0]

    def error(self) -> float:
        """How far the tool is from where the joints of the reference have it, m."""
        state = self.follower.state
        assert state is not None
        link = self.description.tcp_link("right")
        reference, actual = (
            self.description.link_pose(link, dict(zip(self.follower.group.names, q.tolist(), strict=True)))[:3, 3]
            for q in (state.desired, state.actual)
        )
        return float(np.linalg.norm(reference - actual))


@pytest.mark.requirement("R-02")
@pytest.mark.parametrize("seed", [11, *(pytest.param(k, marks=pytest.mark.long) for k in (12, 13))])
def test_a_heavy_soft_late_arm_goes_where_it_should(seed: int) -> None:
    hardware = HardwareConfig().of_seed(seed)
    limp, carried = Bench(OFF, hardware), Bench(CarrierConfig(), hardware)
    for bench in (limp, carried):
        bench.tick(50)
        for offset in (1.0, -1.0):
            bench.go(offset)
            bench.tick(30)
    assert limp.error() > 0.015
    assert limp.peak > 0.1
    assert carried.error() < 0.002
    assert carried.peak < 0.03


@pytest.mark.requirement("R-02")
@pytest.mark.parametrize(
    ("mass", "seed"), [(0.35, 15), *(pytest.param(*of, marks=pytest.mark.long) for of in ((0.1, 14), (0.6, 16)))]
)
def test_what_a_closed_hand_holds_is_weighed_and_carried(
    mass: float, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(CarrierConfig(), HardwareConfig().of_seed(seed))
    bench.tick(50)
    model, carrier = bench.robot.world.model, bench.follower.carrier
    model.body_mass[model.body(bench.description.tcp_link("right")).id] += mass
    bench.tick(50)
    assert carrier.payload == 0.0  # of an open hand, and none that was closed has come to rest
    held = property(lambda _: True, lambda _, value: None)
    monkeypatch.setattr(GripperFollower, "pressing", held, raising=False)
    for offset in (1.0, -0.5, 0.5):
        bench.go(offset)
    assert carrier.payload == pytest.approx(mass, abs=0.2)  # links are 5 % heavier or lighter, and joints stick
    bench.peak = 0.0
    bench.go(-0.5)
    bench.tick(30)
    assert bench.peak < 0.03
    assert bench.error() < 0.002
    monkeypatch.undo()
    bench.tick(2)
    assert carrier.payload == 0.0


@pytest.mark.parametrize("latency", [0.0, 0.05])
def test_nothing_swings_however_late_commands_are(latency: float) -> None:
    """After a push, the joints come to rest, whatever the latency that is known of."""
    bench = Bench(CarrierConfig(), HardwareConfig(latency=(latency, latency), friction=(0.01, 0.02)))
    bench.tick(100)
    dof = [bench.robot.world.model.joint(name).dofadr[0] for name in bench.follower.group.names]
    for _ in range(10):
        bench.robot.world.data.qfrc_applied[dof] = 3.0, 3.0, 2.0, 2.0, 0.5, 0.5, 0.5
        bench.tick(1)
    bench.robot.world.data.qfrc_applied[dof] = 0.0
    bench.tick(300)
    assert np.abs(bench.robot.world.data.qvel[dof]).max() < 0.02


def test_an_arm_that_is_switched_on_does_not_fall() -> None:
    bench = Bench(CarrierConfig(), HardwareConfig())
    start = bench.robot.world.read_joints().position[ARM]
    worst = 0.0
    for _ in range(50):
        bench.tick(1)
        worst = max(worst, float(np.abs(bench.robot.world.read_joints().position[ARM] - start).max()))
    assert worst < 0.02


def test_the_emergency_stop_does_not_let_the_arm_fall() -> None:
    bench = Bench(CarrierConfig(), HardwareConfig())
    bench.tick(30)
    bench.go(1.0)
    bench.robot.controller.stop("stop")
    before = bench.robot.world.read_joints().position[ARM]
    bench.tick(100)
    assert np.abs(bench.robot.world.read_joints().position[ARM] - before).max() < 0.01


def test_what_presses_on_a_surface_is_not_pressed_harder_and_harder() -> None:
    """A hand that is held back by a force keeps its target after the time to settle."""
    bench = Bench(CarrierConfig(), HardwareConfig())
    bench.tick(30)
    dof = [bench.robot.world.model.joint(name).dofadr[0] for name in bench.follower.group.names]
    bench.robot.world.data.qfrc_applied[dof[3]] = -4.0
    assert bench.go(1.0).result is TrajectoryResult.SUCCESSFUL
    before = bench.robot.targets[ARM].copy()
    bench.tick(200)
    assert np.abs(bench.robot.targets[ARM] - before).max() < 0.02


def test_what_is_left_within_a_tolerance_of_the_goal_is_not_worked_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """The motion ends sooner then, as near as the goal asks, and what the hand holds is weighed all the same."""
    held = property(lambda _: True, lambda _, value: None)
    monkeypatch.setattr(GripperFollower, "pressing", held, raising=False)
    took: list[float] = []
    for near in (0.0, 0.02):
        bench = Bench(CarrierConfig(), HardwareConfig().of_seed(15))
        bench.tick(50)
        model = bench.robot.world.model
        model.body_mass[model.body(bench.description.tcp_link("right")).id] += 0.35
        begin_ns = bench.robot.world.t_ns
        assert bench.go(1.0, near).result is TrajectoryResult.SUCCESSFUL
        took.append((bench.robot.world.t_ns - begin_ns) * 1e-9)
        assert bench.follower.carrier.payload == pytest.approx(0.45, abs=0.15)
        assert bench.follower.state is not None
        assert np.abs(bench.follower.state.desired - bench.follower.state.actual).max() <= 0.02
        bench.go(-1.0)
        assert bench.error() < 0.005
    assert took[1] < 0.9
    assert took[0] > took[1] + 0.2


def test_gains_fall_with_the_latency_and_with_the_inertia() -> None:
    stiffness, damping = np.array([70.0, 10.0]), np.array([3.75, 1.6])
    light, heavy = np.array([[0.1, 0.01]]), np.array([[0.6, 0.05]])
    delays = [np.full(2, delay) for delay in (0.015, 0.025, 0.04, 0.065)]
    found = [safe_gains(stiffness, damping, light, delay) for delay in delays]
    for nearer, later in itertools.pairwise(found):
        assert np.all(later.proportional < nearer.proportional)
    assert np.all(safe_gains(stiffness, damping, heavy, delays[0]).proportional < found[0].proportional)
    assert np.all(found[0].integral > 0.0)


def test_what_adds_up_at_rest_has_a_limit() -> None:
    one, nothing = np.ones(1), np.zeros(1)
    carrier = Carrier(
        ServoModel(one, nothing, nothing, nothing, nothing, weight=1.0),
        CarrierConfig(settle_limit=0.05),
        gains=LoopGains(nothing, nothing, one),
    )
    for error, most in ((0.3, 0.05), (-0.3, -0.05)):
        for _ in range(100):
            carrier.settle(np.array([error]), 0.1)
        assert carrier.target(nothing, nothing, nothing, nothing, 0.01) == pytest.approx(most)
