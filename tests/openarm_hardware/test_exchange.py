# SPDX-License-Identifier: Apache-2.0
"""State and commands in shared memory, and the buses below."""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common.motors.bus import SocketBus
from openarm_hardware.exchange import BINS, Command, Exchange, MotorState, State


@pytest.fixture
def both() -> Iterator[tuple[Exchange, Exchange]]:
    fd = Exchange.make()
    writer, reader = Exchange(fd, 3, 2), Exchange(fd, 3, 2)
    os.close(fd)
    yield writer, reader
    writer.close()
    reader.close()


def state_of(x: float, text: str = "") -> State:
    return State(int(x), 2, 3, (5, 6), 7, text, tuple(MotorState(x, x, x, x, x, 1, 40, 41, i) for i in range(3)))


def test_states_and_commands_are_read_as_they_were_written(both: tuple[Exchange, Exchange]) -> None:
    writer, reader = both
    assert reader.read_state() is None
    assert reader.read_command() is None
    writer.write_state(state_of(1.5, "left: hält"))
    writer.write_periods(list(range(BINS)))
    found = reader.read_state()
    assert found is not None
    assert (found.motors, found.phases, found.text) == (state_of(1.5).motors, (5, 6), "left: hält")
    assert found.periods == tuple(range(BINS))
    command = Command(5, ((0.1, 1.0), (0.2, 2.0), (0.3, 3.0)))
    reader.write_command(command)
    assert writer.read_command() == command


def test_what_is_half_written_is_not_read(both: tuple[Exchange, Exchange]) -> None:
    writer, reader = both
    writer.write_command(Command(5, ((0.1, 1.0),) * 3))
    block = writer.command_block
    content = block.read()
    assert content is not None
    memory = writer._memory  # pyright: ignore[reportPrivateUsage]
    start = block._at + 16  # pyright: ignore[reportPrivateUsage]
    memory[start + 8 : start + 16] = struct.pack("=d", 9.0)  # another value, without counter and checksum
    assert reader.read_command() is None
    block.write(content)
    assert reader.read_command() is not None
    struct.pack_into("=Q", memory, block._at, 7)  # pyright: ignore[reportPrivateUsage]
    assert reader.read_command() is None  # a writer that died while it wrote


@settings(max_examples=30)
@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=80), st.booleans())
def test_a_bus_carries_frames_in_order(frames: list[tuple[int, bytes]], flexible: bool) -> None:
    a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    one, other = SocketBus(a, "one", flexible=flexible), SocketBus(b, "other")
    sent = one.send(frames)
    assert other.receive() == frames[:sent]
    assert sent + one.unsent == len(frames)
    assert other.receive() == []
    one.close()
    with pytest.raises(OSError, match="closed"):
        other.receive()
    other.close()


def test_a_classic_bus_hears_no_frames_of_can_fd() -> None:
    a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    one, other = SocketBus(a, "one"), SocketBus(b, "other", flexible=False)
    one.send([(1, bytes(8))])
    assert (other.receive(), other.ignored) == ([], 1)
    other.send([(2, bytes(8))])
    assert one.receive() == [(2, bytes(8))]
    one.close()
    other.close()


@given(st.lists(st.binary(max_size=100), max_size=20))
def test_a_bus_leaves_out_what_is_no_frame(messages: list[bytes]) -> None:
    a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    bus = SocketBus(b, "bus")
    for message in messages:
        a.send(message)
    assert len(bus.receive()) + bus.ignored + bus.errors == len(messages)
    a.close()
    bus.close()


def test_a_full_queue_takes_a_part_and_counts_the_rest() -> None:
    a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    bus = SocketBus(a, "bus")
    for _ in range(200):
        sent = bus.send([(1, bytes(8))] * 32)
        if sent < 32:
            break
    assert bus.unsent == 32 - sent > 0
    a.close()
    b.close()
