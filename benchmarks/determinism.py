# SPDX-License-Identifier: Apache-2.0
"""Whether the same seed gives the same run in lock-step, on an idle machine and beside a busy one.

    python -m benchmarks.determinism [--quick] [--runs N] [--scene NAME] [--seed S] [--timeout T] [--json PATH]

Starts the graph `lockstep` N times with the same seed, the last time beside one busy process for each core; each run
grasps the first object of the scene. Prints for each run the SHA-256 of every joint state (stamp, positions rounded to
1e-9) and of every transition of the grasp (stamp, states, reason), and exits with 1 when they differ. It holds for one
machine and one set of versions.

    lockstep_distinct_motions   different hashes of the joint states, 1 when all runs are equal
    lockstep_distinct_logs      the same of the grasp's transitions
    lockstep_speed              simulated seconds a wall second, of the slowest run
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.report import Row, write_report
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.keeper import NodeState
from openarm_bringup.supervision.session import running_graph
from openarm_common.domain import release_domain, reserve_domain
from openarm_common.scene.scene import load_scene


async def run_once(scene: str, seed: int, folder: Path, timeout: float) -> dict[str, Any]:
    """Run the script once; return what it wrote, and `wall_s` since the graph was ready.

    Raises:
        OpenArmError: what ended a node.
    """
    domain = reserve_domain()
    result, label = folder / "script.json", load_scene(scene, seed).objects[0].label
    sets = (
        f"script.result={result}",
        f"script.labels=[{label}]",
        f"mujoco_bridge.barrier.timeout={timeout}",
    )
    try:
        graph = load_graph("lockstep", overrides={"scene": scene, "seed": seed, "domain": domain}, sets=sets)
        async with running_graph(graph, folder) as supervisor:
            await supervisor.wait_ready()
            began = time.monotonic()
            trouble = asyncio.create_task(supervisor.wait_stop_asked())
            while supervisor.states()["script"] != NodeState.EXITED:
                await asyncio.wait({trouble}, timeout=0.1)
                if trouble.done():
                    trouble.result()
                    raise KeyboardInterrupt
            trouble.cancel()
            wall_s = time.monotonic() - began
    finally:
        release_domain(domain)
    return {**json.loads(result.read_text(encoding="utf-8")), "wall_s": wall_s}


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
    parser.add_argument("--quick", action="store_true", help="two runs, one of them beside a busy machine")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--scene", default="demo")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timeout", type=float, default=10.0, help="of an answer to a tick, s")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    runs: list[dict[str, Any]] = []
    count = 2 if args.quick else args.runs
    for k in range(count):
        disturbed = k == count - 1
        with tempfile.TemporaryDirectory() as folder, busy((os.cpu_count() or 1) if disturbed else 0):
            found = asyncio.run(run_once(args.scene, args.seed, Path(folder), args.timeout))
        runs.append(found)
        print(f"run {k + 1}{' beside busy processes' if disturbed else ''}: {found['answers'][0]['message']}")
        print(f"  joint states {found['joint_states']['n']:6d}  {found['joint_states']['sha256']}")
        print(f"  transitions  {found['grasp_states']['n']:6d}  {found['grasp_states']['sha256']}")
        print(f"  {found['sim_s']:.2f} s simulated in {found['wall_s']:.1f} s", flush=True)
    motions = {run["joint_states"]["sha256"] for run in runs}
    logs = {run["grasp_states"]["sha256"] for run in runs}
    speed = min(run["sim_s"] / run["wall_s"] for run in runs)
    rows = [
        Row("lockstep_distinct_motions", len(motions), "", "lower", 1, n=len(runs)),
        Row("lockstep_distinct_logs", len(logs), "", "lower", 1, n=len(runs)),
        Row("lockstep_speed", speed, "", "higher", None, n=len(runs)),
    ]
    write_report(rows, args.json)
    return 0 if len(motions) == len(logs) == 1 else 1


if __name__ == "__main__":
    sys.exit(main())
