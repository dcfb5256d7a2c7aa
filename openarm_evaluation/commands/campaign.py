# SPDX-License-Identifier: Apache-2.0
"""`openarm campaign`: many seeded scenes, judged by ground truth, with intervals and everything about each failure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from openarm_bringup.outcome import Outcome, console
from openarm_common.errors import Code

if TYPE_CHECKING:
    from openarm_evaluation.campaign.options import CampaignOptions


def campaign(
    *,
    seeds: str = "0-9",
    suite: str = "nominal",
    set_: Annotated[tuple[str, ...], Parameter(name="--set")] = (),
    workers: int = 1,
    noise: bool = False,
    mount_seeds: str | None = None,
    effort: Annotated[bool, Parameter(negative="--no-effort")] = True,
    detector: Literal["color", "network", "both"] = "color",
    ray: str = "",
    graph: bool = False,
    against: Path | None = None,
    out: Path | None = None,
    accept: float = 0.99,
) -> Outcome:
    """Run seeded scenes faster than real time, without DDS, through the code that the nodes run, with their parameters.

    Leaves a folder with campaign.json, .csv, .html and, of every scene that did not go as expected, pictures, cloud,
    joint trace and reason. With --out of an earlier run, the seeds that are done are not run again.

    Args:
        seeds: Such as 0-99 or 1,4,7-9.
        suite: nominal, clutter, faults, endurance, handover, push, pairs or pairs_in_turn.
        set_: A parameter of a node of the graph `sim`, as node.param=value; may be given several times.
        workers: Processes.
        noise: Depth as noisy as a D435's.
        mount_seeds: True camera mounts to go through, such as 1-10; each is calibrated first. Nominal when not given.
        effort: Whether the force of the fingers counts as evidence.
        detector: What finds objects: their colour, the network, or both checking each other.
        ray: Address of a Ray cluster, such as HOST:6379 or auto, whose machines share the workers.
        graph: Through a node graph of its own, over DDS and in real time, instead of in one process.
        against: Folder of another campaign; agreement on the scenes of both is reported, and accepted by the same
            share.
        out: Folder of the campaign; a new one below runs/ when not given.
        accept: Share of scenes that must go as expected.
    """
    from openarm_bringup.supervision import runs
    from openarm_evaluation.campaign.agree import rows_of
    from openarm_evaluation.campaign.options import CampaignOptions
    from openarm_evaluation.demo.demo import parse_seeds

    options = CampaignOptions(
        set_name=suite,
        parameters=set_,
        seeds=parse_seeds(seeds),
        workers=max(1, workers),
        noise=noise,
        mount_seeds=parse_seeds(mount_seeds) if mount_seeds is not None else (),
        use_effort=effort,
        detector=detector,
        ray=ray,
    )
    folder = out if out is not None else runs.new_run_dir()
    others = rows_of(against) if against is not None else []
    return _run(options, folder.resolve(), accept, graph=graph, others=others)


def _run(
    options: CampaignOptions, folder: Path, accept: float, *, graph: bool, others: Sequence[Mapping[str, Any]]
) -> Outcome:
    from openarm_evaluation.campaign.agree import compare, text_of
    from openarm_evaluation.campaign.campaign import run_campaign, write_reports
    from openarm_evaluation.campaign.progress import Watch
    from openarm_evaluation.campaign.report import figures
    from openarm_evaluation.campaign.ros.graph import rows_of_graph

    with Watch(len(options.seeds), console()) as watch:
        result = run_campaign(options, folder, watch.show, watch.begin, rows_of_graph if graph else None)
    data = write_reports(result)
    text = "\n".join(f"{name:<44} {value}" for name, value in figures(data))
    good = sum(bool(row["as_expected"]) for row in result.rows)
    summary = data["summary"]
    success = bool(result.rows) and good >= accept * len(result.rows) and summary["false_success"] == 0
    message = f"{good} of {len(result.rows)} scenes went as expected. Report: {folder}/campaign.html"
    out = {"folder": str(folder), **{key: data[key] for key in ("summary", "settings", "scenes_per_hour", "wall_s")}}
    if others:
        out["agreement"] = agreement = compare(result.rows, others)
        text += "\n" + text_of(agreement)
        success = success and agreement["agree"]["rate"] >= accept
    return Outcome(success, message, Code.OK if success else Code.PLACE_FAILED, out, text)
