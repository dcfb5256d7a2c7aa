# SPDX-License-Identifier: Apache-2.0
"""The simulated robot behind the frames of its motors, in simulated time: servo and physics without processes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from openarm_common.errors import OpenArmError
from openarm_common.motors.bus import emulated_buses, open_bus
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import load_scene
from openarm_control.joints import arm_loads
from openarm_hardware.arm import Phase
from openarm_hardware.exchange import Command
from openarm_hardware.machine import Machine
from openarm_hardware.settings import Settings
from openarm_sim_bridge.faults.faults import checked_fault
from openarm_sim_bridge.motors import EmulatedRobot
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.world.hardware import HardwareConfig
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage

pytestmark = pytest.mark.requirement("R-10")

UP = [Phase.FOLLOWING, Phase.FOLLOWING]


class Rig:
    """Steps of 2 ms; the servo cycles in every second one."""

    def __init__(self, folder: Path) -> None:
        self.description = RobotDescription.load()
        stage = Stage(self.description, {}, None, PhysicsConfig(), HardwareConfig())
        world = self.world = stage.world(load_scene("empty"), each_step=True)
        world.reset(stage.posture("zero"))
        self.motors = EmulatedRobot(
            self.description,
            world,
            emulated_buses(0, self.description.arm_names, str(folder)),
            clock=lambda: world.t_ns,
        )
        self.robot = SimulatedRobot(self.description, world, self.motors)
        self.robot.faults.motors = self.motors.buses
        self.axes = tuple(motor.axis for motor in self.motors.buses.motors)
        self.machine = Machine(self.axes, Settings(silent=5, ramp_s=0.2))
        self.buses = [open_bus(address) for address in self.machine.buses]
        self.loads = arm_loads(self.description)
        self.wanted: np.ndarray | None = None
        self.command: Command | None = None
        self.cycles = 0

    def weights(self, q: np.ndarray) -> np.ndarray:
        found = np.zeros(len(self.axes))
        for arm, load in self.loads.items():
            at = [i for i, axis in enumerate(self.axes) if axis.arm == arm and not axis.grips]
            found[at] = load.torque(q[at], np.zeros(len(at)), np.zeros(len(at)))
        return found

    def tick(self) -> None:
        states = self.machine.motors()
        if self.cycles % 3 == 0 and all(state.status >= 0 for state in states):
            q = np.array([state.q for state in states])
            at = q if self.wanted is None else self.wanted
            torque = np.where([axis.grips for axis in self.axes], 30.0, self.weights(q))
            self.command = Command(self.world.t_ns, tuple(zip(at.tolist(), torque.tolist(), strict=True)))
        self.cycles += 1
        for bus, sent in zip(
            self.buses,
            self.machine.step(self.world.t_ns, [bus.receive() for bus in self.buses], self.command),
            strict=True,
        ):
            bus.send(sent)
        self.robot.tick(1)
        self.robot.tick(1)

    def until(self, phases: list[Phase], seconds: float) -> None:
        for _ in range(round(seconds / 0.004)):
            if [arm.phase for arm in self.machine.arms.values()] == phases:
                return
            self.tick()
        raise AssertionError(self.machine.text)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.004)):
            self.tick()

    def lift(self) -> None:
        """Both arms sideways, one finger opened."""
        self.wanted = np.array([state.command for state in self.machine.motors()])
        start, at = self.wanted.copy(), shoulders(self)
        for share in np.linspace(0.0, 1.0, 375):
            self.wanted = start.copy()
            self.wanted[at] += share * 0.6 * outwards(self)
            self.wanted[7] = self.description.hand(self.axes[7].arm).opened
            self.tick()


def shoulders(rig: Rig) -> list[int]:
    """The second joint of each arm."""
    return [i for i, axis in enumerate(rig.axes) if axis.id == 2]


def outwards(rig: Rig) -> np.ndarray:
    return np.sign([rig.axes[i].upper + rig.axes[i].lower for i in shoulders(rig)])


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Iterator[Rig]:
    found = Rig(tmp_path_factory.mktemp("motors"))
    for _ in range(3):  # the sockets are accepted, frames of the first cycle wait
        found.tick()
    found.until(UP, 2.0)
    found.lift()
    yield found
    for bus in found.buses:
        bus.close()
    found.motors.close()


def lifted(rig: Rig) -> np.ndarray:
    return rig.world.read_joints().position[shoulders(rig)] * outwards(rig)


def test_arms_go_where_frames_tell_them_and_are_carried_by_torque(rig: Rig) -> None:
    rig.run(0.5)
    assert rig.wanted is not None
    at = rig.world.read_joints().position
    arms = [i for i, axis in enumerate(rig.axes) if not axis.grips]
    assert lifted(rig) == pytest.approx([0.6, 0.6], abs=0.03)
    # dry friction and masses that are off by 5 % are left; without torque the shoulders alone would hang by 0.06 rad
    assert np.abs(at - rig.wanted)[arms].max() < 0.06
    assert at[7] == pytest.approx(rig.wanted[7], abs=0.002)


def test_the_laws_of_joints_are_those_of_their_motors_behind_the_gears(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Were they twice as fast, and turned the other way."""
    laws: list[np.ndarray] = []
    monkeypatch.setattr(rig.motors, "_ratio", -2.0 * rig.motors._ratio)
    monkeypatch.setattr(rig.world, "set_laws", lambda *of_joints: laws.extend(of_joints))
    rig.motors.update(rig.robot.state, 2_000_000)
    bias, stiffness, damping = laws
    for i, motor in enumerate(rig.motors.buses.motors):
        at_rest, kp, kd, _ = motor.law()
        r, q, dq = -2.0 * motor.axis.ratio, 0.3, 0.2
        torque = at_rest - kp * (r * q + motor.axis.offset) - kd * r * dq
        assert bias[i] - stiffness[i] * q - damping[i] * dq == pytest.approx(r * torque)


def test_a_fault_of_a_motor_lets_its_arm_sink_and_the_other_hold(rig: Rig) -> None:
    joint = next(axis.joint for axis in rig.axes if axis.id == 2)
    before = lifted(rig)
    fault = checked_fault("motor_fault", {"kind": "silent", "joint": joint})
    rig.robot.faults.inject(fault, rig.world)
    rig.until([Phase.DAMPED, Phase.HELD], 0.1)
    fastest = 0.0
    for _ in range(250):
        rig.tick()
        fastest = max(fastest, float(np.abs(rig.world.read_joints().velocity).max()))
    after = lifted(rig)
    assert after[1] == pytest.approx(before[1], abs=0.01)
    assert after[0] < before[0] - 0.1
    assert fastest < 1.5
    rig.robot.faults.clear()
    rig.wanted = None
    rig.machine.reset(rig.world.t_ns)
    rig.until(UP, 3.0)
    with pytest.raises(OpenArmError, match="no joint"):
        rig.robot.faults.inject(checked_fault("motor_fault", {"kind": "silent", "joint": "x"}), rig.world)
    with pytest.raises(OpenArmError, match="no fault"):
        rig.robot.faults.inject(checked_fault("motor_fault", {"kind": "x"}), rig.world)
