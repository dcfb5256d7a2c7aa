# SPDX-License-Identifier: Apache-2.0
"""What an owner does to motors that are off: set their ids, put their zeros where they are, write down what is set."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from openarm_common.errors import Code, OpenArmError
from openarm_common.motors import frames
from openarm_common.motors.axis import Axis
from openarm_common.motors.bus import Bus, open_bus
from openarm_common.motors.frames import Feedback, Register, Status
from openarm_hardware.scan import answering, asked
from openarm_hardware.servo import Ownership

#: After a zero was set, a motor reads less than this, rad of the motor.
_AT_ZERO = 0.02
#: Registers that say how a motor behaves.
_GAINS = tuple(r for r in Register if r not in (Register.MST_ID, Register.ESC_ID, Register.TIMEOUT))
#: A motor has stored its registers within this, s.
_STORE_S = 0.1
#: Registers are compared to this share: they are 32-bit floats.
_SAME = 1e-5


@dataclass(frozen=True)
class Zero:
    """A zero that was, or would be, put where the joint is.

    Attributes:
        joint: Its name.
        before: Position that the joint was said to have.
        after: Position that it is said to have now; None: it was not changed.
        turned: Angle that the motor's zero moves by, rad of the motor.
        unit: Unit of the joint.
    """

    joint: str
    before: float
    after: float | None
    turned: float
    unit: str


def zeros(axes: Sequence[Axis], *, flexible: bool, write: bool) -> list[Zero]:
    """Put the zeros of motors where they are now; without `write`, say what that would change.

    Args:
        axes: The motors.
        flexible: Whether frames are sent as CAN FD.
        write: Whether to do it; motors keep their zero without power.

    Raises:
        OpenArmError: BUSY, when another process commands a bus; NOT_READY, when a motor does not answer, is switched
            on, reports an error or did not take its zero; as `open_bus`.
    """
    found = list[Zero]()
    for bus, mine in _buses(axes, flexible=flexible):
        states = {axis.joint: _state(bus, axis) for axis in mine}
        for axis in mine if write else ():
            bus.send([frames.disable(axis.id)])
            bus.send([frames.set_zero(axis.id)])
            time.sleep(0.05)
        for axis in mine:
            before = states[axis.joint].q
            after = _state(bus, axis).q if write else None
            if after is not None and abs(after) > _AT_ZERO:
                raise OpenArmError(Code.NOT_READY, f"{axis} did not take its zero: it is at {after:.3f} rad")
            joint = None if after is None else (after - axis.offset) / axis.ratio
            found.append(Zero(axis.joint, (before - axis.offset) / axis.ratio, joint, before, axis.unit))
    return found


def set_id(address: str, motor: int, to: int, offset: int, *, flexible: bool) -> None:
    """Give a motor an id, and its replies that id and an offset, and read back that it has them; it keeps them.

    Args:
        address: Address of its bus.
        motor: Its present id.
        to: Its new one, or the same.
        offset: Added for its replies.
        flexible: Whether frames are sent as CAN FD.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for ids that no motor can have, or another one of the bus has; BUSY, when the
            bus is commanded; NOT_READY, when the motor does not answer, is not off or did not take its ids.
    """
    if not 1 <= to <= frames.LAST_ID:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"a motor's id can't be {to}, expected 1 to {frames.LAST_ID}")
    with _opened(address, flexible=flexible) as bus:
        there = answering(bus)
        found = dict(there)
        if (many := [i for i, _ in there].count(motor)) > 1:
            text = (
                f"{many} motors answer to id {motor} on {address}; connect one of them alone, then give it another id"
            )
            raise OpenArmError(Code.NOT_READY, text)
        if motor not in found:
            known = ", ".join(map(str, found)) or "none"
            text = f"motor {motor} does not answer on {address}; motors that do: {known}"
            raise OpenArmError(Code.NOT_READY, f"{text}; `openarm hardware scan` says more")
        others = {number: f"motor {i}" for i, reply in found.items() if i != motor for number in (i, reply)}
        for number in (to, to + offset):
            if number in others:
                text = f"id {number} is that of {others[number]} or of its replies on {address}; choose another one"
                raise OpenArmError(Code.INVALID_ARGUMENT, text)
        replies, _ = asked(bus, {motor: found[motor]}, ())
        kind = next(iter(frames.MOTOR_TYPES.values()))  # of its status alone
        _off(f"motor {motor}", frames.decode_feedback(kind, replies.get(motor, b""), motor), motor)
        bus.send([frames.disable(motor), frames.write_register(motor, Register.MST_ID, to + offset)])
        bus.send([frames.write_register(motor, Register.ESC_ID, to), frames.store_registers(to)])
        time.sleep(_STORE_S)
        bus.receive()
        now = dict(answering(bus))
        if now.get(to) != to + offset or (to != motor and motor in now):
            text = f"motor {motor} did not take id {to} with replies {to + offset}; motors with replies now: {now}"
            raise OpenArmError(Code.NOT_READY, text)


def gains(axes: Sequence[Axis], *, flexible: bool) -> dict[str, dict[str, float]]:
    """Return the registers that say how motors behave, by joint.

    Raises:
        OpenArmError: Same as `zeros`.
    """
    found = dict[str, dict[str, float]]()
    for bus, mine in _buses(axes, flexible=flexible):
        _, registers = asked(bus, {axis.id: axis.reply_id for axis in mine}, _GAINS)
        for axis in mine:
            values = registers.get(axis.id, {})
            if not values:
                raise OpenArmError(Code.NOT_READY, f"{axis} does not answer; is the arm's power on?")
            found[axis.joint] = {Register(key).name: value for key, value in sorted(values.items())}
    return found


def read_gains(path: Path) -> dict[str, dict[str, float]]:
    """Read what `gains` returned, from a JSON file.

    Raises:
        OpenArmError: CONFIG_INVALID, for a file that is none.
    """
    try:
        data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["motors"]
        return {str(joint): {str(k): float(v) for k, v in values.items()} for joint, values in data.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} is no record of gains: {error!r}") from error


def changed(before: Mapping[str, Mapping[str, float]], now: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return what differs between two records, a sentence each."""
    said = [f"{joint} is not in both" for joint in sorted(before.keys() ^ now.keys())]
    for joint in before.keys() & now.keys():
        for name in sorted(before[joint].keys() | now[joint].keys()):
            a, b = before[joint].get(name), now[joint].get(name)
            if a is None or b is None or abs(a - b) > _SAME * max(abs(a), abs(b)):
                said.append(f"{joint}: {name} was {a}, is {b}")
    return sorted(said)


