# SPDX-License-Identifier: Apache-2.0
"""Frames of Damiao motors: what is sent to a motor and what it answers, as pure functions.

Sources: the manual of the DM-J4310-2EC (protocol of the MIT mode, registers), `openarm_can` of Enactic
(`dm_motor_constants.hpp`, ranges by motor) and the documentation of python-damiao-driver (registers, status codes).

A number x of a range lo to hi with N bits is sent as the nearest whole number of steps (hi - lo) / (2^N - 1) above lo;
beyond the range it saturates. Positions are rad of the motor's output, velocities rad/s, torques N m.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from openarm_common.errors import Code, OpenArmError

#: Fields of a command of the MIT mode, from the most significant bit of 64: name and bits.
MIT_FIELDS = (("q", 16), ("dq", 12), ("kp", 12), ("kd", 12), ("tau", 12))
#: Fields of a reply.
FEEDBACK_FIELDS = (("status", 4), ("id", 4), ("q", 16), ("dq", 12), ("tau", 12), ("mosfet", 8), ("rotor", 8))
#: Largest gains of a command, N m/rad and N m s/rad; the least are 0.
KP_MAX, KD_MAX = 500.0, 5.0
#: Added to the id of a motor for the commands of the other control modes.
POS_VEL_BASE, VEL_BASE, POS_FORCE_BASE = 0x100, 0x200, 0x300
#: Id of frames that read or write registers, or ask for a reply.
REGISTER_ID = 0x7FF
#: Largest id that a motor can have; from 0x100 on ids of frames are those of commands of other control modes.
HIGHEST_ID = 0xFF
#: Largest id of a motor that is commanded: in replies of higher ones, errors can look like a motor that is only off.
LAST_ID = 0x1F
#: Steps of POS_FORCE commands: speed by 1/100 rad/s, current by 1/10,000 of the motor's largest.
_SPEED_STEPS, _CURRENT_STEPS = 100.0, 10_000.0

_ENABLE, _DISABLE, _SET_ZERO, _CLEAR = (bytes([0xFF] * 7 + [last]) for last in (0xFC, 0xFD, 0xFE, 0xFB))
_WORD = struct.Struct(">Q")
_READ, _WRITE, _STORE, _REFRESH = 0x33, 0x55, 0xAA, 0xCC


class Status(IntEnum):
    """What a reply says of its motor."""

    DISABLED = 0x0
    ENABLED = 0x1
    OVER_VOLTAGE = 0x8
    UNDER_VOLTAGE = 0x9
    OVER_CURRENT = 0xA
    MOSFET_TOO_HOT = 0xB
    ROTOR_TOO_HOT = 0xC
    LOST_COMMUNICATION = 0xD
    OVERLOAD = 0xE


class ControlMode(IntEnum):
    """Values of the register CTRL_MODE."""

    MIT = 1
    POS_VEL = 2
    VEL = 3
    POS_FORCE = 4


class Register(IntEnum):
    """Registers that the suite reads or writes; ASR and APR are the motor's own loops of speed and position."""

    UV_VALUE = 0
    KT_VALUE = 1
    OT_VALUE = 2
    OC_VALUE = 3
    ACC = 4
    DEC = 5
    MAX_SPD = 6
    MST_ID = 7
    ESC_ID = 8
    TIMEOUT = 9
    CTRL_MODE = 10
    SW_VER = 14
    GR = 20
    PMAX = 21
    VMAX = 22
    TMAX = 23
    I_BW = 24
    KP_ASR = 25
    KI_ASR = 26
    KP_APR = 27
    KI_APR = 28
    OV_VALUE = 29
    CAN_BR = 35
    SUB_VER = 36


#: Registers whose value is a whole number; the others are floats.
WHOLE = frozenset({7, 8, 9, 10, 13, 14, 15, 16, 35, 36})
#: Step of the register TIMEOUT, s: by the documentation of python-damiao-driver (registers.md, register 9) and the code
#: of motorbridge. The manual names none, and no motor was asked yet.
TIMEOUT_STEP_S = 50e-6


