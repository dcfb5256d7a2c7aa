# SPDX-License-Identifier: Apache-2.0
"""One joint a little there and back, to see that motors, directions and limits are wired as hardware.yaml says."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.motors.axis import Axis
from openarm_common.robot.servos import ArmLoad
from openarm_common.types import Array
from openarm_hardware.arm import Phase
from openarm_hardware.axis import turn_text
from openarm_hardware.client import ServoProcess
from openarm_hardware.exchange import State
from openarm_hardware.settings import Settings
from openarm_hardware.touch import TouchGuard

#: Largest way, rad, and its speed, rad/s.
FARTHEST = 0.53
_SPEED = 0.2
#: The arm comes up within this, and rests at the end of the way for so long, s.
_UP_S, _REST_S = 15.0, 0.5
_PERIOD_S = 0.01
_ON = (Phase.RAMPING, Phase.FOLLOWING, Phase.HELD)


@dataclass(frozen=True)
class Jogged:
    """What the motors said.

    Attributes:
        start, there, back: Of the joint, rad.
        others: Farthest that another joint of the arm was off its place, rad.
        hottest: Temperature of the hottest motor, °C.
        scheduling: Scheduling of the commands.
        turns: Motors that lost a turn, a sentence each.
    """

    start: float
    there: float
    back: float
    others: float
    hottest: int
    scheduling: str
    turns: tuple[str, ...]


class Jog:
    """Moves a joint of one arm whose motors no one else commands; the arm sinks at the end.

    Args:
        axes: The motors of the arm.
        joint: Its name.
        load: Load of the arm, whose weight is carried.
        guard: Refuses commands, of the joints of `axes`.
        settings: Settings of commands and limits.
    """

    def __init__(self, axes: Sequence[Axis], joint: str, load: ArmLoad, guard: TouchGuard, settings: Settings) -> None:
        self._axes, self._load, self._guard, self._settings = axes, load, guard, settings
        self._arm = [i for i, axis in enumerate(axes) if not axis.grips]
        known = [axes[i].joint for i in self._arm]
        if joint not in known:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no joint {joint[:60]!r}; joints: {', '.join(known)}")
        self._at = next(i for i in self._arm if axes[i].joint == joint)
        self._fingers = [i for i, axis in enumerate(axes) if axis.grips]
        self._start: Array = np.zeros(len(axes))
        self._hottest = 0

    def run(self, radians: float) -> Jogged:
        """Move there and back.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for a way that is too far; LIMITS, beyond the joint's; NOT_READY, when the
                arm does not come up; ROBOT_LOST, when it was stopped, with why; as `ServoProcess`.
        """
        if not 0.0 < abs(radians) <= FARTHEST:
            text = f"{np.degrees(radians):g}° is no way to jog, expected up to {np.degrees(FARTHEST):.0f}° either way"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        servo = ServoProcess(self._axes, self._settings)
        try:
            state = self._up(servo)
            self._start = np.array([motor.command for motor in state.motors])
            axis, start = self._axes[self._at], float(self._start[self._at])
            if not axis.lower <= start + radians <= axis.upper:
                limits = f"{axis.lower:.3f} to {axis.upper:.3f} rad"
                text = f"{axis.joint} is at {start:.3f} rad; {start + radians:.3f} rad is beyond {limits}"
                raise OpenArmError(Code.LIMITS, text)
            there = self._go(servo, start, start + radians)
            others = max(abs(there.motors[i].q - self._start[i]) for i in self._arm if i != self._at)
            back = self._go(servo, start + radians, start)
            q = [state.motors[self._at].q for state in (state, there, back)]
            said = (turn_text(a, m.q, m.turn) for a, m in zip(self._axes, state.motors, strict=True))
            turns = tuple(filter(None, said))
            return Jogged(q[0], q[1], q[2], float(others), self._hottest, servo.scheduling, turns)
        finally:
            servo.close()

    def _up(self, servo: ServoProcess) -> State:
        end = time.monotonic() + _UP_S
        text = ""
        while time.monotonic() < end:
            state = servo.state()
            if state is not None and all(motor.status >= 0 for motor in state.motors):
                phase, text = Phase(state.phases[0]), state.text
                if phase is Phase.FOLLOWING:
                    return state
                if phase in (Phase.REFUSED, Phase.DAMPED, Phase.HELD):
                    break
                self._command(servo, state, np.array([m.command if phase in _ON else m.q for m in state.motors]))
            time.sleep(_PERIOD_S)
        raise OpenArmError(Code.NOT_READY, f"the arm does not come up: {text or 'its motors do not answer'}")

    def _go(self, servo: ServoProcess, begin: float, end: float) -> State:
        """Move the joint from one position to another, and rest; return the state then."""
        began, seconds = time.monotonic(), abs(end - begin) / _SPEED
        while True:
            t = time.monotonic() - began
            state = servo.state()
            if state is None or not servo.alive:
                raise OpenArmError(Code.ROBOT_LOST, "the process that commands the motors has ended")
            if Phase(state.phases[0]) is not Phase.FOLLOWING:
                raise OpenArmError(Code.ROBOT_LOST, f"the arm was stopped: {state.text}")
            if t > seconds + _REST_S:
                return state
            q = self._start.copy()
            share = 0.5 - 0.5 * np.cos(np.pi * min(1.0, t / seconds))
            q[self._at] = begin + share * (end - begin)
            position, velocity = np.array([(motor.q, motor.dq) for motor in state.motors]).T
            seen = q.copy()
            seen[self._fingers] = position[self._fingers]
            if why := self._guard.refused(seen, position, velocity):
                servo.stop(why)
            else:
                self._command(servo, state, q)
            self._hottest = max(self._hottest, *(max(motor.mosfet, motor.rotor) for motor in state.motors))
            time.sleep(_PERIOD_S)

    def _command(self, servo: ServoProcess, state: State, position: Array) -> None:
        rest = np.zeros(len(self._arm))
        weight = self._load.torque(np.array([state.motors[i].q for i in self._arm]), rest, rest)
        torque = {i: float(tau) for i, tau in zip(self._arm, weight, strict=True)}
        limits = [abs(axis.torque * axis.ratio) for axis in self._axes]  # of fingers, which hold what they hold
        servo.command([(float(q), torque.get(i, limits[i])) for i, q in enumerate(position)])