@contextmanager
def _opened(address: str, *, flexible: bool) -> Iterator[Bus]:
    owner = Ownership([address], takeover_s=0.0)
    bus = open_bus(address, flexible=flexible)
    try:
        yield bus
    except OSError as error:
        raise OpenArmError(Code.ENVIRONMENT, f"{address} was lost: {error}") from error
    finally:
        bus.close()
        owner.close()


def _buses(axes: Sequence[Axis], *, flexible: bool) -> Iterator[tuple[Bus, list[Axis]]]:
    for address in dict.fromkeys(axis.bus for axis in axes):
        with _opened(address, flexible=flexible) as bus:
            yield bus, [axis for axis in axes if axis.bus == address]


def _state(bus: Bus, axis: Axis) -> Feedback:
    """Return the state of a motor that is off.

    Raises:
        OpenArmError: NOT_READY, when it is not, or does not answer.
    """
    replies, _ = asked(bus, {axis.id: axis.reply_id}, ())
    return _off(
        str(axis), frames.decode_feedback(frames.motor_type(axis.type), replies.get(axis.id, b""), axis.id), axis.id
    )


def _off(who: str, state: Feedback | None, motor: int) -> Feedback:
    if state is None:
        raise OpenArmError(Code.NOT_READY, f"{who} does not answer; is the arm's power on?")
    if state.status != Status.DISABLED:
        said = frames.status_text(state.status, motor)
        raise OpenArmError(Code.NOT_READY, f"{who} is not off but {said}; end what commands it, or clear the error")
    return state
