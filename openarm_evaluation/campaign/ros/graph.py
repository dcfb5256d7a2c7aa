# SPDX-License-Identifier: Apache-2.0
"""Rows of a campaign through the node graph: every request over DDS, in real time, judged by the same rules."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from openarm_interfaces.srv import SaveRecording
from std_srvs.srv import Empty

from openarm_bringup.supervision import environment
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.session import running_graph, work_until_stopped
from openarm_common.domain import reserve_domain
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_evaluation.campaign.dynamics import with_servos
from openarm_evaluation.campaign.hands import with_drawn_hands
from openarm_evaluation.campaign.options import CampaignOptions, Row
from openarm_evaluation.campaign.record import write_reason
from openarm_evaluation.campaign.tasks.suites import make_task
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import add_clearance, crashed_row, row_of
from openarm_evaluation.judging.arm_clearance import least_clearance
from openarm_evaluation.judging.trial import run_pair, run_trial
from openarm_grasp.requests.request import GraspRequest

if TYPE_CHECKING:
    from openarm_evaluation.judging.ros.observer import Observer
    from openarm_grasp.ros.client import GraspClient

#: Longest wait for a recording, s: a busy machine takes a while.
_WRITTEN_S = 60.0
#: So often an arm may try to get home.
_HOME_TRIES = 4
#: Sets without fault injection, in which a request does not depend on the outcome of those before.
GRAPH_SETS = ("nominal", "objects", "handover", "push", "pairs", "pairs_in_turn")


def rows_of_graph(options: CampaignOptions, seeds: Sequence[int], folder: Path, keep: Callable[[Row], None]) -> None:
    """Run the tasks of seeds through a graph of its own, in real time; `keep` is called with each row.

    Args:
        options: Campaign to run.
        seeds: One task each.
        folder: Folder of the campaign; it gets logs, parameters and scenes.
        keep: Takes a row.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for what only the campaign in one process can do; whatever ends the graph.
    """
    several = max(len(options.mount_seeds), len(options.hand_seeds)) > 1 or (
        options.profile != "ideal" and len(options.dynamics_seeds) != 1
    )
    if options.set_name not in GRAPH_SETS or several or options.workers != 1:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"a campaign through the graph runs the sets {', '.join(GRAPH_SETS)} with one worker and at most one"
            f" seed of mounts, hands and dynamics; asked for {options.set_name!r}, {options.workers} workers, mount"
            f" seeds {options.mount_seeds}, hand seeds {options.hand_seeds}, dynamics seeds {options.dynamics_seeds}",
        )
    if seeds:
        asyncio.run(_run(options, seeds, folder, keep))


async def _run(options: CampaignOptions, seeds: Sequence[int], folder: Path, keep: Callable[[Row], None]) -> None:
    overrides: dict[str, Any] = {"domain": reserve_domain(), "scene": "random", "seed": seeds[0]}
    if options.mount_seeds:
        overrides["mount_seed"] = options.mount_seeds[0]
    name = "real" if options.emulated else "sim" if options.controllers == "suite" else "openarm_ros2_sim"
    sets = (*options.graph_parameters(), *_robot(options, folder), *_hands(options, folder))
    graph = load_graph(name, overrides=overrides, sets=sets, emulate=options.emulated)
    for name in ("logs", "params", "scenes"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    async with running_graph(graph, folder) as supervisor:
        await supervisor.wait_ready()
        from openarm_evaluation.judging.ros.observer import Observer
        from openarm_grasp.ros.client import GraspClient

        with Observer(environment.domain_id(graph)) as observer, GraspClient() as client:

            def work() -> None:
                for seed in seeds:
                    if options.emulated:
                        bring_home(client)
                    task = with_drawn_hands(make_task(options.set_name, seed, options.objects), options)
                    row = _row(observer, client, task, folder / "scenes")
                    row = {**row, "again": f"{options.command(seed)} --graph"}
                    if not row["as_expected"]:
                        keep_recording(client, row, folder / "failures" / str(seed))
                    keep(row)

            await work_until_stopped(supervisor, work, client.cancel)


def _robot(options: CampaignOptions, folder: Path) -> tuple[str, ...]:
    """Return the parameters of the robot of the dynamics seed, whose servos are identified first."""
    if options.profile == "ideal":
        return ()
    servos = folder / "servos"
    task, _ = with_servos(make_task(options.set_name, options.seeds[0], options.objects), options, servos)
    seed = task.dynamics_seed
    known = (servos / str(seed)).absolute()
    carrying = (f"mujoco_bridge.calibrations={known}",)
    if options.emulated:
        carrying = (f"openarm_hardware.calibrations={known}", f"openarm_hardware.dynamics_seed={seed}")
    elif options.controllers != "suite":
        carrying = (f"arm_control.calibrations={known}", f"arm_control.dynamics_seed={seed}")
    return (f"mujoco_bridge.openarm.dynamics_seed={seed}", f"mujoco_bridge.openarm.zero_seed={seed}", *carrying)


def _hands(options: CampaignOptions, folder: Path) -> tuple[str, ...]:
    """Return the parameters of the hands of the hand seed, which the grasp learns before the first request."""
    if not options.hand_seeds:
        return ()
    drawn = f"mujoco_bridge.{options.profile}.hand_seed={options.hand_seeds[0]}"
    return (drawn, "grasp.hand.learn=true", f"grasp.calibrations={(folder / 'hands').absolute()}")


def bring_home(client: GraspClient) -> None:
    """Bring arms to where a scene is put before them: those of motors stay where they are when the world is reset.

    Raises:
        OpenArmError: Reason why an arm does not get there.
    """
    from openarm_bringup.ros.stop_client import release
    from openarm_motion.ros.client import MotionClient

    arms = RobotDescription.load().arm_names
    release(client)
    for arm in arms:
        client.release(arm)
    with MotionClient() as motion:
        for arm in arms:
            for left in range(_HOME_TRIES - 1, -1, -1):  # what fell out of a hand is on the map for a while
                client.call(Empty, "/octomap/reset", Empty.Request())
                found = motion.move_to_named(arm, "home", hand_empty=True)
                if found.success or not left:
                    found.raise_for_code()
                    break


def keep_recording(client: GraspClient, row: Row, folder: Path, timeout: float = _WRITTEN_S) -> None:
    """Keep what the flight recorder has of a task that did not go as expected, also one that the grasp calls a success.

    Args:
        client: Client of the graph.
        row: Row of the task.
        folder: Gets the recording and the row with its reason.
        timeout: Longest wait until the recording is complete, s of wall clock.
    """
    about = {key: row[key] for key in ("message", "set", "seed", "scene_hash", "again")}
    lines = [str(row["code"]), *(f"{key}: {' '.join(str(value).split())}" for key, value in about.items())]
    write_reason(folder, row)
    try:
        saved = client.call(SaveRecording, "/flight_recorder/save", SaveRecording.Request(reason="\n".join(lines)))
        if not saved.success:
            raise OpenArmError(Code(saved.code), saved.message)
        path, deadline = Path(saved.path), time.monotonic() + timeout
        while not path.exists():
            if time.monotonic() > deadline:
                raise OpenArmError(Code.TIMEOUT, f"{path} is not complete after {timeout:g} s")
            time.sleep(0.1)
        path.rename(folder / path.name)
    except OpenArmError as error:  # the campaign goes on without
        (folder / "no_recording.txt").write_text(f"{error}\n", encoding="utf-8")


def _row(observer: Observer, client: GraspClient, task: Task, scenes: Path) -> Row:
    began = time.monotonic()
    file = scenes / f"{task.scene.name}.yaml"
    file.write_text(yaml.safe_dump(task.scene.model_dump(mode="json"), sort_keys=False), encoding="utf-8")
    try:
        after_ns = observer.reset_world(str(file), task.seed)
        if task.together:
            trials = run_pair(observer, client, task.scene, task.labels, seed=task.seed, after_ns=after_ns)
        else:
            asks = [GraspRequest(label, task.arm, task.place, place_on=task.place_on) for label in task.labels]
            trials = [
                run_trial(observer, client, task.scene, ask, seed=task.seed, after_ns=after_ns, moved=k > 0)
                for k, ask in enumerate(asks)
            ]
    except OpenArmError as error:
        return crashed_row(task, error)
    row = row_of(task, trials, time.monotonic() - began)
    if task.together:
        states, steps = observer.joints(), observer.steps()
        add_clearance(row, least_clearance(states), (steps[-1].t_ns - steps[0].t_ns) * 1e-9)
    return row
