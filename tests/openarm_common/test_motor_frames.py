# SPDX-License-Identifier: Apache-2.0
"""Frames of Damiao motors against frames that are computed in another way from the protocol's description."""

from __future__ import annotations

import itertools
import math
import random
import struct
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from openarm_common.motors import frames
from openarm_common.motors.bus import is_error, pack, unpack
from openarm_common.motors.frames import Feedback, MitCommand, MotorType, PosForceCommand
from tests.refusals import refused

#: As in the motors' data sheets: ±rad, ±rad/s, ±N m.
TYPES = {
    "DM8009": ("12.5", "45", "54"),
    "DM4340": ("12.5", "10", "28"),
    "DM4310": ("12.5", "30", "10"),
    "DM3507": ("12.5", "50", "5"),
    "DM10010L": ("12.5", "25", "200"),
}


def bits_of(x: Fraction, low: Fraction, high: Fraction, bits: int) -> str:
    """The nearest step as a text of binary digits; halves go up."""
    last = 2**bits - 1
    steps = math.floor((min(max(x, low), high) - low) * last / (high - low) + Fraction(1, 2))
    return format(steps, f"0{bits}b")


def bytes_of(digits: str) -> bytes:
    assert len(digits) == 64
    return bytes(int(digits[at : at + 8], 2) for at in range(0, 64, 8))


def shares(seed: int, n: int) -> list[Fraction]:
    """Of a range from -1 to 1, and beyond: ends, middle, and exact binary fractions between."""
    rng = random.Random(seed)
    fixed = [Fraction(-1), Fraction(1), Fraction(0), Fraction(-3, 2), Fraction(3, 2), Fraction(1, 4096)]
    return [*fixed, *(Fraction(rng.randrange(-4096, 4097), 4096) for _ in range(n - len(fixed)))]