@dataclass(frozen=True)
class MotorType:
    """Ranges by which a type of motor scales its frames: ±rad, ±rad/s, ±N m."""

    name: str
    q_max: float
    dq_max: float
    tau_max: float


#: By name; from `dm_motor_constants.hpp` of openarm_can.
MOTOR_TYPES = {
    name: MotorType(name, q_max, dq_max, tau_max)
    for name, q_max, dq_max, tau_max in (
        ("DM3507", 12.5, 50.0, 5.0),
        ("DM4310", 12.5, 30.0, 10.0),
        ("DM4310_48V", 12.5, 50.0, 10.0),
        ("DM4340", 12.5, 10.0, 28.0),
        ("DM4340_48V", 12.5, 10.0, 28.0),
        ("DM6006", 12.5, 45.0, 20.0),
        ("DM8006", 12.5, 45.0, 40.0),
        ("DM8009", 12.5, 45.0, 54.0),
        ("DM10010L", 12.5, 25.0, 200.0),
        ("DM10010", 12.5, 20.0, 200.0),
        ("DMH3510", 12.5, 280.0, 1.0),
        ("DMG6215", 12.5, 45.0, 10.0),
        ("DMH6220", 12.5, 45.0, 10.0),
    )
}


class MitCommand(NamedTuple):
    """Torque kp (q - position) + kd (dq - velocity) + tau."""

    q: float
    dq: float
    kp: float
    kd: float
    tau: float


class PosForceCommand(NamedTuple):
    """Position, largest speed (rad/s) and largest current as a share of the motor's."""

    q: float
    speed: float
    current: float


class Feedback(NamedTuple):
    """A reply: status nibble, id of the motor (its low nibble), its state, temperatures of MOSFET and rotor, °C."""

    status: int
    id: int
    q: float
    dq: float
    tau: float
    mosfet: int
    rotor: int


class RegisterReply(NamedTuple):
    """What a motor answers to a read or a write: the value that the register has."""

    id: int
    register: int
    value: float
    written: bool


def motor_type(name: str) -> MotorType:
    """Return a type of motor.

    Raises:
        OpenArmError: CONFIG_INVALID, listing the types.
    """
    if name not in MOTOR_TYPES:
        text = f"motor type {name[:40]!r} is not known; types: {', '.join(MOTOR_TYPES)}"
        raise OpenArmError(Code.CONFIG_INVALID, text)
    return MOTOR_TYPES[name]


def status_text(status: int, motor: int = 0) -> str:
    """Return what a status nibble of a motor says, in words; all errors that it may stand for when the id hides some.

    Args:
        status: Nibble of `decode_feedback`.
        motor: Id.
    """
    hidden = motor >> 4 if status >= Status.OVER_VOLTAGE else 0
    known = [item.name.replace("_", " ").lower() for item in Status if item & ~hidden == status & ~hidden]
    return " or ".join(known) or f"unknown status {status:#x}"


def version_text(version: int) -> str:
    """Return a firmware version: the text of its four bytes, lowest first, where they are one, else the number."""
    text = (version & 0xFFFFFFFF).to_bytes(4, "little")
    return text.decode() if all(0x20 < letter < 0x7F for letter in text) else str(version)


def encode_mit(kind: MotorType, command: MitCommand) -> bytes:
    """Return the eight bytes of a command of the MIT mode.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for what is no number.
    """
    q, dq, kp, kd, tau = command
    return _WORD.pack(
        _steps(q, -kind.q_max, kind.q_max, 65535) << 48
        | _steps(dq, -kind.dq_max, kind.dq_max, 4095) << 36
        | _steps(kp, 0.0, KP_MAX, 4095) << 24
        | _steps(kd, 0.0, KD_MAX, 4095) << 12
        | _steps(tau, -kind.tau_max, kind.tau_max, 4095)
    )


