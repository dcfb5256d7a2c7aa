# SPDX-License-Identifier: Apache-2.0
"""`openarm campaign`: many seeded scenes, judged by ground truth, with intervals and everything about each failure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from openarm_bringup.outcome import Outcome, console
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import choose_robot
from openarm_evaluation.campaign.options import CampaignOptions, Detectors

DEFAULTS = CampaignOptions()


def campaign(
    *,
    options: CampaignOptions = DEFAULTS,
    detectors: Detectors = (),
    graph: bool = False,
    against: Path | None = None,
    out: Path | None = None,
    accept: float = 0.99,
) -> Outcome:
    """Run seeded scenes faster than real time, without DDS, through the code that the nodes run, with their parameters.

    Leaves a folder with campaign.json, .csv, .html and, of every scene that did not go as expected, pictures, cloud,
    joint trace and reason. With --out of an earlier run, the seeds that are done are not run again.

    Args:
        detectors: Several, such as color,both: all scenes with each, in folders below, and one report with the rate of
            each.
        graph: Through a node graph of its own, over DDS and in real time, instead of in one process.
        against: Folder of another campaign; agreement on the scenes of both is reported, and accepted by the same
            share.
        out: Folder of the campaign; a new one below runs/ when not given.
        accept: Share of scenes that must go as expected.
    """
    choose_robot(options.robot)
    from openarm_bringup.supervision import runs
    from openarm_evaluation.campaign.agree import compare, rows_of, text_of
    from openarm_evaluation.campaign.campaign import Campaign, joined, run_campaign
    from openarm_evaluation.campaign.progress import Watch
    from openarm_evaluation.campaign.report import figures
    from openarm_evaluation.campaign.ros.graph import rows_of_graph

    if detectors and against is not None:
        raise OpenArmError(Code.INVALID_ARGUMENT, "--against compares one campaign with another; leave --detectors out")
    if (options.controllers != "suite" or options.emulated) and not (graph and options.profile == "openarm"):
        asked = "--hardware emulated" if options.emulated else f"--controllers {options.controllers}"
        text = f"{asked} needs --graph and the profile openarm"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{text}: it is of the robot as owners have it, over DDS")
    folder = (out or runs.new_run_dir()).resolve()
    others = rows_of(against) if against is not None else []
    runner, parts = rows_of_graph if graph else None, list[Campaign]()
    for kind in detectors or (options.finder,):
        below = folder / kind if detectors else folder
        with Watch(len(options.seeds), console()) as watch:
            part = replace(options, detector=kind)
            parts.append(run_campaign(part, below, watch.show, watch.begin, runner))
    result = joined(parts, folder) if detectors else parts[0]
    data = result.report
    text = "\n".join(f"{name:<44} {value}" for name, value in figures(data))
    good = sum(bool(row["as_expected"]) for row in result.rows)
    summary = data["summary"]
    success = bool(result.rows) and good >= accept * len(result.rows) and summary["false_success"] == 0
    message = f"{good} of {len(result.rows)} scenes went as expected. Report: {folder}/campaign.html"
    found = {"folder": str(folder), **{key: data[key] for key in ("summary", "settings", "scenes_per_hour", "wall_s")}}
    if others:
        found["agreement"] = agreement = compare(result.rows, others)
        text += "\n" + text_of(agreement)
        success = success and agreement["agree"]["rate"] >= accept
    return Outcome(success, message, Code.OK if success else Code.PLACE_FAILED, found, text)
