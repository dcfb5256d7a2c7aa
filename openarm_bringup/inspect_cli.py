# SPDX-License-Identifier: Apache-2.0
"""`openarm ps` and `openarm logs`: what runs now, and what it says."""

from __future__ import annotations

import sys
import time
from collections import deque
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from openarm_bringup import runs
from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError


def ps(*, seconds: float = 0.5) -> Outcome:
    """List the running graphs and their nodes, with the CPU and memory of each.

    Args:
        seconds: How long the CPU is measured.
    """
    import psutil

    records = runs.running()
    if not records:
        return Outcome(True, "no graph is running; start one with `openarm up`", data={"graphs": []})
    processes: dict[int, psutil.Process] = {}
    for pid in (node.pid for record in records for node in record.nodes.values()):
        if pid is not None and psutil.pid_exists(pid):
            processes[pid] = psutil.Process(pid)
            processes[pid].cpu_percent()
    time.sleep(seconds)  # the time over which the CPU is measured
    graphs: list[dict[str, Any]] = []
    lines: list[str] = []
    for record in records:
        nodes = {name: {**node.model_dump(), **_usage(processes, node.pid)} for name, node in record.nodes.items()}
        graphs.append({**record.model_dump(), "nodes": nodes})
        state = "ready" if record.ready else "not ready"
        lines.append(f"{record.graph}: {state}, domain {record.domain}, supervisor {record.pid}, {record.run_dir}")
        lines.append(f"  {'node':<24}{'state':<10}{'pid':>8}{'cpu %':>8}{'MiB':>8}{'restarts':>10}")
        for name, node in nodes.items():
            lines.append(
                f"  {name:<24}{node['state']:<10}{node['pid'] or '-':>8}{node['cpu_percent']:>8.1f}"
                f"{node['rss_mib']:>8.0f}{node['restarts']:>10}"
            )
    return Outcome(True, data={"graphs": graphs}, text="\n".join(lines))


def _usage(processes: dict[int, Any], pid: int | None) -> dict[str, float]:
    import psutil

    try:
        if pid in processes:
            return {
                "cpu_percent": processes[pid].cpu_percent(),
                "rss_mib": processes[pid].memory_info().rss / 2**20,
            }
    except psutil.NoSuchProcess:
        pass  # it ended while we looked; shown like one that does not run
    return {"cpu_percent": 0.0, "rss_mib": 0.0}


def logs(
    node: str | None = None,
    *,
    follow: Annotated[bool, Parameter(name=["--follow", "-f"], negative=())] = False,
    lines: Annotated[int, Parameter(name=["--lines", "-n"])] = 50,
    run: str = "latest",
) -> Outcome:
    """Print the log of a node (of the graph that runs, or of the last one).

    Args:
        node: Name of the node, or "supervisor"; without one, the logs are listed.
        follow: Go on with what is added, until Ctrl-C.
        lines: How many lines from the end to begin with.
        run: Name of a run below runs/.
    """
    folder = _log_folder(run)
    names = sorted(path.stem for path in folder.glob("*.log"))
    if node is None:
        return Outcome(True, f"logs in {folder}: {', '.join(names)}", data={"folder": str(folder), "logs": names})
    path = folder / f"{node}.log"
    if not path.is_file():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{folder} has no log of {node!r}; it has {', '.join(names)}")
    with path.open(encoding="utf-8", errors="replace") as log:
        last = list(deque(log, maxlen=lines))
        if not follow:
            return Outcome(
                True, data={"log": str(path), "lines": [line.rstrip("\n") for line in last]}, text="".join(last)
            )
        sys.stdout.writelines(last)
        try:
            while True:
                more = log.read()
                sys.stdout.write(more)
                sys.stdout.flush()
                if not more:
                    time.sleep(0.2)
        except KeyboardInterrupt:
            return Outcome(True, data={"log": str(path)})


def _log_folder(run: str) -> Path:
    if run == "latest":
        records = runs.running()
        if records:
            return Path(records[-1].run_dir) / "logs"
    folder = runs.runs_root() / run / "logs"
    if not folder.is_dir():
        existing = sorted(path.name for path in runs.runs_root().glob("*/logs/.."))[-5:]
        found = f"; the last ones are {', '.join(existing)}" if existing else ""
        raise OpenArmError(Code.INVALID_ARGUMENT, f"there is no run {run!r} in {runs.runs_root()}{found}")
    return folder
