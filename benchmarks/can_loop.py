# SPDX-License-Identifier: Apache-2.0
"""How evenly the servo process commands sixteen motors on two buses, and how soon it stops them.

    python -m benchmarks.can_loop [--seconds 10] [--trials 30] [--load 1] [--rates 250,500] [--graph sim] [--json PATH]

Buses are local sockets to a process of emulated motors, so no figure has the time of an adapter, its driver or a wire
in it. Each row of SCHED_FIFO has the same loop under SCHED_OTHER as its peer. Periods are of a histogram of 0.1 ms.
With --graph, a graph runs meanwhile in which one pick follows the other, in place of busy processes.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import Row, write_report
from openarm_common.domain import reserve_domain
from openarm_common.motors.bus import emulated_buses
from openarm_common.motors.wiring import axes_of, load_wiring
from openarm_common.robot.description import RobotDescription
from openarm_hardware.arm import Phase
from openarm_hardware.client import ServoProcess
from openarm_hardware.emulator import request
from openarm_hardware.exchange import BIN_S, State
from openarm_hardware.settings import Settings

#: Speed of the joints when they are stopped, rad/s: a command that holds goes back by what they lag behind.
_SPEED = 0.3
_SPIN = "while True: pass"


@dataclass(frozen=True)
class Figures:
    """Of one way to run the loop: ms, share of a core."""

    p50: float
    p99: float
    longest: float
    late: float
    cpu: float
    stops: list[float]
    silent: list[float]
    scheduling: str


class Bench:
    """A servo before emulated motors."""

    def __init__(self, settings: Settings, priority: int) -> None:
        description = RobotDescription.load()
        # as of a domain that no graph has
        self.axes = axes_of(load_wiring(), description, emulated_buses(os.getpid() + 1000, description.arm_names))
        start = {a.joint: min(max(0.0, a.lower + 0.3), a.upper - 0.3) for a in self.axes if not a.grips}
        self._emulator = subprocess.Popen(
            [sys.executable, "-m", "openarm_hardware.emulator"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
        )
        self._write(request(self.axes, start, weight=0.0, priority=priority))
        self._read()
        self.servo = ServoProcess(self.axes, settings)
        self._home: list[float] = []
        self._start: list[float] = []

    def ask(self, **line: Any) -> dict[str, Any]:
        """Tell the emulator something; return what it answers."""
        self._write(json.dumps(line) + "\n")
        return self._read()

    def up(self) -> None:
        """Bring the arms up."""
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            state = self.servo.state()
            if state is not None:
                if all(phase == Phase.FOLLOWING for phase in state.phases):
                    self._start = [m.command for m in state.motors]
                    self._home = self._home or self._start
                    return
                self._stay(state)
            time.sleep(0.01)
        raise RuntimeError(f"the arms do not come up: {state}")

    def move(self, seconds: float) -> None:
        """Command all joints at 100 Hz: forwards for a while, then where they are."""
        self._go(seconds, lambda t, q, _: q + min(0.25, _SPEED * t))

    def back(self) -> None:
        """Go back to where the first motion began."""
        self._go(0.8, lambda t, q, home: home + (q - home) * max(0.0, 1.0 - t / 0.6))
        self._start = self._home

    def _go(self, seconds: float, to: Callable[[float, float, float], float]) -> None:
        began = time.monotonic()
        while (t := time.monotonic() - began) < seconds:
            rows = zip(self._start, self._home, self.axes, strict=True)
            self.servo.command([(q, 1.0) if a.grips else (to(t, q, home), 0.0) for q, home, a in rows])
            time.sleep(0.01)

    def cpu_s(self) -> float:
        """Time that the servo has computed."""
        fields = Path(f"/proc/{self.servo.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def close(self) -> None:
        """End both."""
        self.servo.close()
        assert self._emulator.stdin is not None
        self._emulator.stdin.close()
        self._emulator.wait(10.0)

    def _stay(self, state: State) -> None:
        on = {
            a: p in (Phase.RAMPING, Phase.HELD, Phase.FOLLOWING)
            for a, p in zip(self._arms(), state.phases, strict=True)
        }
        self.servo.command(
            [(m.command if on[a.arm] else m.q, 0.0) for m, a in zip(state.motors, self.axes, strict=True)]
        )

    def _arms(self) -> list[str]:
        return list(dict.fromkeys(axis.arm for axis in self.axes))

    def _write(self, line: str) -> None:
        assert self._emulator.stdin is not None
        self._emulator.stdin.write(line.encode())

    def _read(self) -> dict[str, Any]:
        assert self._emulator.stdout is not None
        return json.loads(self._emulator.stdout.readline())


@contextmanager
def load(n: int) -> Iterator[None]:
    """Keep cores busy with so many processes."""
    busy = [subprocess.Popen([sys.executable, "-c", _SPIN]) for _ in range(n)]
    try:
        yield
    finally:
        for one in busy:
            one.kill()
            one.wait()


@contextmanager
def next_to(graph: str) -> Iterator[None]:
    """Run a graph that picks."""
    openarm = [sys.executable, "-m", "openarm_bringup.cli"]
    domain = ["--domain", str(reserve_domain())]
    up = subprocess.Popen([*openarm, "up", graph, *domain], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    ends = threading.Event()

    def pick() -> None:
        while not ends.is_set():
            done = subprocess.run([*openarm, "pick", "red", *domain], capture_output=True, text=True, check=False)
            print("pick:", (done.stdout + done.stderr).strip()[:160].replace("\n", " "), flush=True)

    picks = threading.Thread(target=pick, daemon=True)
    try:
        assert up.stdout is not None
        for line in up.stdout:
            if " is ready after" in line:
                break
        else:
            raise RuntimeError(f"the graph {graph} did not come up")
        threading.Thread(target=up.stdout.read, daemon=True).start()
        picks.start()
        time.sleep(3.0)
        yield
    finally:
        ends.set()
        up.send_signal(signal.SIGINT)
        up.wait(30.0)


def measured(rate: float, fifo: bool, seconds: float, trials: int, silent: int) -> Figures:
    """Run the loop, stop it and silence motors, in turn."""
    settings = Settings(period_s=1.0 / rate, priority=60 if fifo else 0, ramp_s=0.05, silent=silent, stale_s=0.5)
    bench = Bench(settings, 70)
    try:
        bench.up()
        bench.back()
        before, cpu, began = bench.servo.state(), bench.cpu_s(), time.monotonic()
        bench.move(seconds)
        after, share = bench.servo.state(), (bench.cpu_s() - cpu) / (time.monotonic() - began)
        assert before is not None
        assert after is not None
        bins = np.array(after.periods) - np.array(before.periods)
        total = np.cumsum(bins)
        p50, p99 = (1e3 * BIN_S * (np.searchsorted(total, x * total[-1]) + 1) for x in (0.5, 0.99))
        longest = 1e3 * BIN_S * (np.flatnonzero(bins)[-1] + 1)
        stops, lost = list[float](), list[float]()
        if all(phase == Phase.FOLLOWING for phase in after.phases):
            for _ in range(trials):
                stops.append(_stop(bench))
                lost.append(_silence(bench))
        scheduling = bench.servo.scheduling.partition(":")[0]
        late = (after.late - before.late) / max(1, after.cycles - before.cycles)
        return Figures(p50, p99, longest, late, share, stops, lost, scheduling)
    finally:
        bench.close()


def _stop(bench: Bench) -> float:
    """Return the time from a stop to the last joint that was commanded to hold, ms; not a number: it was not seen."""
    bench.up()
    bench.back()
    bench.ask(forget=True)
    bench.move(0.2)
    bench.ask(forget=True)
    began = time.monotonic_ns()
    bench.servo.stop()
    time.sleep(0.1)
    held: dict[str, int] = bench.ask()["held"]
    bench.servo.reset()
    arms = [axis for axis in bench.axes if not axis.grips]
    return (max(held.values()) - began) * 1e-6 if len(held) == len(arms) else float("nan")


def _silence(bench: Bench) -> float:
    """Return the time from the last reply of a motor to the last joint of its arm that was commanded to sink, ms."""
    bench.up()
    bench.back()
    bench.ask(forget=True)
    bench.move(0.2)
    bench.ask(forget=True)
    axis = bench.axes[2]
    began: int = bench.ask(fault="silent", joint=axis.joint)["t_ns"]
    time.sleep(0.15)
    held: dict[str, int] = bench.ask(fault="clear")["held"]
    bench.servo.reset()
    mine = [held[a.joint] for a in bench.axes if a.arm == axis.arm and a.joint in held]
    return (max(mine) - began) * 1e-6 if len(mine) == 7 else float("nan")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--trials", type=int, default=30)
    parser.add_argument("--load", type=int, default=1, help="busy processes that run meanwhile")
    parser.add_argument("--graph", default="", help="a graph that runs meanwhile")
    parser.add_argument("--rates", default="250,500", help="of the loop, Hz")
    parser.add_argument("--silent", type=int, default=3, help="replies left out that stop an arm")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = list[Row]()
    rates = [float(rate) for rate in options.rates.split(",")]
    busy = f"the graph {options.graph}" if options.graph else f"{options.load} busy processes"
    with next_to(options.graph) if options.graph else load(options.load):
        for rate in rates:
            fifo, other = (
                measured(rate, kind, options.seconds, options.trials, options.silent) for kind in (True, False)
            )
            print(f"{rate:g} Hz: {fifo.scheduling}; the other: {other.scheduling}; next to {busy}")
            n, peer = round(rate * options.seconds), other.scheduling
            target = 4.5 if rate == 250.0 else None
            rows += [
                Row(f"period p50, {rate:g} Hz", fifo.p50, "ms", "lower", None, peer, other.p50, n),
                Row(f"period p99, {rate:g} Hz", fifo.p99, "ms", "lower", target, peer, other.p99, n),
                Row(f"period max, {rate:g} Hz", fifo.longest, "ms", "lower", None, peer, other.longest, n),
                Row(f"cycles left out, {rate:g} Hz", 1e2 * fifo.late, "%", "lower", None, peer, 1e2 * other.late, n),
                Row(f"share of a core, {rate:g} Hz", fifo.cpu, "", "lower", 0.2, peer, other.cpu, n),
            ]
            for name, mine, theirs, goal in (
                ("stop to 14 joints held", fifo.stops, other.stops, 5.0),
                (f"silent motor to damping, {options.silent} replies", fifo.silent, other.silent, 30.0),
            ):
                for label, share in (("p50", 50.0), ("p99", 99.0)):
                    ours, peers = (
                        float(np.nanpercentile(x, share)) if np.isfinite(x).any() else float("nan")
                        for x in (mine, theirs)
                    )
                    seen = int(np.isfinite(mine).sum())
                    rows.append(Row(f"{name} {label}, {rate:g} Hz", ours, "ms", "lower", goal, peer, peers, seen))
        write_report(rows, options.json)


if __name__ == "__main__":
    main()
