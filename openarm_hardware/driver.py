# SPDX-License-Identifier: Apache-2.0
"""From the controllers' position targets to commands of motors, which carry the weight by torque.

A target t of the controllers stands for the torque kp (t - q). The motors are given the part of it that carries the
weight as a torque, and the rest as a position nearer to where the joint is: together they do the same, and what the
motors hold without the controllers is right.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from openarm_common.motors.axis import Axis
from openarm_common.robot.servos import ArmLoad
from openarm_common.types import Array
from openarm_control.controller import RobotController
from openarm_control.joints import JointReadout
from openarm_hardware.arm import Phase
from openarm_hardware.client import ServoProcess
from openarm_hardware.exchange import State
from openarm_hardware.touch import TouchGuard

#: Most that a command of an arm's joint is from what the servo commands, by its newest state, rad. Controllers that
#: give a goal up take their corrections back at once; the servo refuses a larger step as a fault of its client, and on
#: a busy machine does not take every command.
_STEP = 0.1
#: In these, what is commanded already is commanded again; before, where the joints are.
_HOLDING = (Phase.RAMPING, Phase.FOLLOWING, Phase.HELD)
#: In these, it is known how many turns the motors have lost, and the arm has not moved since.
_RISING = (Phase.SETTING, Phase.ENABLING, Phase.RAMPING)


class MotorDriver:
    """Implements `openarm_control.streamed.Driver` by a servo process.

    Args:
        servo: Commands the motors; may be exchanged for another one.
        controller: Controller of the joints.
        loads: Loads of the arms, by name.
        guard: Refuses commands.
        publish: Called with each new joint state.
    """

    def __init__(
        self,
        servo: ServoProcess,
        controller: RobotController,
        loads: Mapping[str, ArmLoad],
        guard: TouchGuard,
        publish: Callable[[JointReadout], None],
    ) -> None:
        self.servo = servo
        self._controller, self._guard, self._publish = controller, guard, publish
        axes = {axis.joint: axis for axis in servo.axes}
        self._axes: Sequence[Axis] = [axes[name] for name in controller.joint_names]
        self._arm_of = list(dict.fromkeys(axis.arm for axis in servo.axes))
        arm = {name: [i for i, a in enumerate(self._axes) if a.arm == name and not a.grips] for name in loads}
        self._arms = [(np.array(at), loads[name], np.zeros(len(at))) for name, at in arm.items()]
        self._kp = np.array([axis.kp for axis in self._axes])
        self._fingers = np.array([i for i, axis in enumerate(self._axes) if axis.grips])
        self._torque = np.array([abs(axis.torque * axis.ratio) for axis in self._axes])
        self._weight: Array = np.zeros(len(self._axes))
        #: The newest state.
        self.state: State | None = None

    def now_ns(self) -> int:
        """See `Driver.now_ns`."""
        return time.time_ns()

    def take(self) -> JointReadout | None:
        """See `Driver.take`; motors that are not followed yet are commanded to where they are."""
        state = self.servo.state()
        before = self.state
        if state is None or any(motor.status < 0 for motor in state.motors):
            return None
        if before is not None and before.t_ns == state.t_ns:
            return None
        self.state = state
        age_ns = time.monotonic_ns() - state.t_ns
        numbers = np.array([(motor.q, motor.dq, motor.tau) for motor in state.motors]).T
        readout = JointReadout(time.time_ns() - age_ns, *numbers)
        for at, load, rest in self._arms:
            self._weight[at] = load.torque(readout.position[at], rest, rest)
        if any(phase != Phase.FOLLOWING for phase in state.phases):
            self._guard.begin()
            self._stay(state, readout.position)
        self._publish(readout)
        return readout

    def fault(self) -> str:
        """See `Driver.fault`: arms that are coming up, hold or sink."""
        if not self.servo.alive:
            return "the process that commands the motors has ended"
        if self.state is None or all(phase == Phase.FOLLOWING for phase in self.state.phases):
            return ""
        return self.state.text or "the arms are coming up"

    def targets(self, since_ns: int) -> Array:
        """See `Driver.targets`: positions that are commanded now, and what the torques stand for."""
        if self.state is None:
            return np.full(len(self._axes), np.nan)
        command = np.array([(motor.command, motor.command_tau) for motor in self.state.motors])
        return self._with_torque(command[:, 0], command[:, 1], 1.0)

    def send(self, targets: Array) -> None:
        """See `Driver.send`; a command that would let the robot touch itself stops the arms instead."""
        if why := self._touches():
            self.servo.stop(why)
            return
        torque = self._weight.copy()
        limits = self._controller.effort_limits()[self._fingers]
        torque[self._fingers] = np.minimum(limits, self._torque[self._fingers])
        position = self._with_torque(targets, self._weight, -1.0)
        assert self.state is not None
        taken = np.array([motor.command for motor in self.state.motors])
        position = np.where(self._kp > 0.0, np.clip(position, taken - _STEP, taken + _STEP), position)
        self.servo.command(list(zip(position.tolist(), torque.tolist(), strict=True)))

    def _touches(self) -> str:
        """Return why the robot would touch itself, else nothing; fingers are where they are, whatever is commanded."""
        assert self.state is not None
        position, velocity = np.array([(motor.q, motor.dq) for motor in self.state.motors]).T
        command = self._controller.commanded()
        command[self._fingers] = position[self._fingers]
        return self._guard.refused(command, position, velocity)

    def _with_torque(self, positions: Array, torques: Array, sign: float) -> Array:
        """Return positions that are off by what torques move, where a gain moves them."""
        soft = self._kp > 0.0
        return positions + np.where(soft, sign * torques / np.where(soft, self._kp, 1.0), 0.0)

    def _stay(self, state: State, position: Array) -> None:
        """Command that arms stay, because none of them follows commands; first motions of lost turns will be slow."""
        rises = {arm for arm, phase in zip(self._arm_of, state.phases, strict=True) if phase in _RISING}
        turned = [a.joint for a, m in zip(self._axes, state.motors, strict=True) if m.turn and a.arm in rises]
        self._controller.be_careful(turned, "a motor lost a turn")
        holds = {arm: phase in _HOLDING for arm, phase in zip(self._arm_of, state.phases, strict=True)}
        joints = [
            (motor.command if holds[axis.arm] else float(q), limit if axis.grips else float(weight))
            for axis, motor, q, weight, limit in zip(
                self._axes, state.motors, position, self._weight, self._torque.tolist(), strict=True
            )
        ]
        self.servo.command(joints)
