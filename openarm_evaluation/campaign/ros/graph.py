# SPDX-License-Identifier: Apache-2.0
"""The same campaign through the node graph: every request over DDS, in real time, judged by the same rules."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from openarm_bringup.supervision import environment
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.session import in_thread, running_graph
from openarm_common.domain import reserve_domain
from openarm_common.errors import Code, OpenArmError
from openarm_evaluation.campaign.campaign import Campaign, keep_row, read_rows, write_reports
from openarm_evaluation.campaign.gap import least_gap
from openarm_evaluation.campaign.options import CampaignOptions, Row
from openarm_evaluation.campaign.sets import make_task
from openarm_evaluation.campaign.tasks import Task
from openarm_evaluation.campaign.trial import add_gap, crashed_row, row_of
from openarm_evaluation.judging.trial import Ask, run_pair, run_trial

if TYPE_CHECKING:
    from openarm_evaluation.judging.ros.observer import Observer
    from openarm_grasp.ros.client import GraspClient

#: Sets without faults on purpose, and in which what is asked for does not depend on what became of it before.
GRAPH_SETS = ("nominal", "handover", "push", "pairs", "pairs_in_turn")


def run_graph_campaign(
    options: CampaignOptions,
    folder: Path,
    on_row: Callable[[Row], None] = lambda row: None,
    on_begin: Callable[[int], None] = lambda done: None,
) -> Campaign:
    """Run all seeds that the folder has no row of through a graph of its own, and write the reports.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for what only the campaign in one process can do; whatever ends the graph.
    """
    if options.set_name not in GRAPH_SETS or len(options.mount_seeds) > 1 or options.workers != 1:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"a campaign through the graph runs the sets {', '.join(GRAPH_SETS)} with one worker and at most one mount"
            f" seed; asked for {options.set_name!r}, {options.workers} workers, mount seeds {options.mount_seeds}",
        )
    campaign = Campaign(folder, options, read_rows(folder, options))
    campaign.resumed = len(campaign.rows)
    on_begin(campaign.resumed)
    done = {row["seed"] for row in campaign.rows}
    tasks = [make_task(options.set_name, seed) for seed in options.seeds if seed not in done]
    began = time.monotonic()
    try:
        if tasks:
            asyncio.run(_run(campaign, tasks, on_row))
    finally:
        campaign.wall_s = time.monotonic() - began
        write_reports(campaign)
    return campaign


async def _run(campaign: Campaign, tasks: list[Task], on_row: Callable[[Row], None]) -> None:
    options = campaign.options
    overrides: dict[str, Any] = {"domain": reserve_domain(), "scene": "random", "seed": tasks[0].seed}
    if options.mount_seeds:
        overrides["mount_seed"] = options.mount_seeds[0]
    sets = [f"mujoco_bridge.depth_noise.enabled={str(options.noise).lower()}"]
    sets.append(f"grasp.held.use_effort={str(options.use_effort).lower()}")
    sets += [f"{node}.detector={options.detector}" for node in ("detector", "wrist_detector")]
    graph = load_graph("sim", overrides=overrides, sets=tuple(sets))
    for name in ("logs", "params"):
        (campaign.folder / name).mkdir(parents=True, exist_ok=True)
    # Clients made in this process find the graph through the environment.
    os.environ.update(environment.ros_environment(graph))
    async with running_graph(graph, campaign.folder) as supervisor:
        await supervisor.wait_ready()
        from openarm_evaluation.judging.ros.observer import Observer
        from openarm_grasp.ros.client import GraspClient

        with Observer(environment.domain_id(graph)) as observer, GraspClient() as client:

            def work() -> None:
                for task in tasks:
                    row = _row(observer, client, task, campaign.folder / "scenes")
                    row["again"] = f"{options.command(task.seed)} --graph"
                    keep_row(campaign, row)
                    on_row(row)

            trials = in_thread(work, "trials")
            stop = asyncio.create_task(supervisor.wait_stop_asked())
            await asyncio.wait([trials, stop], return_when=asyncio.FIRST_COMPLETED)
            try:
                if not trials.done():
                    client.cancel()
                    await asyncio.wait([trials], timeout=5.0)
                    stop.result()
                    raise OpenArmError(Code.CANCELLED, "stopped by Ctrl-C")
                trials.result()
            finally:
                stop.cancel()


def _row(observer: Observer, client: GraspClient, task: Task, scenes: Path) -> Row:
    began = time.monotonic()
    scenes.mkdir(exist_ok=True)
    file = scenes / f"{task.scene.name}.yaml"
    file.write_text(yaml.safe_dump(task.scene.model_dump(mode="json"), sort_keys=False), encoding="utf-8")
    try:
        after_ns = observer.reset_world(str(file), task.seed)
        if task.together:
            trials = run_pair(observer, client, task.scene, task.labels, seed=task.seed, after_ns=after_ns)
        else:
            asks = [Ask(label, task.arm, task.place) for label in task.labels]
            trials = [
                run_trial(observer, client, task.scene, ask, seed=task.seed, after_ns=after_ns, moved=k > 0)
                for k, ask in enumerate(asks)
            ]
    except OpenArmError as error:
        return crashed_row(task, error)
    row = row_of(task, trials, time.monotonic() - began)
    if task.together:
        states, steps = observer.joints(), observer.steps()
        add_gap(row, least_gap(states), (steps[-1].t_ns - steps[0].t_ns) * 1e-9)
    return row
