# SPDX-License-Identifier: Apache-2.0
"""What a graph costs at rest, how fast it is ready, and how fast a node that was killed serves again.

    python -m benchmarks.graph_idle [--robot NAME] [--quick] [--seconds S] [--kills N] [--json PATH]

Starts `openarm up` as a user does, lets it rest, then kills nodes one after the other. The peer is the same graph with
every node started as `python -m MODULE`, as `ros2 run` does, and spun by rclpy's SingleThreadedExecutor. Run it on an
idle machine: the load before each run is printed.

    ready_s        from the start of the command to its line that says so
    idle_cores     of all processes, the supervisor's and the daemon's included; the median of windows of five seconds
    idle_pss_mib   proportional set size of all of them
    restart_max_s  from the signal to the supervisor's record that the node is ready again, the longest
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
import yaml

from benchmarks.report import Row, write_report
from openarm_bringup.supervision import runs
from openarm_bringup.supervision.graph import load_graph
from openarm_common.domain import reserve_domain
from openarm_common.robot.folder import choose_robot

#: Nodes that are killed.
KILLED = ("grasp", "motion", "octomap", "detector", "mujoco_bridge")
#: Rest before it is measured, and length of a window, s.
SETTLE_S, WINDOW_S = 10.0, 5.0
PEER = "python -m and SingleThreadedExecutor"


@dataclass
class Figures:
    """Of one graph; cores and MiB by process, restarts by node, s."""

    ready_s: float = 0.0
    cores: dict[str, float] = field(default_factory=dict[str, float])
    pss_mib: dict[str, float] = field(default_factory=dict[str, float])
    restarts_s: dict[str, list[float]] = field(default_factory=dict[str, list[float]])


@contextmanager
def running(figures: Figures, *, peer: bool) -> Iterator[subprocess.Popen[bytes]]:
    """Start the graph, whose nodes may be killed as often as it takes; wait until it is ready."""
    with tempfile.TemporaryDirectory() as folder:
        graph = Path(folder, "graph_idle.yaml")
        nodes: dict[str, dict[str, Any]] = {name: {"restart": {"max": 1000}} for name in KILLED}
        command = [sys.executable, "-m", "openarm_bringup.cli", "up", str(graph), "--domain", str(reserve_domain())]
        for name, spec in load_graph("sim").nodes.items() if peer else ():
            nodes.setdefault(name, {}).update(module=None, command=["python", "-m", spec.module])
            command += ["--set", f"{name}.executor=rclpy"]
        graph.write_text(yaml.safe_dump({"extends": "sim", "nodes": nodes}))
        environ, shown = {**os.environ, "OPENARM_RUNS": folder}, Path(folder, "shown")
        began = time.monotonic()
        with shown.open("w") as out:
            process = subprocess.Popen(command, env=environ, stdout=out, stderr=out, start_new_session=True)
        try:
            while "is ready" not in shown.read_text():
                if process.poll() is not None:
                    raise SystemExit(f"the graph has ended: {shown.read_text()}")
                time.sleep(0.01)
            figures.ready_s = time.monotonic() - began
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.wait()


def record(supervisor: int) -> runs.RunRecord:
    """Return what the supervisor has recorded."""
    return next(one for one in runs.running() if one.pid == supervisor)


def names(supervisor: int) -> dict[int, str]:
    """Return the processes of the graph by id: nodes by their names, what belongs to them by theirs with what it is."""
    nodes = {node.pid: name for name, node in record(supervisor).nodes.items()}
    found = {supervisor: "supervisor"}
    for process in psutil.Process(supervisor).children(recursive=True):
        line = process.cmdline()
        module = line[line.index("-m") + 1].rpartition(".")[2] if "-m" in line else process.name()
        owner = next((nodes[one.pid] for one in (process, *process.parents()) if one.pid in nodes), "")
        found[process.pid] = nodes.get(process.pid) or f"{owner} {module}".strip()
    return found


def rest(supervisor: int, seconds: float, figures: Figures) -> None:
    """Measure a graph at rest."""
    time.sleep(SETTLE_S)
    windows: list[dict[str, float]] = []
    processes = {pid: psutil.Process(pid) for pid in names(supervisor)}
    for _ in range(max(1, round(seconds / WINDOW_S))):
        before, began = {pid: sum(one.cpu_times()[:2]) for pid, one in processes.items()}, time.monotonic()
        time.sleep(WINDOW_S)
        passed = time.monotonic() - began
        windows.append({pid: (sum(one.cpu_times()[:2]) - before[pid]) / passed for pid, one in processes.items()})
    for pid, name in names(supervisor).items():
        if pid in processes:
            cores = statistics.median(window[pid] for window in windows)
            figures.cores[name] = figures.cores.get(name, 0.0) + cores
            figures.pss_mib[name] = figures.pss_mib.get(name, 0.0) + processes[pid].memory_full_info().pss / 2**20


def kill(supervisor: int, kills: int, figures: Figures) -> None:
    """Kill each node so often, and measure until it is ready again."""
    for name in KILLED:
        for _ in range(kills):
            before = record(supervisor).nodes[name].pid
            assert before is not None
            os.kill(before, signal.SIGKILL)
            began = time.monotonic()
            while (node := record(supervisor).nodes[name]).pid in (None, before) or node.state != "ready":
                time.sleep(0.005)
            figures.restarts_s.setdefault(name, []).append(time.monotonic() - began)
            while not record(supervisor).ready:
                time.sleep(0.05)
            time.sleep(1.0)


def measure(seconds: float, kills: int, *, peer: bool = False) -> Figures:
    """Measure one graph."""
    figures = Figures()
    print(f"load {os.getloadavg()[0]:.2f}", flush=True)
    with running(figures, peer=peer) as process:
        rest(process.pid, seconds, figures)
        kill(process.pid, kills, figures)
    for name in sorted(figures.cores, key=lambda one: -figures.cores[one]):
        line = f"    {name:40} {figures.cores[name]:6.3f} cores {figures.pss_mib[name]:7.0f} MiB"
        if name in figures.restarts_s:
            took = figures.restarts_s[name]
            line += f"   in service again after {statistics.median(took):.2f} s, at most {max(took):.2f} s"
        print(line)
    print(f"    ready after {figures.ready_s:.2f} s", flush=True)
    return figures


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", help="name of a folder of models/robots")
    parser.add_argument("--quick", action="store_true", help="10 s of rest, two kills of each node, and no peer")
    parser.add_argument("--seconds", type=float, default=60.0, help="of rest")
    parser.add_argument("--kills", type=int, default=10, help="of each node")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    choose_robot(args.robot)
    seconds, kills = (10.0, 2) if args.quick else (args.seconds, args.kills)
    ours = measure(seconds, kills)
    peer = None if args.quick else measure(seconds, 1, peer=True)

    def row(metric: str, unit: str, target: float, of: str) -> Row:
        def value(figures: Figures) -> float:
            if of == "ready":
                return figures.ready_s
            if of == "restarts":
                return max(max(took) for took in figures.restarts_s.values())
            return sum((figures.cores if of == "cores" else figures.pss_mib).values())

        n = kills * len(KILLED) if of == "restarts" else 1
        other = None if peer is None else value(peer)
        return Row(metric, value(ours), unit, "lower", target, PEER if peer else "", other, n)

    rows = [
        row("ready_s", "s", 5.0, "ready"),
        row("idle_cores", "", 0.5, "cores"),
        row("idle_pss_mib", "MiB", 1229.0, "pss"),
        row("restart_max_s", "s", 1.5, "restarts"),
    ]
    write_report(rows, args.json)


if __name__ == "__main__":
    main()
