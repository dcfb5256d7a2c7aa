# SPDX-License-Identifier: Apache-2.0
"""`openarm ps` and `openarm logs`: running graphs and their logs."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from openarm_bringup.outcome import Outcome, show
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import printable

if TYPE_CHECKING:
    import psutil


def ps(*, seconds: float = 0.3) -> Outcome:
    """List the running graphs: CPU and memory of each node (and of what it has started), and what it says is wrong.

    Args:
        seconds: Time for which the CPU is measured, s.
    """
    from openarm_bringup.supervision import runs

    records = runs.running()
    if not records:
        return Outcome(True, "no graph is running; start one with `openarm up`", data={"graphs": []})
    processes: dict[int, list[psutil.Process]] = {}
    for pid in (node.pid for record in records for node in record.nodes.values()):
        if pid is not None:
            processes[pid] = _family(pid)
    time.sleep(seconds)  # the time over which the CPU is measured
    graphs: list[dict[str, Any]] = []
    lines: list[str] = []
    for record in records:
        usage = {name: _usage(processes.get(node.pid or 0, [])) for name, node in record.nodes.items()}
        nodes = {name: {**node.model_dump(), **usage[name]} for name, node in record.nodes.items()}
        graphs.append({**record.model_dump(), "health": record.health, "nodes": nodes})
        lines.append(
            f"{record.graph}: {record.health}, robot {record.robot}, domain {record.domain}, supervisor {record.pid},"
            f" {record.run_dir}"
        )
        lines.append(f"  {'node':<24}{'state':<10}{'pid':>8}{'cpu %':>8}{'MiB':>8}{'restarts':>10}")
        for name, node in nodes.items():
            lines.append(
                f"  {name:<24}{node['state']:<10}{node['pid'] or '-':>8}{node['cpu_percent']:>8.1f}"
                f"{node['rss_mib']:>8.0f}{node['restarts']:>10}"
            )
            if node["trouble"]:
                lines.append(f"    {printable(str(node['trouble']))}")
    return Outcome(True, data={"graphs": graphs}, text="\n".join(lines))


def _family(pid: int) -> list[psutil.Process]:
    """A process and its children, with the CPU measured from now on; empty when it has ended."""
    import psutil

    try:
        parent = psutil.Process(pid)
        members = [parent, *parent.children(recursive=True)]
        for member in members:
            member.cpu_percent()
    except psutil.NoSuchProcess:
        return []
    return members


def _usage(members: list[psutil.Process]) -> dict[str, float]:
    import psutil

    usage = {"cpu_percent": 0.0, "rss_mib": 0.0}
    for member in members:
        try:
            usage["cpu_percent"] += member.cpu_percent()
            usage["rss_mib"] += member.memory_info().rss / 2**20
        except psutil.NoSuchProcess:
            continue  # it has ended meanwhile; shown like one that does not run
    return usage


def logs(
    node: str | None = None,
    *,
    follow: Annotated[bool, Parameter(name=["--follow", "-f"])] = False,
    lines: Annotated[int, Parameter(name=["--lines", "-n"])] = 50,
    run: str = "latest",
) -> Outcome:
    """Print the log of a node (of the graph that runs, or of the last one).

    Args:
        node: Name of the node, or "supervisor"; without one, the logs are listed.
        follow: Go on with what is added, until Ctrl-C.
        lines: Number of lines from the end to begin with.
        run: Name of a run below runs/.
    """
    folder = _log_folder(run, node)
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
        show("".join(last))
        try:
            while True:
                more = log.read()
                show(more)
                if not more:
                    time.sleep(0.2)
        except KeyboardInterrupt:
            return Outcome(True, data={"log": str(path)})


def _log_folder(run: str, node: str | None) -> Path:
    """The newest graph that runs and has the node, else the folder of the run."""
    from openarm_bringup.supervision import runs

    if run == "latest":
        records = runs.running()
        having = [record for record in records if node in record.nodes] or records
        if having:
            return Path(having[-1].run_dir) / "logs"
    folder = runs.runs_root() / run / "logs"
    if not folder.is_dir():
        existing = sorted(path.name for path in runs.runs_root().glob("*/logs/.."))[-5:]
        if not existing:
            raise OpenArmError(Code.NOT_READY, f"nothing has run yet: no logs in {runs.runs_root()}; see `openarm up`")
        last = ", ".join(existing)
        raise OpenArmError(Code.INVALID_ARGUMENT, f"there is no run {run!r} in {runs.runs_root()}; the last: {last}")
    return folder
