# SPDX-License-Identifier: Apache-2.0
"""Which motors answer on a bus, and what they say of themselves. Only questions are sent."""

from __future__ import annotations

import errno
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from openarm_common.errors import Code, OpenArmError
from openarm_common.motors import frames
from openarm_common.motors.bus import Bus, Frame, open_bus
from openarm_common.motors.frames import HIGHEST_ID, LAST_ID, ControlMode, Register
from openarm_common.motors.wiring import Wiring

#: Registers that are read, and for how long answers to one question are waited for, s.
_READ = (Register.PMAX, Register.VMAX, Register.TMAX, Register.CTRL_MODE, Register.TIMEOUT, Register.SW_VER)
_WAIT_S = 0.05
#: To look for motors so many questions are sent at once, fewer than the shortest queue of an interface holds, and
#: waited for so long, s: twice what they and as many answers take at 1 Mbit/s.
_AT_ONCE, _STEP_S = 8, 0.004


@dataclass(frozen=True)
class Found:
    """A motor that answers.

    Attributes:
        bus, id: Where it is.
        reply_id: Id of frames from it; 0 as it comes from the factory.
        status: Status in its last reply, in words.
        q: Position, rad of the motor; None where its ranges are not known.
        celsius: Temperature of MOSFET or rotor, whichever is hotter; None without a reply.
        mode: MIT, POS_VEL, VEL or POS_FORCE.
        timeout_s: Timeout of commands, s; 0: none.
        firmware: Register SW_VER, as text.
        ranges: ±rad, ±rad/s, ±N m.
    """

    bus: str
    id: int
    reply_id: int
    status: str
    q: float | None
    celsius: int | None
    mode: str
    timeout_s: float
    firmware: str
    ranges: tuple[float, ...]


def scanned(buses: Sequence[str], wiring: Wiring) -> list[Found]:
    """Return the motors that answer, of all ids that motors can have.

    Args:
        buses: Addresses.
        wiring: Wiring of the robot; says which kind of frames is sent.

    Raises:
        OpenArmError: Same as `open_bus`; ENVIRONMENT, when a bus is lost meanwhile.
    """
    found = list[Found]()
    for address in buses:
        try:
            found += _scan(address, flexible=wiring.flexible)
        except OSError as error:
            raise OpenArmError(Code.ENVIRONMENT, f"{address} was lost: {error}") from error
    return found


def silence(address: str, wiring: Wiring) -> str:
    """Return why no motor of a bus answers, by asking with the other kind of frames.

    Args:
        address: Address of the bus.
        wiring: Wiring of the robot; says with which kind of frames no motor answered.
    """
    flexible = not wiring.flexible
    try:
        n = len(_scan(address, flexible=flexible))
    except (OSError, OpenArmError):
        n = 0
    if n:
        kind, value = ("frames of CAN FD", "true") if flexible else ("classic frames", "false")
        return f"{n} motors answer on {address} to {kind} alone; set `flexible: {value}` in hardware.yaml"
    both = "neither to frames of CAN FD nor to classic ones"
    return f"no motor answers on {address}, {both}; is the arm's power on, its bus up and at the right bitrate?"


def unset(found: Iterable[Found], wiring: Wiring) -> list[str]:
    """Return which motors answer with other ids than is expected, and what to type."""
    shared, offset = dict[tuple[str, int], list[int]](), wiring.joints.reply_offset
    said, known = list[str](), [(motor.bus, motor.id) for motor in found]
    for bus, motor in dict.fromkeys(one for one in known if known.count(one) > 1):
        free = next(i for i in range(1, LAST_ID + 1) if (bus, i) not in known)
        way = f"connect one of them alone and type `openarm hardware set-id {bus} {motor} --to {free}`"
        said.append(f"{known.count((bus, motor))} motors answer to id {motor} on {bus}; {way}, or another id")
    for motor in found:
        if motor.reply_id != motor.id + offset and known.count((motor.bus, motor.id)) == 1:
            shared.setdefault((motor.bus, motor.reply_id), []).append(motor.id)
    for (bus, reply), ids in shared.items():
        who = f"motors {', '.join(map(str, ids[:-1]))} and {ids[-1]} answer" if ids[1:] else f"motor {ids[0]} answers"
        commands = [f"openarm hardware set-id {bus} {motor}{' --to ID' * (motor > LAST_ID)}" for motor in ids]
        todo = ", ".join(f"`{command}`" for command in commands)
        on = f"id {hex(reply) if reply else 0}: not set up, expected the motor's own and {offset:#x}"
        said.append(f"{who} on {on}; type {todo}")
    return said


