# SPDX-License-Identifier: Apache-2.0
"""How fast the command line answers next to a graph: through its daemon, and by joining the graph itself.

    python benchmarks/cli.py [--quick] [--runs N] [--graph NAME] [--json PATH]

Starts the graph `sim`, then runs each command N times by each way, as a shell does, from the start of the process to
its end. Prints medians and the slowest; `--quick` takes three runs. Run it on an idle machine: the load is printed. The
rates of topics need the time over which they are measured (--seconds), which is left out of the figure.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from benchmarks.report import Row, write_report
from openarm_bringup.daemon.client import DIRECT
from openarm_common.domain import reserve_domain

ROOT = Path(__file__).parents[1]
#: Seconds a command may take, and the part of them over which it measures.
LOOK, HELP, DOCTOR = 0.7, 0.3, 4.0
COMMANDS: dict[str, tuple[float, float]] = {
    "--help": (HELP, 0.0),
    "topic list": (LOOK, 0.0),
    "topic info /joint_states": (LOOK, 0.0),
    "topic type /joint_states": (LOOK, 0.0),
    "topic echo /joint_states -n 1": (LOOK, 0.0),
    "topic hz /joint_states --seconds 1": (LOOK, 1.0),
    "node list": (LOOK, 0.0),
    "node info mujoco_bridge": (LOOK, 0.0),
    "param list grasp": (LOOK, 0.0),
    "param get grasp approach.lift_height": (LOOK, 0.0),
    "param set detector detector color": (LOOK, 0.0),
    "param dump grasp": (LOOK, 0.0),
    "service list": (LOOK, 0.0),
    "service type /motion/get_scene": (LOOK, 0.0),
    "service call /motion/get_scene": (LOOK, 0.0),
    "action list": (LOOK, 0.0),
    "tf echo world wrist_link": (LOOK, 0.0),
    "ps": (LOOK, 0.0),
    "doctor": (DOCTOR, 0.0),
}


def seconds_of(line: str, env: dict[str, str]) -> float:
    """Run a command and return how long that took, s."""
    command = [sys.executable, "-m", "openarm_bringup.cli", *line.split()]
    began = time.perf_counter()
    done = subprocess.run(command, env=env, cwd=ROOT, capture_output=True, text=True, timeout=120.0, check=False)
    took = time.perf_counter() - began
    if done.returncode and line != "doctor":  # which also says what the machine lacks
        sys.exit(f"`openarm {line}` failed: {done.stderr}")
    return took


def measure(env: dict[str, str], runs: int) -> list[Row]:
    """Run every command by both ways, and print the table."""
    rows: list[Row] = []
    print(f"{'command':<40}{'daemon, s':>10}{'slowest':>9}{'direct, s':>11}{'slowest':>9}{'ratio':>7}{'target':>8}")
    for line, (target, waits) in COMMANDS.items():
        by_daemon = sorted(seconds_of(line, env) - waits for _ in range(runs))
        direct = sorted(seconds_of(line, {**env, DIRECT: "1"}) - waits for _ in range(max(1, runs // 3)))
        ours, peer = median(by_daemon), median(direct)
        figures = f"{ours:>10.2f}{by_daemon[-1]:>9.2f}{peer:>11.2f}{direct[-1]:>9.2f}{peer / ours:>7.1f}{target:>8.1f}"
        print(f"{line:<40}{figures}{'' if ours <= target else '  too slow'}", flush=True)
        metric = "cli_" + "_".join(word.strip("-/") for word in line.split()[:2]) + "_s"
        rows.append(Row(metric, ours, "s", "lower", target, "direct", peer, runs))
    return rows


def main() -> None:
    """Start a graph, measure, stop it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="three runs of each command")
    parser.add_argument("--runs", type=int, default=9, help="runs of each command through the daemon")
    parser.add_argument("--graph", default="sim")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        env = {**os.environ, "XDG_RUNTIME_DIR": folder, "OPENARM_RUNS": folder, "ROS_DOMAIN_ID": str(reserve_domain())}
        env["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        command = [sys.executable, "-m", "openarm_bringup.cli", "up", arguments.graph]
        up = subprocess.Popen(command, env=env, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        assert up.stderr is not None
        try:
            for line in up.stderr:
                if f"{arguments.graph} is ready" in line:
                    break
            else:
                sys.exit("the graph did not start")
            while seconds_of("topic list", env) > LOOK and up.poll() is None:
                pass  # the daemon is being started, and the graph settles
            print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores, graph {arguments.graph}")
            rows = measure(env, 3 if arguments.quick else arguments.runs)
        finally:
            up.send_signal(signal.SIGINT)
            up.communicate(timeout=60.0)
    write_report(rows, arguments.json)


if __name__ == "__main__":
    main()
