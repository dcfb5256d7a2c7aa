# SPDX-License-Identifier: Apache-2.0
"""The process that commands the motors: one thread, one wake a cycle, no ROS and no numpy.

Its client (`openarm_hardware.client`) starts it with `python -m openarm_hardware.servo FD`, gives it a line of JSON on
its standard input and then lines: `h WHY` holds at once, `r` resets, `q` lets the arms sink and ends. It answers with
one line when it runs. What it sees and what it should do is in the memory of FD (`Exchange`). When its input ends
without a q, the client has died: the arms are held for a while, and a new client may take them over meanwhile.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from openarm_common.errors import Code, OpenArmError
from openarm_common.motors.axis import Axis
from openarm_common.motors.bus import Bus, Frame, open_bus
from openarm_hardware.exchange import BIN_S, BINS, Exchange, State
from openarm_hardware.machine import STOPPED, Machine
from openarm_hardware.settings import Settings

#: A bus that is gone is opened again after so long, ns.
_REOPEN_NS = 500_000_000
#: A bus of another process is waited for so long, s.
_TAKEOVER_S = 2.0
#: Histogram of the periods and the cycles after the end, cycles.
_REPORT, _AFTER = 25, 25
_TIMER_SLACK, _LOCK_ALL = 29, 3


class Link:
    """A bus that may be gone for a while.

    Args:
        address: Address of the bus.
        flexible: Frames of CAN FD.

    Raises:
        OpenArmError: Same as `open_bus`.
    """

    def __init__(self, address: str, *, flexible: bool) -> None:
        self._address, self._flexible = address, flexible
        self._bus: Bus | None = open_bus(address, flexible=flexible)
        self._lost_ns = self._errors = 0

    @property
    def errors(self) -> int:
        """Error frames, and frames that were not taken."""
        return self._errors + (self._bus.errors + self._bus.unsent if self._bus is not None else 0)

    def receive(self) -> list[Frame]:
        """Return what has come."""
        try:
            return self._bus.receive() if self._bus is not None else []
        except OSError:
            self._lose()
            return []

    def send(self, frames: Sequence[Frame]) -> None:
        """Send frames; those of a bus that is gone are lost, which the motors' silence shows."""
        if self._bus is None and time.monotonic_ns() - self._lost_ns > _REOPEN_NS:
            self._lost_ns = time.monotonic_ns()
            try:
                self._bus = open_bus(self._address, flexible=self._flexible)
            except OpenArmError:
                return
        try:
            if self._bus is not None:
                self._bus.send(frames)
        except OSError:
            self._lose()

    def _lose(self) -> None:
        if self._bus is not None:
            self._errors += self._bus.errors + self._bus.unsent + 1
            self._bus.close()
        self._bus, self._lost_ns = None, time.monotonic_ns()


class Ownership:
    """Shows that the buses are of this process; another one may ask for them when its client has died.

    Args:
        buses: Addresses.
        takeover_s: Time that another process, whose client has died, may take to give them up.

    Raises:
        OpenArmError: BUSY, when another process has one and keeps it.
    """

    def __init__(self, buses: Sequence[str], takeover_s: float = _TAKEOVER_S) -> None:
        self.sockets = list[socket.socket]()
        end = time.monotonic() + takeover_s
        for bus in sorted(set(buses)):
            name = b"\0openarm_bus_" + bus.encode()[:80]
            mine = socket.socket(socket.AF_UNIX)
            while True:
                try:
                    mine.bind(name)
                    break
                except OSError:
                    self._ask(name)
                    if time.monotonic() > end:
                        text = f"{bus} is in use by another process that commands motors; end it first"
                        raise OpenArmError(Code.BUSY, text) from None
                    time.sleep(0.01)
            mine.listen()
            mine.setblocking(False)
            self.sockets.append(mine)

    def asked(self, ready: Sequence[Any]) -> bool:
        """Return whether another process asks for a bus."""
        found = False
        for one in self.sockets:
            if one in ready:
                one.accept()[0].close()
                found = True
        return found

    def close(self) -> None:
        """Give the buses up."""
        for one in self.sockets:
            one.close()
        self.sockets.clear()

    @staticmethod
    def _ask(name: bytes) -> None:
        with socket.socket(socket.AF_UNIX) as other:
            other.setblocking(False)
            try:
                other.connect(name)
            except OSError:
                return