def decode_mit(kind: MotorType, data: bytes) -> MitCommand | None:
    """Return the command of eight bytes as a motor takes it; None for another length."""
    if len(data) != 8:
        return None
    q, dq, kp, kd, tau = _fields(data, MIT_FIELDS)
    return MitCommand(
        _value(q, -kind.q_max, kind.q_max, 65535),
        _value(dq, -kind.dq_max, kind.dq_max, 4095),
        _value(kp, 0.0, KP_MAX, 4095),
        _value(kd, 0.0, KD_MAX, 4095),
        _value(tau, -kind.tau_max, kind.tau_max, 4095),
    )


def encode_feedback(kind: MotorType, reply: Feedback) -> bytes:
    """Return the eight bytes of a reply, as a motor of a type makes them.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for what is no number.
    """
    return _WORD.pack(
        ((reply.status & 15) << 4 | reply.id & 0xFF) << 56
        | _steps(reply.q, -kind.q_max, kind.q_max, 65535) << 40
        | _steps(reply.dq, -kind.dq_max, kind.dq_max, 4095) << 28
        | _steps(reply.tau, -kind.tau_max, kind.tau_max, 4095) << 16
        | _steps(reply.mosfet, 0.0, 255.0, 255) << 8
        | _steps(reply.rotor, 0.0, 255.0, 255)
    )


def decode_feedback(kind: MotorType, data: bytes, motor: int = 0) -> Feedback | None:
    """Return a reply; None for another length.

    The first byte is ID | STATUS << 4 with the low 8 bits of the id, which is not cut to its nibble: 0x10 of motor 16
    says that it is off. Ids above 15 therefore hide bits of the status that they have themselves (`hides_enabled`).

    Args:
        kind: Type of the motor.
        data: Data of the frame.
        motor: Id of the motor, by the id of the frame; only ids above 15 matter.
    """
    if len(data) != 8:
        return None
    word = _WORD.unpack(data)[0]
    return Feedback(
        (data[0] - (motor & 0xF0) & 0xFF) >> 4,
        word >> 56 & 15,
        _value(word >> 40 & 65535, -kind.q_max, kind.q_max, 65535),
        _value(word >> 28 & 4095, -kind.dq_max, kind.dq_max, 4095),
        _value(word >> 16 & 4095, -kind.tau_max, kind.tau_max, 4095),
        word >> 8 & 255,
        word & 255,
    )


def hides_enabled(motor: int) -> bool:
    """Return whether replies of a motor with this id look the same when it is on and when it is off."""
    return bool(motor & Status.ENABLED << 4)


def enable(motor: int) -> tuple[int, bytes]:
    """Return id and data of the frame that switches a motor on."""
    return motor, _ENABLE


def disable(motor: int) -> tuple[int, bytes]:
    """Return the frame that switches a motor off."""
    return motor, _DISABLE


def set_zero(motor: int) -> tuple[int, bytes]:
    """Return the frame that makes the present position the zero of a motor."""
    return motor, _SET_ZERO


def clear_error(motor: int) -> tuple[int, bytes]:
    """Return the frame that clears the error of a motor."""
    return motor, _CLEAR


def refresh(motor: int) -> tuple[int, bytes]:
    """Return the frame that asks a motor for a reply, without a command."""
    return REGISTER_ID, bytes([motor & 255, motor >> 8, _REFRESH, 0, 0, 0, 0, 0])


def read_register(motor: int, register: int) -> tuple[int, bytes]:
    """Return the frame that asks for a register."""
    return REGISTER_ID, bytes([motor & 255, motor >> 8, _READ, register, 0, 0, 0, 0])


def write_register(motor: int, register: int, value: float) -> tuple[int, bytes]:
    """Return the frame that sets a register until the power is switched off.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a value that the register does not take.
    """
    try:
        packed = struct.pack("<I", round(value)) if register in WHOLE else struct.pack("<f", value)
    except (struct.error, OverflowError, ValueError) as error:
        kind = "a whole number of 32 bits" if register in WHOLE else "a float of 32 bits"
        text = f"register {register} can't be {value}; expected {kind}"
        raise OpenArmError(Code.INVALID_ARGUMENT, text) from error
    return REGISTER_ID, bytes([motor & 255, motor >> 8, _WRITE, register]) + packed


