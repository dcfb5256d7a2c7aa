# SPDX-License-Identifier: Apache-2.0
"""Motors behind an emulated bus: they take frames and answer them; what they move is up to the caller.

What a motor does with a frame is that of the documents named in `frames`; what they leave open is assumed so: reading,
writing and refreshing are answered by a motor that is off, too, a command for another control mode is answered and not
followed, an error switches a motor off until it is cleared, TIMEOUT runs while it is on, and a motor that gets power
reads a position within half a turn of its zero: turns that it made are lost.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Sequence

from openarm_common.errors import Code, OpenArmError
from openarm_common.motors import frames
from openarm_common.motors.axis import Axis
from openarm_common.motors.bus import Frame
from openarm_common.motors.frames import ControlMode, Feedback, MitCommand, PosForceCommand, Register, Status

#: Gains of the loops of POS_FORCE: rad/s by rad, and N m by rad/s.
_POSITION_GAIN, _SPEED_GAIN = 20.0, 0.3
#: Registers that the suite reads and does not use, as numbers that tell them apart.
_OF_FACTORY: dict[int, float] = {
    Register.UV_VALUE: 15.0,
    Register.KT_VALUE: 0.945,
    Register.OT_VALUE: 100.0,
    Register.OC_VALUE: 0.8,
    Register.ACC: 20.0,
    Register.DEC: -20.0,
    Register.MAX_SPD: 30.0,
    Register.GR: 10.0,
    Register.I_BW: 1000.0,
    Register.KP_ASR: 0.00372,
    Register.KI_ASR: 0.003,
    Register.KP_APR: 50.0,
    Register.KI_APR: 0.0,
    Register.OV_VALUE: 32.0,
    Register.CAN_BR: 4,
    Register.SUB_VER: 1,
}
#: Names of faults, with what their value is.
FAULTS = {
    "silent": "the motor of `joint` takes frames and answers none",
    "error": "the motor of `joint` switches off with the status nibble `value`",
    "hot": "the motor of `joint` reports `value` °C",
    "freeze": "the encoder of `joint` stays where it is",
    "zero": "the zero of `joint` jumps by `value` rad of the motor",
    "turn": "the motor of `joint` reads `value` turns more",
    "factory": "the motor of `joint` answers with id 0, as it comes from the factory",
    "loss": "a share `value` of the replies is lost",
    "late": "replies come `value` s later",
    "bus_off": "no frame passes on the bus of `joint`",
    "power": "all motors are without power, by which they lose turns and what was not stored",
}


class EmulatedMotor:
    """One motor.

    Args:
        axis: Its wiring.
        q: Position, rad of the motor.

    Attributes:
        q, dq: Of the motor; set by what it moves.
        tau: Torque of the motor; set by what it moves.
        on: True while it is enabled.
        error: Status nibble of an error, else 0.
    """

    def __init__(self, axis: Axis, q: float = 0.0) -> None:
        self.axis, self.kind = axis, frames.motor_type(axis.type)
        self.q, self.dq, self.tau = q, 0.0, 0.0
        self.on, self.error, self.celsius = False, 0, 35
        self.silent = False
        self.zero = 0.0
        self.frozen: float | None = None
        self.registers: dict[int, float] = {
            Register.CTRL_MODE: ControlMode.MIT,
            Register.TIMEOUT: 0,
            Register.MST_ID: axis.reply_id,
            Register.ESC_ID: axis.id,
            Register.SW_VER: 5015,
            Register.PMAX: self.kind.q_max,
            Register.VMAX: self.kind.dq_max,
            Register.TMAX: self.kind.tau_max,
            **_OF_FACTORY,
        }
        self._stored = dict(self.registers)
        self.command: MitCommand | PosForceCommand | None = None
        self.commands = 0
        self._heard_ns = 0

    @property
    def id(self) -> int:
        """Of frames to it."""
        return int(self.registers[Register.ESC_ID])

    @property
    def reply_id(self) -> int:
        """Of frames from it."""
        return int(self.registers[Register.MST_ID])

    def forget_reply_id(self) -> None:
        """Answer with id 0 for good, as a motor that was never set up."""
        self.registers[Register.MST_ID] = self._stored[Register.MST_ID] = 0

    def restart(self) -> None:
        """Begin again, as without power."""
        self.on, self.command = False, None
        self.registers = dict(self._stored)
        self.zero -= math.tau * round((self.q + self.zero) / math.tau)

    def take(self, number: int, data: bytes, now_ns: int) -> bytes | None:
        """Take a frame of the bus; return the reply, None for a frame to another one."""
        if number == frames.REGISTER_ID:
            return self._register(data)
        base = number - self.id
        modes = {0: 1, frames.POS_VEL_BASE: 2, frames.VEL_BASE: 3, frames.POS_FORCE_BASE: 4}
        if base not in modes or len(data) != 8:
            return None
        self._heard_ns = now_ns
        what = frames.special(data)
        if what and base == 0:
            self._special(what)
        elif modes[base] == self.registers[Register.CTRL_MODE] and self.on:
            taken = frames.decode_mit(self.kind, data) if base == 0 else None
            found = frames.decode_pos_force(data) if base == frames.POS_FORCE_BASE else taken
            if found is not None:
                self.command, self.commands = found, self.commands + 1
        return self.feedback()

    def feedback(self) -> bytes:
        """Return a reply."""
        status = self.error or (Status.ENABLED if self.on else Status.DISABLED)
        q = (self.q if self.frozen is None else self.frozen) + self.zero
        dq = self.dq if self.frozen is None else 0.0
        return frames.encode_feedback(self.kind, Feedback(status, self.id, q, dq, self.tau, self.celsius, self.celsius))

    def expire(self, now_ns: int) -> None:
        """Switch off when no command came for as long as TIMEOUT says."""
        timeout_ns = self.registers[Register.TIMEOUT] * frames.TIMEOUT_STEP_S * 1e9
        if self.on and timeout_ns and now_ns - self._heard_ns > timeout_ns:
            self.fail(Status.LOST_COMMUNICATION)

    def fail(self, status: int) -> None:
        """Switch off with an error."""
        self.on, self.error, self.command = False, status, None

    def law(self) -> tuple[float, float, float, float]:
        """Return bias, k, d and limit of the torque: bias - k q - d dq, N m of the motor, within the limit."""
        command = self.command
        if not self.on or command is None:
            return 0.0, 0.0, 0.0, 0.0
        zero = self.zero
        if isinstance(command, MitCommand):
            q, dq, kp, kd, tau = command
            return kp * (q - zero) + kd * dq + tau, kp, kd, self.kind.tau_max
        wanted = _POSITION_GAIN * (command.q - zero - self.q)
        speed = min(max(wanted, -command.speed), command.speed)
        return _SPEED_GAIN * speed, 0.0, _SPEED_GAIN, command.current * self.kind.tau_max

    def torque(self) -> float:
        """Return the torque now, N m."""
        bias, k, d, limit = self.law()
        return min(max(bias - k * self.q - d * self.dq, -limit), limit)

    def _special(self, what: str) -> None:
        if what == "clear":
            self.error = 0
        elif what == "zero" and not self.on:
            self.zero = -self.q
        elif what == "disable":
            self.on, self.command = False, None
        elif what == "enable" and not self.error:
            self.on, self.command = True, self.command if self.on else None

    def _register(self, data: bytes) -> bytes | None:
        request = frames.decode_register_request(data)
        if request is None or request[0] != self.id:
            return None
        motor, what, register, value = request
        if what == "refresh":
            return self.feedback()
        if what == "store" and not self.on:
            self._stored = dict(self.registers)
            return data
        if register not in self.registers:
            return None
        if what == "write":
            self.registers[register] = value
        return frames.register_reply(motor, register, self.registers[register], written=what == "write")


class EmulatedBuses:
    """Motors on their buses, with faults.

    Args:
        motors: All of them.
        seed: Seed of lost replies.
    """

    def __init__(self, motors: Sequence[EmulatedMotor], seed: int = 0) -> None:
        self.motors = list(motors)
        self.addresses = list(dict.fromkeys(motor.axis.bus for motor in motors))
        self.loss, self.late_s, self.power = 0.0, 0.0, True
        self._off = set[str]()
        self._rng = random.Random(seed)

    def take(self, bus: str, received: Iterable[Frame], now_ns: int) -> list[Frame]:
        """Return the replies to the frames that came on a bus."""
        out = list[Frame]()
        if bus in self._off or not self.power:
            return out
        mine = [motor for motor in self.motors if motor.axis.bus == bus]
        for number, data in received:
            for motor in mine:
                reply = motor.take(number, data, now_ns)
                if reply is not None and not motor.silent and not (self.loss and self._rng.random() < self.loss):
                    out.append((motor.reply_id, reply))
        return out

    def inject(self, fault: str, joint: str = "", value: float = 0.0) -> None:
        """Begin a fault of `FAULTS`; "clear" ends all, a motor's error and a wrong zero remain as they would.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing faults or joints.
        """
        if fault not in FAULTS and fault != "clear":
            text = f"no fault {fault[:40]!r}; faults: clear, {', '.join(FAULTS)}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        if fault == "clear":
            self.loss, self.late_s, self.power = 0.0, 0.0, True
            self._off.clear()
            for motor in self.motors:
                motor.silent, motor.frozen, motor.celsius = False, None, 35
        elif fault == "loss":
            self.loss = value
        elif fault == "late":
            self.late_s = value
        elif fault == "power":
            self.power = False
            for motor in self.motors:
                motor.restart()
        else:
            self._of(fault, self._motor(joint), value)

    def _of(self, fault: str, motor: EmulatedMotor, value: float) -> None:
        if fault == "silent":
            motor.silent = True
        elif fault == "error":
            motor.fail(int(value))
        elif fault == "hot":
            motor.celsius = int(value)
        elif fault == "freeze":
            motor.frozen = motor.q
        elif fault == "zero":
            motor.zero += value
        elif fault == "turn":
            motor.zero += math.tau * value
        elif fault == "factory":
            motor.forget_reply_id()
        else:
            self._off.add(motor.axis.bus)

    def _motor(self, joint: str) -> EmulatedMotor:
        for motor in self.motors:
            if motor.axis.joint == joint:
                return motor
        names = ", ".join(motor.axis.joint for motor in self.motors)
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no joint {joint[:40]!r}; joints: {names}")
