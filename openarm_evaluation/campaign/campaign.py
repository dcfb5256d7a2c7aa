# SPDX-License-Identifier: Apache-2.0
"""Campaigns: many tasks by seed, on one or more processes, with rows on disk as they come and resume.

The folder of a campaign holds `rows.jsonl` (one row a line, as they come), `campaign.json`, `campaign.csv`,
`campaign.html` and `failures/<seed>/`.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from openarm_bringup.supervision import runs
from openarm_common.config import load_json
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.robot.folder import DEFAULT
from openarm_evaluation.campaign import cluster, report
from openarm_evaluation.campaign.options import CampaignOptions, Row
from openarm_evaluation.campaign.parameters import suite_config
from openarm_evaluation.campaign.rows import ROWS, ReportRow, read_lines
from openarm_evaluation.campaign.tasks.suites import make_task
from openarm_evaluation.campaign.trial import run_one
from openarm_evaluation.judging import provenance


@dataclass
class Campaign:
    """What has come out so far."""

    folder: Path
    options: CampaignOptions
    rows: list[Row] = field(default_factory=list[Row])
    wall_s: float = 0.0
    resumed: int = 0
    report: dict[str, Any] = field(default_factory=dict[str, Any])


#: Runs seeds of a campaign in its folder, and hands on each row.
Runner = Callable[[CampaignOptions, Sequence[int], Path, Callable[[Row], None]], None]


def run_campaign(
    options: CampaignOptions,
    folder: Path,
    on_row: Callable[[Row], None] = lambda row: None,
    on_begin: Callable[[int], None] = lambda done: None,
    runner: Runner | None = None,
) -> Campaign:
    """Run all seeds that the folder has no row of, and write the reports; Ctrl-C keeps what is done.

    Args:
        options: Campaign to run.
        folder: Folder of the campaign.
        on_row: Called with each new row.
        on_begin: Called with the number of rows that are there already.
        runner: Runs the seeds; None does it in this process, or in processes of this or other machines.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for an unknown set, or a folder with rows of other settings; what a fault of
            the program did to one task is in its row.
    """
    for seed in options.seeds[:1]:
        make_task(options.set_name, seed, options.objects)  # faults of the call show before anything is started
    suite = suite_config(options.graph_parameters())
    detector = suite.detectors[suite.grasp.camera].detector  # as --set leaves it
    rows = [{"detector": detector} | row for row in read_rows(folder, options)]
    campaign = Campaign(folder, options, rows)
    campaign.resumed = len(campaign.rows)
    on_begin(campaign.resumed)
    done = {row["seed"] for row in campaign.rows}

    def keep(row: Row) -> None:
        row = {**row, "detector": detector}
        with (folder / ROWS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(row, default=str) + "\n")
        campaign.rows.append(row)
        on_row(row)

    began = time.monotonic()
    try:
        (runner or run_in_processes)(options, [seed for seed in options.seeds if seed not in done], folder, keep)
    finally:
        campaign.wall_s = time.monotonic() - began
        campaign.report = write_reports(campaign)
    return campaign


def joined(parts: Sequence[Campaign], folder: Path) -> Campaign:
    """Report campaigns of the same scenes with several detectors, which are in folders below, as one."""
    rows = [{**row, "folder": f"{part.folder.name}/"} for part in parts for row in part.rows]
    wall_s, resumed = sum(part.wall_s for part in parts), sum(part.resumed for part in parts)
    whole = Campaign(folder, parts[0].options, rows, wall_s, resumed)
    whole.report = write_reports(whole)
    return whole


def run_in_processes(options: CampaignOptions, seeds: Sequence[int], folder: Path, keep: Callable[[Row], None]) -> None:
    """Run seeds without DDS, in this process or in several; see `Runner`. With one worker, in the order of seeds."""
    if options.ray:
        with contextlib.closing(cluster.rows(options, seeds, folder)) as rows:
            for row in rows:
                keep(row)
        return
    if options.workers == 1:
        for seed in seeds:
            keep(run_one(options, seed, folder))
        return
    # Spawned, not forked: OpenGL and numba's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.workers, mp_context=context, initializer=_quiet_worker) as pool:
        futures = [pool.submit(run_one, options, seed, folder) for seed in seeds]
        try:
            for future in as_completed(futures):
                keep(future.result())
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def read_rows(folder: Path, options: CampaignOptions) -> list[Row]:
    """Rows of an earlier run in this folder, those of the asked seeds alone.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when they were made with other settings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kept, path = folder / "settings.json", folder / ROWS
    settings = options.settings()
    if kept.is_file():
        found = load_json(kept)
        before = {"robot": DEFAULT, **(found if isinstance(found, dict) else {})}  # older ones do not say it
        if before != settings:
            changed = ", ".join(
                f"{key} was {brief(before.get(key))}" for key in settings if before.get(key) != settings[key]
            )
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"{folder} holds rows of another campaign ({changed}); choose another --out"
            )
    runs.write_json(kept, settings)
    if not path.is_file():
        return []
    rows, whole = read_lines(path, ReportRow)
    if len(whole.encode()) != path.stat().st_size:  # the last line was being written when the power went
        path.write_text(whole, encoding="utf-8")
    return [row for row in rows if row["seed"] in set(options.seeds)]


def _quiet_worker() -> None:
    """Ctrl-C is for the parent; BLAS threads of many workers would fight over the cores."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(key, "1")


def write_reports(campaign: Campaign) -> dict[str, Any]:
    """Write JSON, CSV and HTML, and return what the JSON says."""
    rows = sorted(campaign.rows, key=lambda row: (row["seed"], row["detector"]))
    new, settings = len(rows) - campaign.resumed, campaign.options.settings()
    detectors = list(dict.fromkeys(row["detector"] for row in campaign.rows))
    if len(detectors) > 1:
        settings["detector"] = ", ".join(detectors)
    data: dict[str, Any] = {
        "settings": settings,
        "summary": report.summarise(rows),
        "asked": len(campaign.options.seeds) * max(len(detectors), 1),
        "wall_s": round(campaign.wall_s, 1),
        "scenes_per_hour": round(3600.0 * new / campaign.wall_s) if new and campaign.wall_s > 0.0 else None,
        "workers": campaign.options.workers,
        "machine": provenance.machine(),
        "versions": provenance.versions(),
        "rows": rows,
    }
    runs.write_json(campaign.folder / "campaign.json", data)
    report.write_csv(campaign.folder / "campaign.csv", rows)
    report.write_html(campaign.folder / "campaign.html", data)
    return data
