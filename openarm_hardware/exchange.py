# SPDX-License-Identifier: Apache-2.0
"""What the process of the servo and its client exchange in shared memory.

Each block has one writer. Its reader sees by a counter, odd while it is written, and by a checksum whether what it has
copied is whole, on any processor, and takes it again if not; neither of both ever waits for the other (a sequence
lock: Lameter, Effective synchronization on Linux/NUMA systems, 2005).
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from dataclasses import dataclass

_HEAD = struct.Struct("=QI4x")
#: Bytes of a sentence.
_TEXT = 800
#: Bins of the periods' histogram, 0.1 ms each.
BINS, BIN_S = 600, 1e-4
_TRIES = 50


@dataclass(frozen=True)
class MotorState:
    """One motor: of its joint position, velocity and torque, and what is commanded; see `MotorAxis`."""

    q: float
    dq: float
    tau: float
    command: float
    command_tau: float
    status: int
    mosfet: int
    rotor: int
    lost: int
    turn: float = 0.0


@dataclass(frozen=True)
class State:
    """The robot as the servo sees it, at the end of a cycle.

    Attributes:
        t_ns: Stamp of the newest replies, CLOCK_MONOTONIC.
        cycles: Since the start.
        late: Cycles that were left out, because the process was late.
        phases: Phases of each arm.
        errors: Bus errors and frames that full queues took not.
        text: Why arms wait, hold or sink.
        motors: Motors in the order of the joints.
        periods: Histogram of the time between two cycles, `BINS` of `BIN_S`.
    """

    t_ns: int
    cycles: int
    late: int
    phases: tuple[int, ...]
    errors: int
    text: str
    motors: tuple[MotorState, ...]
    periods: tuple[int, ...] = ()


@dataclass(frozen=True)
class Command:
    """What joints should do: position and torque of each (of fingers their largest), at a time of CLOCK_MONOTONIC."""

    t_ns: int
    joints: tuple[tuple[float, float], ...]


class Block:
    """A part of the shared memory with one writer.

    Args:
        memory: Shared.
        at: Offset at which the part begins.
        size: Bytes of its content.
    """

    def __init__(self, memory: mmap.mmap, at: int, size: int) -> None:
        self._memory, self._at, self._size = memory, at, size
        self._count = _HEAD.unpack_from(memory, at)[0]

    @property
    def end(self) -> int:
        """Where the next part may begin."""
        return self._at + _HEAD.size + (self._size + 7) // 8 * 8

    def write(self, content: bytes) -> None:
        """Replace the content."""
        start = self._at + _HEAD.size
        _HEAD.pack_into(self._memory, self._at, self._count + 1, 0)
        self._memory[start : start + self._size] = content
        self._count += 2
        _HEAD.pack_into(self._memory, self._at, self._count, zlib.crc32(content))

    @property
    def count(self) -> int:
        """How often it was written, times two; odd while it is."""
        return _HEAD.unpack_from(self._memory, self._at)[0]

    def read(self) -> bytes | None:
        """Return the content; None before the first write, or of a writer that died while it wrote."""
        start = self._at + _HEAD.size
        for _ in range(_TRIES):
            count, checksum = _HEAD.unpack_from(self._memory, self._at)
            if count == 0:
                return None
            content = self._memory[start : start + self._size]
            if not count % 2 and self.count == count and zlib.crc32(content) == checksum:
                return content
        return None


class Exchange:
    """State and commands of a robot.

    Args:
        fd: Descriptor of the memory, as `make` returns it.
        joints: Number of joints.
        arms: Number of arms.
    """

    def __init__(self, fd: int, joints: int, arms: int) -> None:
        self._state = struct.Struct(f"=qqqq{arms}q{_TEXT}s" + "5d4qd" * joints)
        self._command = struct.Struct(f"=q{2 * joints}d")
        self._periods = struct.Struct(f"={BINS}Q")
        self._joints, self._arms = joints, arms
        os.ftruncate(fd, 16384)
        self._memory = mmap.mmap(fd, 16384)
        self.state_block = Block(self._memory, 0, self._state.size)
        self.command_block = Block(self._memory, self.state_block.end, self._command.size)
        self.period_block = Block(self._memory, self.command_block.end, self._periods.size)

    @staticmethod
    def make() -> int:
        """Return the descriptor of new memory, which has no name and ends with its processes."""
        return os.memfd_create("openarm_hardware", os.MFD_CLOEXEC)

    def write_state(self, state: State) -> None:
        """Publish a state; its histogram with `write_periods`."""
        values = [x for m in state.motors for x in vars(m).values()]
        text = state.text.encode(errors="replace")[:_TEXT]
        self.state_block.write(
            self._state.pack(state.t_ns, state.cycles, state.late, state.errors, *state.phases, text, *values)
        )

    def write_periods(self, bins: list[int]) -> None:
        """Publish the histogram of the periods."""
        self.period_block.write(self._periods.pack(*bins))

    def read_state(self) -> State | None:
        """Return the newest state; None while there is none."""
        content = self.state_block.read()
        if content is None:
            return None
        values = self._state.unpack(content)
        t_ns, cycles, late, errors, *rest = values
        phases, text, numbers = rest[: self._arms], rest[self._arms], rest[self._arms + 1 :]
        motors = tuple(MotorState(*numbers[i : i + 10]) for i in range(0, 10 * self._joints, 10))
        periods = self.period_block.read()
        return State(
            t_ns,
            cycles,
            late,
            tuple(phases),
            errors,
            text.rstrip(b"\0").decode(errors="replace"),
            motors,
            self._periods.unpack(periods) if periods else (),
        )

    def write_command(self, command: Command) -> None:
        """Publish a command."""
        flat = [x for joint in command.joints for x in joint]
        self.command_block.write(self._command.pack(command.t_ns, *flat))

    def read_command(self) -> Command | None:
        """Return the newest command; None while there is none."""
        content = self.command_block.read()
        if content is None:
            return None
        t_ns, *flat = self._command.unpack(content)
        return Command(t_ns, tuple(zip(flat[::2], flat[1::2], strict=True)))

    def close(self) -> None:
        """Leave the memory."""
        self._memory.close()