class Servo:
    """The loop.

    Args:
        machine: Decides what is sent.
        links: Bus of each arm, the same one of arms that share it.
        exchange: State and commands.
        settings: Same as the machine's.
        owner: Owner of the buses.
    """

    def __init__(
        self, machine: Machine, links: Sequence[Link], exchange: Exchange, settings: Settings, owner: Ownership
    ) -> None:
        self._machine, self._links, self._exchange, self._owner = machine, links, exchange, owner
        self._settings, self._period_ns = settings, round(settings.period_s * 1e9)
        self._bins = [0] * BINS
        self._cycles = self._late = 0
        self._woke_ns = 0
        self._orphan_ns: int | None = None
        self._input: list[Any] = [sys.stdin.fileno()]
        self._rest = b""

    def run(self) -> None:
        """Run until the arms are released, or another process takes them over."""
        due_ns, after = time.monotonic_ns(), 0
        while after < _AFTER:
            self._cycle()
            after += self._machine.ended
            due_ns += self._period_ns
            now_ns = time.monotonic_ns()
            if now_ns > due_ns:  # what was missed is not made up
                missed = (now_ns - due_ns) // self._period_ns + 1
                self._late += missed
                due_ns += missed * self._period_ns
            if self._wait(due_ns):
                return

    def _cycle(self) -> None:
        now_ns = time.monotonic_ns()
        if self._woke_ns:
            self._bins[min(BINS - 1, int((now_ns - self._woke_ns) * 1e-9 / BIN_S))] += 1
        self._woke_ns = now_ns
        if self._orphan_ns is not None and now_ns - self._orphan_ns > self._settings.orphan_s * 1e9:
            self._orphan_ns = None
            self._machine.release("the client has ended", now_ns)
        self._send(self._machine.step(now_ns, self._received(), self._exchange.read_command()))
        self._cycles += 1
        self._publish(now_ns)

    def _received(self) -> list[list[Frame]]:
        """Return what came from the bus of each arm; arms that share one take theirs of it."""
        came = {link: link.receive() for link in set(self._links)}
        return [came[link] for link in self._links]

    def _send(self, frames: Sequence[Sequence[Frame]]) -> None:
        for link, mine in zip(self._links, frames, strict=True):
            link.send(mine)

    def _publish(self, now_ns: int) -> None:
        machine = self._machine
        phases = tuple(int(arm.phase) for arm in machine.arms.values())
        errors = sum(link.errors for link in set(self._links))
        state = State(now_ns, self._cycles, self._late, phases, errors, machine.text, machine.motors())
        self._exchange.write_state(state)
        if self._cycles % _REPORT == 0:
            self._exchange.write_periods(self._bins)

    def _wait(self, due_ns: int) -> bool:
        """Wait until a time and do meanwhile what the client asks; return whether to end at once."""
        while (left_ns := due_ns - time.monotonic_ns()) > 0:
            ready, _, _ = select.select([*self._input, *self._owner.sockets], [], [], left_ns * 1e-9)
            if not ready:
                break
            if self._owner.asked(ready) and self._orphan_ns is not None:
                return True
            if self._input and self._input[0] in ready:
                self._take(os.read(self._input[0], 4096))
        return False

    def _take(self, data: bytes) -> None:
        now_ns = time.monotonic_ns()
        if not data:
            self._input.clear()
            if not self._machine.ended:
                self._orphan_ns = now_ns
                self._machine.hold("the client has ended", now_ns)
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            what, _, why = line.decode(errors="replace").partition(" ")
            if what == "h":
                self._send(self._machine.stop(now_ns, self._received(), why or STOPPED))
                self._publish(now_ns)
            elif what == "r":
                self._machine.reset(now_ns)
            elif what == "q":
                self._machine.release("released", now_ns)


def schedule(priority: int) -> str:
    """Let this process wake in time; return how it is scheduled, and what to do where that is not enough."""
    library = ctypes.CDLL(None, use_errno=True)
    library.prctl(_TIMER_SLACK, 1000, 0, 0, 0)
    library.mlockall(_LOCK_ALL)
    gc.collect()
    gc.freeze()
    gc.disable()
    if priority == 0:
        return "SCHED_OTHER"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        return (
            f"SCHED_OTHER: this user may not use real-time priority {priority}, and commands are late when the machine"
            f" is busy. To allow it: `ulimit -r {priority}` (an rtprio line in /etc/security/limits.conf), or"
            " --cap-add=SYS_NICE in a container"
        )
    return f"SCHED_FIFO {priority}"


def request(axes: Sequence[Axis], settings: Settings, last: dict[str, float]) -> str:
    """Return the line by which the process is told what it commands."""
    return json.dumps({"axes": [asdict(axis) for axis in axes], "settings": asdict(settings), "last": last}) + "\n"


def main() -> int:
    """Run the process."""
    for number in (signal.SIGINT, signal.SIGHUP):  # of a terminal: the client decides
        signal.signal(number, signal.SIG_IGN)
    line = b""
    while not line.endswith(b"\n"):
        letter = os.read(0, 1)
        if not letter:
            return 1
        line += letter
    asked = json.loads(line)
    axes, settings = [Axis(**axis) for axis in asked["axes"]], Settings(**asked["settings"])
    machine = Machine(axes, settings, asked["last"])
    try:
        owner = Ownership(machine.buses)
        opened = {address: Link(address, flexible=settings.flexible) for address in set(machine.buses)}
        links = [opened[address] for address in machine.buses]
    except OpenArmError as error:
        os.write(1, f"{error.code} {error.message}\n".encode())
        return 2
    exchange = Exchange(int(sys.argv[1]), len(axes), len(machine.arms))
    servo = Servo(machine, links, exchange, settings, owner)
    signal.signal(signal.SIGTERM, lambda *_: machine.release("ended by a signal", time.monotonic_ns()))
    os.write(1, f"OK {schedule(settings.priority)}\n".encode())
    servo.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
