# SPDX-License-Identifier: Apache-2.0
"""`openarm chaos`: picks one after another while nodes are killed, stopped and flooded; judged by ground truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from openarm_bringup.commands.connect import Robot
from openarm_bringup.outcome import Outcome, console
from openarm_common.errors import Code
from openarm_common.robot.folder import choose_robot, robot_name


def chaos(
    *,
    minutes: float = 10.0,
    seed: int = 0,
    faults: tuple[str, ...] = (),
    rounds: int | None = None,
    plot: Path | None = None,
    out: Path | None = None,
    robot: Robot = None,
) -> Outcome:
    """Pick objects on a graph of its own while a seeded schedule of faults runs, and hold what must never happen.

    No object falls; no answer claims what is not so, and a failure names its cause; every request is answered within
    its bound; the graph is back within 15 s; no arm moves without a request, and one that is held obeys its holder
    alone; nothing is left after the end. The exit code is 1 when one of them did not hold, or the run was cut short.
    The same seed gives the same requests and faults.

    Args:
        minutes: Duration; a request that has begun is finished.
        seed: Seed of scenes, requests and faults.
        faults: Kinds of faults: kill, stop, commands, services, disk, camera, joints, detector, plans, intruder,
            rival; all when not given; none.
        rounds: Requests at most.
        plot: PNG of the memory, descriptors and threads of each node over time.
        out: Folder for logs, report and memory; a new one below runs/ when not given.
    """
    choose_robot(robot)
    from openarm_bringup.supervision import runs
    from openarm_evaluation.chaos.ros.actors import mount_small
    from openarm_evaluation.chaos.ros.runner import run
    from openarm_evaluation.chaos.schedule import known_kinds
    from openarm_evaluation.chaos.usage import draw, growth

    kinds, page = known_kinds(faults), console()
    folder = (out or runs.new_run_dir()).resolve()
    (folder / "run").mkdir(parents=True, exist_ok=True)
    if "disk" in kinds and not mount_small(folder / "run"):
        page.print("disk: left out: no file system can be mounted without the rights to do so", markup=False)
        kinds = tuple(kind for kind in kinds if kind != "disk")

    def show(row: dict[str, Any]) -> None:
        answer = f"{row['label']}: {row['code']} after {row['seconds']} s"
        page.print(f"{row['round']:>4}  {row['fault'] or 'no fault'}; {answer}", markup=False, soft_wrap=True)
        for violation in row["violations"]:
            page.print(f"      {violation['rule']}: {violation['text']}", style="red", markup=False)

    report = run(seed, 60.0 * minutes, kinds, folder, show, rounds)
    uses = report.usage.uses if report.usage else []
    found = {
        "folder": str(folder),
        "robot": robot_name(),
        "seed": seed,
        "seconds": report.seconds,
        "requests": len(report.rounds),
        "placed": sum(row["code"] == "OK" for row in report.rounds),
        "faults": report.faults(),
        "in_the_wanted_state": sum(row["reached"] for row in report.rounds),
        "growth_mib_per_hour": growth(uses),
        "violations": report.violations,
        "cut_short": report.cut,
    }
    (folder / "chaos.json").write_text(json.dumps({**found, "rounds": report.rounds}, indent=1), encoding="utf-8")
    if plot is not None:
        draw(uses, plot)
    text = "\n".join(f"{kind:<12} {count}" for kind, count in report.faults().items())
    number, most = len(report.violations), f"{len(report.rounds)} requests, {sum(report.faults().values())} faults"
    most += f" ({found['in_the_wanted_state']} in the state that was wanted)"
    message = f"{most}, {number} violations. Report: {folder}/chaos.json"
    if report.cut:
        message = f"cut short after {report.seconds:.0f} s: {report.cut}; {message}"
    return Outcome(not number and not report.cut, message, Code.VIOLATION if number else report.code, found, text)