def answering(bus: Bus) -> list[tuple[int, int]]:
    """Return the ids of all motors of a bus, each with that of its reply; twice where two motors have one id."""
    found, others = list[tuple[int, int]](), list[tuple[int, int]]()

    def listen(seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for number, data in bus.receive():
                answer = frames.decode_register(data)
                if answer is not None and answer.register == Register.MST_ID:
                    (others if number == frames.REGISTER_ID else found).append((answer.id, number))
            time.sleep(0.001)

    for first in range(1, HIGHEST_ID + 1, _AT_ONCE):
        ids = range(first, min(first + _AT_ONCE, HIGHEST_ID + 1))
        bus.send([frames.read_register(motor, Register.MST_ID) for motor in ids])
        listen(_STEP_S)
    listen(_WAIT_S)
    for motor, _ in others:  # another process of this machine has asked too
        if len(same := [one for one in found if one[0] == motor]) > 1:
            found.remove(same[-1])
    return sorted(found)


def asked(
    bus: Bus, reply_ids: Mapping[int, int], keys: Sequence[int]
) -> tuple[dict[int, bytes], dict[int, dict[int, float]]]:
    """Ask motors for their states and registers, one by one: those that are not set up answer with the same id.

    Args:
        bus: They are on.
        reply_ids: Ids of their replies by their own.
        keys: Registers.

    Returns:
        Replies, and values by register, by id; of what answered.
    """
    replies, registers = dict[int, bytes](), dict[int, dict[int, float]]()
    for motor, number in reply_ids.items():
        state = _answer(bus, frames.refresh(motor), number, motor, None)
        if state is not None:
            replies[motor] = state
        for key in keys:
            data = _answer(bus, frames.read_register(motor, key), number, motor, key)
            answer = frames.decode_register(data) if data is not None else None
            if answer is not None:
                registers.setdefault(motor, {})[key] = answer.value
    return replies, registers


def _answer(bus: Bus, question: Frame, reply_id: int, motor: int, register: int | None) -> bytes | None:
    """Return what a motor answers to a question for a register, or for its state; None when nothing comes."""
    bus.receive()  # what came before is no answer
    bus.send([question])
    end = time.monotonic() + _WAIT_S
    while time.monotonic() < end:
        for number, data in bus.receive():
            answer = frames.decode_register(data)
            is_of = answer.id == motor if answer is not None else len(data) == 8 and data[0] & 15 == motor & 15
            if number == reply_id and is_of and (answer.register if answer is not None else None) == register:
                return data
        time.sleep(0.001)
    return None


def _scan(address: str, *, flexible: bool) -> list[Found]:
    bus = open_bus(address, flexible=flexible)
    try:
        there = answering(bus)
        states, registers = asked(bus, dict(there), _READ)
        return [_found(address, i, n, states.get(i), registers.get(i, {})) for i, n in there]
    except OSError as error:
        if error.errno == errno.EINVAL:  # of an interface that is not set up for CAN FD
            return []
        raise
    finally:
        bus.close()


def _found(bus: str, motor: int, reply_id: int, reply: bytes | None, registers: dict[int, float]) -> Found:
    ranges = tuple(registers[key] for key in _READ[:3] if key in registers)
    kind = frames.MotorType("", *ranges) if len(ranges) == 3 else frames.MotorType("", 1.0, 1.0, 1.0)
    state = frames.decode_feedback(kind, reply or b"", motor)
    mode = int(registers.get(Register.CTRL_MODE, 0))
    return Found(
        bus,
        motor,
        reply_id,
        frames.status_text(state.status, motor) if state is not None else "no reply",
        state.q if state is not None and len(ranges) == 3 else None,
        max(state.mosfet, state.rotor) if state is not None else None,
        ControlMode(mode).name if mode in set(ControlMode) else str(mode),
        registers.get(Register.TIMEOUT, 0.0) * frames.TIMEOUT_STEP_S,
        frames.version_text(int(registers.get(Register.SW_VER, 0))),
        ranges,
    )
