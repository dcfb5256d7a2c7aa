# SPDX-License-Identifier: Apache-2.0
"""The client's side of the servo: starts its process and talks to it."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress

from openarm_common.errors import Code, OpenArmError
from openarm_common.motors.axis import Axis
from openarm_hardware.exchange import Command, Exchange, State
from openarm_hardware.servo import request
from openarm_hardware.settings import Settings

#: The process answers within this, s.
_START_S = 20.0
#: Time of a frame with 8 bytes on the wire, with the stuffing that is usual, s: classic at 1 Mbit/s; CAN FD, data at 5.
_CLASSIC_S, _FLEXIBLE_S = 120e-6, 55e-6
#: Most of the time of a bus that commands and replies may take; the rest is for a stop and for who only asks.
_LOAD = 0.7
#: Longest reason of a stop, characters.
_REASON = 300


def check_load(axes: Sequence[Axis], settings: Settings) -> None:
    """Refuse more motors than a bus carries.

    Raises:
        OpenArmError: CONFIG_INVALID, with the largest rate.
    """
    kind, frame_s = ("frames of CAN FD", _FLEXIBLE_S) if settings.flexible else ("classic frames", _CLASSIC_S)
    for bus, n in Counter(axis.bus for axis in axes).items():
        seconds = 2 * n * frame_s
        if seconds > _LOAD * settings.period_s:
            text = f"commands and replies of {n} motors in {kind} take {seconds * 1e3:.1f} ms on {bus}, of"
            rate = f"{settings.period_s * 1e3:.1f} ms; set `motors.rate` to {int(_LOAD / seconds)} Hz or less"
            raise OpenArmError(Code.CONFIG_INVALID, f"{text} {rate}, or give each arm a bus of its own")


class ServoProcess:
    """A running servo.

    Args:
        axes: All motors, in the order of the joints.
        settings: Settings of commands and limits.
        last: Positions by joint when they were last seen.

    Attributes:
        scheduling: Scheduling of its process.

    Raises:
        OpenArmError: CONFIG_INVALID, for more motors than a bus carries at this rate; BUSY or ENVIRONMENT, when it
            can't open a bus; TIMEOUT, when it does not answer.
    """

    def __init__(self, axes: Sequence[Axis], settings: Settings, last: Mapping[str, float] | None = None) -> None:
        check_load(axes, settings)
        self.axes, self.settings = tuple(axes), settings
        fd = Exchange.make()
        try:
            self._exchange = Exchange(fd, len(axes), len({axis.arm for axis in axes}))
            self._process = subprocess.Popen(
                [sys.executable, "-m", "openarm_hardware.servo", str(fd)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pass_fds=(fd,),
                bufsize=0,
                start_new_session=True,
            )
        finally:
            os.close(fd)
        try:
            self._tell(request(axes, settings, dict(last or {})).encode())
            self.scheduling = self._answer()
        except OpenArmError:
            self._process.kill()
            self._process.wait()
            raise

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def state(self) -> State | None:
        """Return the newest state; None before the first."""
        return self._exchange.read_state()

    def command(self, joints: Sequence[tuple[float, float]]) -> None:
        """Command position and torque of each joint."""
        self._exchange.write_command(Command(time.monotonic_ns(), tuple(joints)))

    def stop(self, why: str = "") -> None:
        """Hold all arms where they are, within a period, until `reset`; without a reason, as the emergency stop."""
        self._tell(f"h {' '.join(why.split())[:_REASON]}".encode() + b"\n")

    def reset(self) -> None:
        """Let arms go on whose cause of a stop is gone."""
        self._tell(b"r\n")

    def close(self, timeout_s: float = 15.0) -> None:
        """Let the arms sink, switch their motors off and end the process."""
        self._tell(b"q\n")
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout_s)
        self.abandon()
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        self._exchange.close()

    def abandon(self) -> None:
        """Leave the process, as the death of this one would: it holds the arms for a while."""
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()

    def _tell(self, line: bytes) -> None:
        assert self._process.stdin is not None
        with suppress(OSError, ValueError):  # of a process that has ended, which `alive` shows
            self._process.stdin.write(line)

    def _answer(self) -> str:
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], _START_S)
        code, _, text = self._process.stdout.readline().decode().strip().partition(" ") if ready else ("", "", "")
        if code == "OK":
            return text
        if code in Code.__members__:
            raise OpenArmError(Code(code), text)
        why = f"the process of the servo did not start within {_START_S:g} s; its errors are above"
        raise OpenArmError(Code.TIMEOUT, why)
