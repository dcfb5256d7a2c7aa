# SPDX-License-Identifier: Apache-2.0
"""From targets of the controllers to commands of the motors, and what is kept from run to run."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from openarm_common.collision.self_collision import SelfCollision
from openarm_common.errors import OpenArmError
from openarm_common.motors.bus import emulated_buses
from openarm_common.motors.wiring import axes_of, load_wiring
from openarm_common.resources import models_dir
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_names
from openarm_common.types import Array
from openarm_control.arm import TrajectoryConfig
from openarm_control.controller import RobotController
from openarm_control.gripper import GripperConfig
from openarm_control.joints import JointReadout, arm_groups, arm_loads, carriers, gripper_groups, joint_names
from openarm_control.servos import ServoConfig
from openarm_hardware.arm import Phase
from openarm_hardware.driver import MotorDriver
from openarm_hardware.exchange import MotorState, State
from openarm_hardware.loop import MotorRobot
from openarm_hardware.posture import LastPosture
from openarm_hardware.touch import KEEP, TouchGuard

#: Robots whose folder says where their motors are.
WIRED = [name for name in robot_names() if (models_dir() / "robots" / name / "hardware.yaml").is_file()]
FOLLOWS = (Phase.FOLLOWING, Phase.FOLLOWING)


class Servo:
    """What the driver needs of a servo process."""

    def __init__(self, description: RobotDescription) -> None:
        self.axes = axes_of(load_wiring(), description, emulated_buses(0, description.arm_names))
        self.alive = True
        self.told: list[str] = []
        self.commands: list[list[tuple[float, float]]] = []
        self.q = np.array([0.5 * (axis.lower + axis.upper) for axis in self.axes])
        self.commanded = self.q + 0.01
        self.phases: tuple[int, ...] = FOLLOWS
        self.text = ""
        self.turns = np.zeros(len(self.axes))
        self.cycles = 0

    def state(self) -> State:
        self.cycles += 1
        rows = zip(self.q.tolist(), self.commanded.tolist(), self.turns.tolist(), strict=True)
        motors = tuple(MotorState(q, 0.1, 0.5, c, 0.2, 1, 40, 41, 0, turn) for q, c, turn in rows)
        return State(time.monotonic_ns(), self.cycles, 0, self.phases, 0, self.text, motors)

    def command(self, joints: list[tuple[float, float]]) -> None:
        self.commands.append(joints)

    def stop(self, why: str = "") -> None:
        self.told.append(f"stop {why}".strip())

    def reset(self) -> None:
        self.told.append("reset")


class Bench:
    def __init__(self) -> None:
        self.description = description = RobotDescription.load()
        names, self.loads = joint_names(description), arm_loads(description)
        servos = {side: ServoConfig().model(description, load) for side, load in self.loads.items()}
        config = TrajectoryConfig()
        self.controller = RobotController(
            arm_groups(description),
            gripper_groups(description),
            names,
            JointReadout(0, *np.zeros((3, len(names)))),
            dict.fromkeys(description.arm_names, 30.0),
            config,
            GripperConfig(),
            carriers(description, config.carrier, servos),
        )
        self.servo: Any = Servo(description)
        self.published: list[JointReadout] = []
        guard = TouchGuard(SelfCollision(description, names))
        self.driver = MotorDriver(self.servo, self.controller, self.loads, guard, self.published.append)
        self.robot = MotorRobot(self.controller, self.driver, 5.0, lambda _: None)
        self.kp = np.array([axis.kp for axis in self.servo.axes])
        self.arms = self.kp > 0.0

    def carried(self, q: Array) -> Array:
        """Return what the servo commands when the targets are `q`: the weight is carried by torque."""
        weight = np.zeros(len(q))
        at = 0
        for load in self.loads.values():
            weight[at : at + 7] = load.torque(self.servo.q[at : at + 7], np.zeros(7), np.zeros(7))
            at += 8
        return q - np.where(self.arms, weight / np.where(self.arms, self.kp, 1.0), 0.0)


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.mark.parametrize("robot", WIRED)
def test_the_folder_of_a_robot_says_where_its_motors_are(robot: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENARM_ROBOT", robot)
    description = RobotDescription.load(robot)
    axes = axes_of(load_wiring(), description)
    assert tuple(axis.joint for axis in axes) == joint_names(description)
    assert len({(axis.bus, axis.id) for axis in axes}) == len(axes)
    for axis in axes:
        for q in (axis.lower, axis.upper):
            assert abs(q * axis.ratio + axis.offset) < 12.5
    for hand in description.hands.values():
        axis = next(axis for axis in axes if axis.joint == hand.joint)
        turned = (hand.opened - hand.closed) * axis.ratio
        assert 0.1 < abs(turned) < 2.0
        assert np.sign(turned) == np.sign(load_wiring().gripper.ratio)  # motors of both hands open alike


def test_motors_pull_as_the_target_says_and_carry_the_weight_by_torque(bench: Bench) -> None:
    driver, servo = bench.driver, bench.servo
    readout = driver.take()
    assert readout is not None
    assert readout is bench.published[0]
    assert driver.fault() == ""
    targets = servo.q + np.linspace(-0.09, 0.09, len(servo.q))
    servo.commanded = bench.carried(servo.q)
    driver.take()
    driver.send(targets)
    command = np.array(servo.commands[-1])
    pull = bench.kp * (command[:, 0] - servo.q) + command[:, 1]
    assert pull[bench.arms] == pytest.approx((bench.kp * (targets - servo.q))[bench.arms])
    weights = np.concatenate(
        [
            load.torque(servo.q[8 * i : 8 * i + 7], np.zeros(7), np.zeros(7))
            for i, load in enumerate(bench.loads.values())
        ]
    )
    assert command[bench.arms, 1] == pytest.approx(weights)
    assert command[~bench.arms] == pytest.approx(np.stack([targets[~bench.arms], [30.0, 30.0]], axis=1), rel=0.2)
    servo.commanded = command[:, 0]
    driver.take()
    known = driver.targets(0)
    expected = np.where(bench.arms, servo.commanded + 0.2 / np.where(bench.arms, bench.kp, 1.0), servo.commanded)
    assert known == pytest.approx(expected)


def test_a_step_of_the_controllers_is_spread_over_commands_that_the_servo_takes(bench: Bench) -> None:
    """It reads the newest command alone: what it left out on a busy machine must not add up to a jump."""
    servo, arms = bench.servo, bench.arms
    bench.driver.take()
    servo.commanded = bench.carried(servo.q)
    bench.driver.take()
    start = servo.commanded
    aimed = servo.q + np.where(arms, 0.35, 0.0)
    for taken in (0.1, 0.2, 0.3, 0.35, 0.35):
        for _ in range(3):
            bench.driver.send(aimed)
        command = np.array(servo.commands[-1])[:, 0]
        assert (command - start)[arms] == pytest.approx(taken)
        servo.commanded = command
        bench.driver.take()


@pytest.mark.requirement("R-08")
def test_a_command_that_would_let_the_arms_touch_stops_them_and_names_the_links(bench: Bench) -> None:
    robot, names, servo = bench.description, bench.controller.joint_names, bench.servo
    checks = SelfCollision(robot, names)
    apart = {n: q for arm in robot.arm_names for n, q in robot.group_state(f"{arm}_arm", "home").items()}
    servo.q = np.array([apart.get(name, 0.0) for name in names])

    def here() -> None:
        bench.driver.take()
        bench.controller.reset(bench.published[-1])

    here()
    bench.driver.send(servo.q)
    assert not servo.told
    low, high = robot.limits(names)
    touching = next(
        q
        for q in np.random.default_rng(0).uniform(low, high, (200, len(names)))
        if checks.nearest(checks.distances(q)).distance < -0.01
    )
    lengths = [checks.nearest(checks.distances(servo.q + x * (touching - servo.q))) for x in np.linspace(0, 1, 400)]
    nearest = next(n for n in lengths if n.distance < KEEP - 0.0005)
    start = servo.q.copy()
    for share in np.linspace(0.0, 1.0, 400):  # arms that follow at once
        servo.q = start + share * (touching - start)
        here()
        bench.driver.send(servo.q)
        if servo.told:
            break
    (told,) = servo.told
    assert {nearest.first, nearest.second} <= set(told.split())
    commands = len(servo.commands)
    bench.driver.send(servo.q)
    assert len(servo.commands) == commands, "nothing is commanded any more"


def test_arms_that_do_not_follow_are_told_to_stay(bench: Bench) -> None:
    servo = bench.servo
    servo.phases, servo.text = (Phase.SETTING, Phase.HELD), "two: the emergency stop is latched"
    bench.driver.take()
    assert bench.driver.fault() == servo.text
    command = np.array(servo.commands[-1])[:, 0]
    assert command[:8] == pytest.approx(servo.q[:8])
    assert command[8:] == pytest.approx(servo.commanded[8:])
    servo.alive = False
    assert "process that commands the motors has ended" in bench.driver.fault()


def test_the_first_motion_of_what_lost_a_turn_is_slow_each_time_that_the_arm_comes_up(bench: Bench) -> None:
    servo, controller = bench.servo, bench.controller
    (first, second), hands = controller.arms.values(), controller.grippers.values()

    def careful() -> list[bool]:
        bench.driver.take()
        return [bool(follower.careful) for follower in (first, second, *hands)]

    servo.turns[[2, 15]] = np.array([2.0, -2.0]) * np.pi  # a joint of the first arm, the hand of the second
    for phase in (Phase.LOOKING, Phase.REFUSED, Phase.FOLLOWING, Phase.HELD):
        servo.phases = (phase, phase)
        assert not any(careful())
    servo.phases = (Phase.ENABLING, Phase.LOOKING)
    assert careful() == [True, False, False, False]
    servo.phases = (Phase.FOLLOWING, Phase.RAMPING)
    assert careful() == [True, False, False, True]
    first.careful = ""
    servo.phases = FOLLOWS
    assert careful() == [False, False, False, True]


def test_the_emergency_stop_and_its_reset_are_those_of_the_motors(bench: Bench) -> None:
    bench.robot.stop_motion()
    assert bench.servo.told == ["stop"]
    with pytest.raises(OpenArmError, match="emergency stop"):
        bench.robot.check_able()
    bench.servo.phases, bench.servo.text = (Phase.HELD, Phase.FOLLOWING), "not reset: one_1 reports: overload"
    assert "overload" in bench.robot.release()
    bench.servo.phases = FOLLOWS
    assert bench.robot.release() == ""
    assert bench.servo.told == ["stop", "reset", "reset"]


def test_where_the_joints_were_is_kept_by_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    posture = LastPosture(str(tmp_path / "new"))
    assert posture.read() == {}
    assert posture.write({"a": 0.5, "b": float("nan")}) == ""
    assert posture.read() == {"a": 0.5}
    monkeypatch.setenv("OPENARM_ROBOT", robot_names()[-1])
    assert posture.read() == {}
    posture.path.write_text("[1, 2")
    assert posture.read() == {}
    assert "can't store" in LastPosture("/proc/none").write({"a": 0.5})
