# SPDX-License-Identifier: Apache-2.0
"""Whether the same seed gives the same run, bit by bit, on an idle machine and next to busy processes.

    python -m benchmarks.determinism [--quick] [--runs N] [--set NAME] [--seed S] [--tasks N] [--noise] [--json PATH]

Runs the tasks of a campaign N times in process, each time in a new process, the last time next to one busy process for
each core. Prints for each run the SHA-256 of all joint positions and efforts at every control tick (exact, not rounded)
and of the rows of the report (without wall times), and exits with 1 when they differ. It holds for one machine and one
set of versions. Nodes that meet over DDS never repeat to the last bit, because messages arrive when they arrive.

    distinct_motions   different hashes of the joint positions and efforts, 1 when all runs are equal
    distinct_rows      different hashes of the rows
    speed              simulated seconds per second of wall time, of the slowest run
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.report import Row, write_report
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.suites import make_task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig

#: Keys of a row that depend on the wall clock.
_WALL = frozenset({"wall_s", "planning_ms_median"})


@dataclass(frozen=True)
class Run:
    """What a run of some tasks came to.

    Attributes:
        motion: SHA-256 of joint positions and efforts at every tick.
        rows: SHA-256 of the rows without wall times.
        codes: Outcome of each task.
        sim_s: Simulated time.
        wall_s: Wall time.
    """

    motion: str
    rows: str
    codes: tuple[str, ...]
    sim_s: float
    wall_s: float


def run_tasks(set_name: str, seeds: Sequence[int], noise: bool) -> Run:
    """Run tasks of a campaign in this process.

    Args:
        set_name: Set of tasks, as `openarm campaign --suite`.
        seeds: One task each.
        noise: Whether depth is as noisy as a D435's.
    """
    motion, rows = hashlib.sha256(), hashlib.sha256()
    codes: list[str] = []
    sim_s, began = 0.0, time.monotonic()
    for seed in seeds:
        trials = Trials(make_task(set_name, seed), SimulatedSenses(depth_noise=noise), GraspConfig())
        row = trials.run()
        for t_ns, position, effort in trials.robot.trace:
            motion.update(t_ns.to_bytes(8, "little") + position.tobytes() + effort.tobytes())
        rows.update(json.dumps(_without_wall_times(row), sort_keys=True).encode())
        codes.append(row["code"])
        sim_s += trials.robot.t_ns * 1e-9
    return Run(motion.hexdigest(), rows.hexdigest(), tuple(codes), sim_s, time.monotonic() - began)


def _without_wall_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_wall_times(item) for key, item in value.items() if key not in _WALL}
    return [_without_wall_times(item) for item in value] if isinstance(value, list) else value


def run_in_new_process(set_name: str, seeds: Sequence[int], noise: bool = False) -> Run:
    """As `run_tasks`, in a process that has computed nothing before."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(run_tasks, set_name, seeds, noise).result()


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """Keep cores busy."""
    started = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def main() -> int:
    """Run it; 0 when all runs are equal."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="one task")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--suite", default="nominal")
    parser.add_argument("--seed", type=int, default=0, help="of the first task")
    parser.add_argument("--tasks", type=int, default=5)
    parser.add_argument("--noise", action="store_true", help="depth as noisy as a D435's")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    seeds = range(args.seed, args.seed + (1 if args.quick else args.tasks))
    runs: list[Run] = []
    for k in range(args.runs):
        disturbed = k == args.runs - 1
        with busy((os.cpu_count() or 1) if disturbed else 0):
            run = run_in_new_process(args.suite, seeds, args.noise)
        runs.append(run)
        print(f"run {k + 1}{' next to busy processes' if disturbed else ''}: {', '.join(run.codes)}")
        print(f"  joints  {run.motion}")
        print(f"  rows    {run.rows}")
        print(f"  {run.sim_s:.2f} s simulated in {run.wall_s:.1f} s", flush=True)
    motions, rows = len({run.motion for run in runs}), len({run.rows for run in runs})
    write_report(
        [
            Row("distinct_motions", motions, "", "lower", 1, n=len(runs)),
            Row("distinct_rows", rows, "", "lower", 1, n=len(runs)),
            Row("speed", min(run.sim_s / run.wall_s for run in runs), "", "higher", None, n=len(runs)),
        ],
        args.json,
    )
    return 0 if motions == rows == 1 else 1


if __name__ == "__main__":
    sys.exit(main())