def store_registers(motor: int) -> tuple[int, bytes]:
    """Return the frame that makes a motor that is off keep its registers without power."""
    return REGISTER_ID, bytes([motor & 255, motor >> 8, _STORE, 1, 0, 0, 0, 0])


def register_reply(motor: int, register: int, value: float, *, written: bool) -> bytes:
    """Return what a motor answers to a read or a write."""
    data = write_register(motor, register, value)[1]
    return data if written else data[:2] + bytes([_READ]) + data[3:]


def decode_register(data: bytes) -> RegisterReply | None:
    """Return the answer to a read or a write; None when data are none.

    A reply of a motor that is disabled, within 0.1 rad of -12.5 rad, could look the same; no joint goes there.
    """
    if len(data) != 8 or data[2] not in (_READ, _WRITE) or data[1] != 0 or not 1 <= data[0] <= HIGHEST_ID:
        return None
    value = struct.unpack("<I" if data[3] in WHOLE else "<f", data[4:])[0]
    return RegisterReply(data[0], data[3], value, data[2] == _WRITE)


def decode_register_request(data: bytes) -> tuple[int, str, int, float] | None:
    """Return what a frame to `REGISTER_ID` asks: motor, "read", "write", "store" or "refresh", register and value."""
    if len(data) < 4:
        return None
    motor, what, register = data[0] | data[1] << 8, data[2], data[3]
    if what == _REFRESH:
        return motor, "refresh", 0, 0.0
    if what == _STORE:
        return motor, "store", 0, 0.0
    if what == _READ:
        return motor, "read", register, 0.0
    if what != _WRITE or len(data) != 8:
        return None
    return motor, "write", register, struct.unpack("<I" if register in WHOLE else "<f", data[4:])[0]


def pos_vel(motor: int, q: float, speed: float) -> tuple[int, bytes]:
    """Return the frame that moves a motor of the mode POS_VEL to q with a largest speed."""
    return motor + POS_VEL_BASE, struct.pack("<ff", _number(q), _number(speed))


def pos_force(motor: int, command: PosForceCommand) -> tuple[int, bytes]:
    """Return the frame that moves a motor of the mode POS_FORCE.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for what is no number.
    """
    q, speed, current = command
    data = struct.pack(
        "<fHH",
        _number(q),
        _steps(speed, 0.0, 100.0, round(100.0 * _SPEED_STEPS)),
        _steps(current, 0.0, 1.0, round(_CURRENT_STEPS)),
    )
    return motor + POS_FORCE_BASE, data


def decode_pos_force(data: bytes) -> PosForceCommand | None:
    """Return the command of a POS_FORCE frame; None for another length or what is no number."""
    if len(data) != 8:
        return None
    q, speed, current = struct.unpack("<fHH", data)
    return PosForceCommand(q, speed / _SPEED_STEPS, current / _CURRENT_STEPS) if abs(q) < 1e6 else None


def special(data: bytes) -> str:
    """Return "enable", "disable", "zero" or "clear" for such a frame; else nothing."""
    return {_ENABLE: "enable", _DISABLE: "disable", _SET_ZERO: "zero", _CLEAR: "clear"}.get(data, "")


def _steps(x: float, lo: float, hi: float, most: int) -> int:
    if lo <= x <= hi:
        return int((x - lo) / (hi - lo) * most + 0.5)
    if x < lo:
        return 0
    if x > hi:
        return most
    raise OpenArmError(Code.INVALID_ARGUMENT, f"a value of a motor frame is {x}, expected a number")


def _number(x: float) -> float:
    if not abs(x) < 1e6:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"a value of a motor frame is {x}, expected a number below 1e6")
    return x


def _value(steps: int, lo: float, hi: float, most: int) -> float:
    return lo + steps * (hi - lo) / most


def _fields(data: bytes, layout: Sequence[tuple[str, int]]) -> list[int]:
    word, rest, found = _WORD.unpack(data)[0], 64, list[int]()
    for _, bits in layout:
        rest -= bits
        found.append(word >> rest & (1 << bits) - 1)
    return found