def mit_table() -> list[tuple[str, tuple[Fraction, ...], bytes]]:
    rows = []
    for name, ranges in TYPES.items():
        q_max, dq_max, tau_max = map(Fraction, ranges)
        columns = [shares(len(name) * 10 + k, 40) for k in range(5)]
        for row, (a, b, c, d, e) in enumerate(zip(*columns, strict=True)):
            if row % 2:  # the ends of one field beside the middle of the others
                a, b, c, d, e = (x if k == row // 2 % 5 else Fraction(0) for k, x in enumerate((a, b, c, d, e)))
            values = (a * q_max, b * dq_max, (c + 1) * 250, (d + 1) * Fraction(5, 2), e * tau_max)
            digits = (
                bits_of(values[0], -q_max, q_max, 16)
                + bits_of(values[1], -dq_max, dq_max, 12)
                + bits_of(values[2], Fraction(0), Fraction(500), 12)
                + bits_of(values[3], Fraction(0), Fraction(5), 12)
                + bits_of(values[4], -tau_max, tau_max, 12)
            )
            rows.append((name, values, bytes_of(digits)))
    return rows


def feedback_table() -> list[tuple[str, Feedback, bytes]]:
    rows, rng = [], random.Random(7)
    for name, ranges in TYPES.items():
        maxima = list(map(float, ranges))
        for status, number in itertools.product((0, 1, 8, 0xB, 0xE), (1, 7, 8, 15)):
            steps = [rng.choice((0, 1, 2**bits // 2, 2**bits - 1, rng.randrange(2**bits))) for bits in (16, 12, 12)]
            hot = [rng.randrange(256), rng.randrange(256)]
            digits = f"{status:04b}{number:04b}{steps[0]:016b}{steps[1]:012b}{steps[2]:012b}{hot[0]:08b}{hot[1]:08b}"
            q, dq, tau = (
                -high + 2 * high * step / (2**bits - 1)
                for high, step, bits in zip(maxima, steps, (16, 12, 12), strict=True)
            )
            rows.append((name, Feedback(status, number, q, dq, tau, *hot), bytes_of(digits)))
    return rows


def test_commands_and_replies_are_those_of_a_table_that_is_computed_in_another_way() -> None:
    commands, replies = mit_table(), feedback_table()
    assert len(commands) >= 200
    assert len(replies) >= 100
    for name, values, expected in commands:
        kind = frames.motor_type(name)
        assert (kind.q_max, kind.dq_max, kind.tau_max) == tuple(map(float, TYPES[name]))
        assert frames.encode_mit(kind, MitCommand(*map(float, values))) == expected, (name, values)
    for name, reply, data in replies:
        found = frames.decode_feedback(frames.motor_type(name), data)
        assert found is not None
        assert found == pytest.approx(reply, abs=1e-12)
        assert frames.encode_feedback(frames.motor_type(name), found) == data


def test_known_frames() -> None:
    """Bytes as manuals print them."""
    assert frames.enable(1) == (1, bytes.fromhex("fffffffffffffffc"))
    assert frames.disable(2) == (2, bytes.fromhex("fffffffffffffffd"))
    assert frames.set_zero(3) == (3, bytes.fromhex("fffffffffffffffe"))
    assert frames.clear_error(3) == (3, bytes.fromhex("fffffffffffffffb"))
    assert frames.refresh(5) == (0x7FF, bytes.fromhex("0500cc0000000000"))
    assert frames.read_register(5, frames.Register.TIMEOUT) == (0x7FF, bytes.fromhex("0500330900000000"))
    assert frames.write_register(8, frames.Register.CTRL_MODE, 4) == (0x7FF, bytes.fromhex("0800550a04000000"))
    assert frames.write_register(8, frames.Register.PMAX, 12.5) == (0x7FF, bytes.fromhex("0800551500004841"))
    assert frames.pos_vel(6, 1.0, 2.0) == (0x106, bytes.fromhex("0000803f00000040"))
    assert frames.pos_force(8, PosForceCommand(-1.0, 5.0, 0.25)) == (0x308, bytes.fromhex("000080bff401c409"))
    assert [frames.special(data) for _, data in (frames.enable(1), frames.clear_error(1), frames.refresh(1))] == [
        "enable",
        "clear",
        "",
    ]


def test_frames_of_two_arms_on_one_bus() -> None:
    """Motor 16, by id 0x20: its id is not cut to a nibble. Motor 12, with a byte as of a written register."""
    kind = frames.motor_type("DM4310")
    off = bytes.fromhex("107fff7ff7fd1d1b")
    state = frames.decode_feedback(kind, off, 16)
    assert state is not None
    assert (state.status, state.id, state.mosfet, state.rotor) == (frames.Status.DISABLED, 0, 29, 27)
    assert state.q == pytest.approx(0.0, abs=1e-3)
    assert frames.decode_register(off) is None
    twelfth = bytes.fromhex("0c5f557ff8001f1c")
    state = frames.decode_feedback(kind, twelfth, 12)
    assert frames.decode_register(twelfth) is None
    assert state is not None
    assert (state.status, state.id, state.mosfet, state.rotor) == (0, 12, 31, 28)
    assert state.q == pytest.approx(0x5F55 * 25.0 / 65535 - 12.5)


@given(st.integers(1, frames.LAST_ID), st.sampled_from(frames.Status))
def test_the_status_of_any_motor_is_read_or_one_that_looks_the_same(motor: int, status: frames.Status) -> None:
    kind = frames.motor_type("DM4310")
    data = frames.encode_feedback(kind, Feedback(status, motor, 0.0, 0.0, 0.0, 30, 30))
    state = frames.decode_feedback(kind, data, motor)
    assert state is not None
    assert state.id == motor & 15
    assert data[0] == motor & 0xFF | status << 4
    assert state.status | motor >> 4 == status | motor >> 4
    if status > 1:
        assert status.name.replace("_", " ").lower() in frames.status_text(state.status, motor).split(" or ")
    elif not frames.hides_enabled(motor):
        assert state.status == status
    added = bytes([motor + (status << 4) & 0xFF]) + data[1:]  # firmware that adds where ids and states overlap
    again = frames.decode_feedback(kind, added, motor)
    assert again is not None
    assert again.status == status


@pytest.mark.parametrize(
    ("version", "text"), [(942748471, "7318"), (5015, "5015"), (0, "0"), (0x20313337, "540095287")]
)
def test_a_firmware_version_is_shown_as_text_where_it_is_one(version: int, text: str) -> None:
    assert frames.version_text(version) == text


numbers = st.floats(-1e4, 1e4)
kinds = st.sampled_from([frames.motor_type(name) for name in TYPES])


@given(kinds, numbers, numbers, numbers, numbers, numbers)
def test_a_command_comes_back_within_half_a_step_or_at_the_end_of_its_range(
    kind: MotorType, q: float, dq: float, kp: float, kd: float, tau: float
) -> None:
    found = frames.decode_mit(kind, frames.encode_mit(kind, MitCommand(q, dq, kp, kd, tau)))
    assert found is not None
    ranges = [(-kind.q_max, kind.q_max, 16), (-kind.dq_max, kind.dq_max, 12), (0.0, 500.0, 12), (0.0, 5.0, 12)]
    ranges.append((-kind.tau_max, kind.tau_max, 12))
    for value, back, (low, high, bits) in zip((q, dq, kp, kd, tau), found, ranges, strict=True):
        half = (high - low) / (2**bits - 1) / 2
        assert back == pytest.approx(min(max(value, low), high), abs=half * (1 + 1e-9))


@given(st.integers(1, 255), st.sampled_from(sorted(frames.WHOLE)), st.integers(0, 2**32 - 1), st.booleans())
def test_registers_come_back(motor: int, register: int, value: int, written: bool) -> None:
    found = frames.decode_register(frames.register_reply(motor, register, value, written=written))
    assert found == (motor, register, value, written)
    _, request = frames.write_register(motor, register, value)
    assert frames.decode_register_request(request) == (motor, "write", register, value)


@pytest.mark.parametrize("value", [math.nan])
def test_what_is_no_number_is_refused(value: float) -> None:
    kind = frames.motor_type("DM4310")
    for at in range(5):
        command = MitCommand(*(value if k == at else 0.0 for k in range(5)))
        refused("expected a number", frames.encode_mit, kind, command)
    refused("expected a number", frames.pos_force, 8, PosForceCommand(value, 1.0, 1.0))
    refused("whole number of 32 bits", frames.write_register, 1, frames.Register.TIMEOUT, -1)
    refused("DM4310", frames.motor_type, "DM1")


@given(st.integers(0, 0x7FF), st.binary(max_size=8), st.booleans())
def test_frames_pass_the_socket_format(number: int, data: bytes, flexible: bool) -> None:
    raw = pack((number, data), flexible=flexible)
    assert len(raw) == (72 if flexible else 16)
    assert unpack(raw) == (number, data)
    assert struct.unpack_from("=IB", raw) == (number, len(data))
    assert not is_error(raw)


@given(st.one_of(st.binary(max_size=80), st.binary(min_size=16, max_size=16), st.binary(min_size=72, max_size=72)))
def test_any_bytes_are_a_frame_or_nothing(raw: bytes) -> None:
    frame = unpack(raw)
    is_error(raw)
    if frame is not None:
        number, data = frame
        assert number <= 0x7FF
        assert len(data) <= 64
        for kind in frames.MOTOR_TYPES.values():
            assert frames.decode_feedback(kind, data) is None or len(data) == 8
            frames.decode_mit(kind, data)
        frames.decode_register(data)
        frames.decode_register_request(data)
        frames.decode_pos_force(data)
        frames.special(data)


def test_frames_of_errors_and_of_long_ids_are_none() -> None:
    for flag in (0x80000000, 0x40000000, 0x20000000, 0x800):
        raw = struct.pack("=IB3x8s", flag | 0x11, 8, bytes(8))
        assert unpack(raw) is None
        assert is_error(raw) == (flag == 0x20000000)
    assert unpack(struct.pack("=IB3x8s", 0x11, 9, bytes(8))) is None
