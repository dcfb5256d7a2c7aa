# SPDX-License-Identifier: Apache-2.0
"""Which motors answer on a bus, and what they say of themselves. Only questions are sent."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from openarm_common.errors import Code, OpenArmError
from openarm_common.motors import frames
from openarm_common.motors.bus import Bus, open_bus
from openarm_common.motors.frames import LAST_ID, ControlMode, Register
from openarm_common.motors.wiring import Wiring

#: Registers that are read, and for how long answers to one question are waited for, s.
_READ = (Register.PMAX, Register.VMAX, Register.TMAX, Register.CTRL_MODE, Register.TIMEOUT, Register.SW_VER)
_WAIT_S = 0.05


@dataclass(frozen=True)
class Found:
    """A motor that answers.

    Attributes:
        bus, id: Where it is.
        status: What its last reply says, in words.
        q: Position, rad of the motor; None where its ranges are not known.
        celsius: Of MOSFET or rotor, whichever is hotter; None without a reply.
        mode: MIT, POS_VEL, VEL or POS_FORCE.
        timeout_s: Of commands; 0: none.
        firmware: Register SW_VER.
        ranges: ±rad, ±rad/s, ±N m.
    """

    bus: str
    id: int
    status: str
    q: float | None
    celsius: int | None
    mode: str
    timeout_s: float
    firmware: int
    ranges: tuple[float, ...]


def scanned(buses: Sequence[str], wiring: Wiring) -> list[Found]:
    """Return the motors that answer.

    Args:
        buses: Addresses.
        wiring: Of the robot; says which replies are whose.

    Raises:
        OpenArmError: As `open_bus`; ENVIRONMENT, when a bus is lost meanwhile.
    """
    found = list[Found]()
    for address in buses:
        bus = open_bus(address, flexible=wiring.flexible)
        try:
            found += _scan(bus, wiring.joints.reply_offset)
        except OSError as error:
            raise OpenArmError(Code.ENVIRONMENT, f"{address} was lost: {error}") from error
        finally:
            bus.close()
    return found


def _scan(bus: Bus, offset: int) -> list[Found]:
    replies, registers = asked(bus, offset, range(1, LAST_ID + 1), _READ)
    return [
        _found(bus.address, motor, replies.get(motor), registers.get(motor, {}))
        for motor in sorted({*replies, *registers})
    ]


def asked(
    bus: Bus, offset: int, ids: Iterable[int], keys: Sequence[int]
) -> tuple[dict[int, bytes], dict[int, dict[int, float]]]:
    """Ask motors for their states and registers.

    Args:
        bus: They are on.
        offset: Added to the ids of their replies.
        ids: Theirs.
        keys: Registers.

    Returns:
        Replies, and values by register, by id; of what answered.
    """
    replies, registers = dict[int, bytes](), dict[int, dict[int, float]]()
    ids = list(ids)
    questions = [[frames.refresh(i) for i in ids], *([frames.read_register(i, key) for i in ids] for key in keys)]
    for question in questions:
        bus.send(question)
        end = time.monotonic() + _WAIT_S
        while time.monotonic() < end:
            for number, data in bus.receive():
                motor = number - offset
                answer = frames.decode_register(data)
                if answer is not None and answer.id == motor:
                    registers.setdefault(motor, {})[answer.register] = answer.value
                elif 1 <= motor <= LAST_ID and len(data) == 8 and data[0] & 15 == motor:
                    replies[motor] = data
            time.sleep(0.002)
    return replies, registers


def _found(bus: str, motor: int, reply: bytes | None, registers: dict[int, float]) -> Found:
    ranges = tuple(registers[key] for key in _READ[:3] if key in registers)
    kind = frames.MotorType("", *ranges) if len(ranges) == 3 else None
    state = frames.decode_feedback(kind, reply) if kind is not None and reply is not None else None
    mode = int(registers.get(Register.CTRL_MODE, 0))
    return Found(
        bus,
        motor,
        frames.status_text(reply[0] >> 4) if reply is not None else "no reply",
        state.q if state is not None else None,
        max(reply[6], reply[7]) if reply is not None else None,
        ControlMode(mode).name if mode in set(ControlMode) else str(mode),
        registers.get(Register.TIMEOUT, 0.0) * frames.TIMEOUT_STEP_S,
        int(registers.get(Register.SW_VER, 0)),
        ranges,
    )
