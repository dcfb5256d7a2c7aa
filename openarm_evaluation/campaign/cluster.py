# SPDX-License-Identifier: Apache-2.0
"""Campaigns on several machines, through a Ray cluster: one process a worker; rows and what is kept come back.

The machines need the suite installed, in the same version (the same commit of a checkout), and nothing else: scenes
come from seeds, and calibrations travel with the work.
"""

from __future__ import annotations

import logging
import socket
import tempfile
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import choose_robot, robot_source
from openarm_evaluation.campaign.options import CampaignOptions, Row
from openarm_evaluation.campaign.tasks.suites import make_task
from openarm_evaluation.campaign.trial import run_one, with_robot
from openarm_evaluation.judging import provenance

Files = dict[str, bytes]

#: Workers that may be lost (a machine that is switched off, a process that is killed) with one seed.
_LOST = 2
#: A cluster that is there answers within this, s.
_REACH_S = 5.0


@dataclass(frozen=True)
class _Answer:
    """What a worker sends back: the row, what it kept, where it ran."""

    row: Row
    kept: Files
    versions: Mapping[str, str]
    node: str


class _Worker:
    """A process on some machine of the cluster."""

    def __init__(self, robot: str, robots: Mapping[str, Files]) -> None:
        choose_robot(robot)
        self._folder = tempfile.TemporaryDirectory(prefix="openarm_campaign_")
        for name, files in robots.items():
            unpack(files, Path(self._folder.name) / name)

    def run(self, options: CampaignOptions, seed: int) -> _Answer:
        """Run one task."""
        import ray

        folder = Path(self._folder.name)
        row = run_one(options, seed, folder)
        kept = pack(folder / "failures" / str(seed))
        node = ray.get_runtime_context().get_node_id()
        return _Answer(row, kept, provenance.versions(), node)


def rows(options: CampaignOptions, seeds: Sequence[int], folder: Path) -> Generator[Row, None, None]:
    """Rows as they come from `options.workers` workers of the cluster at `options.ray`.

    Raises:
        OpenArmError: ENVIRONMENT, when Ray is not installed, no cluster is there, it has fewer processors than workers
            are requested, or a machine has another version of the suite; EXECUTION_FAILED, when workers are lost again
            and again.
    """
    ray = _connect(options)
    try:
        _prepare_robots(options, seeds, folder)
        robots = ray.put({name: pack(folder / name) for name in ("mounts", "servos")})
        make = ray.remote(num_cpus=1)(_Worker).remote
        local = replace(options, ray="", workers=1)
        queue, lost = list(reversed(seeds)), dict[int, int]()
        idle = [make(robot_source(), robots) for _ in range(min(options.workers, len(seeds)))]
        running: dict[Any, tuple[Any, int]] = {}
        while queue or running:
            while queue and idle:
                worker, seed = idle.pop(), queue.pop()
                running[worker.run.remote(local, seed)] = (worker, seed)
            done, _ = ray.wait(list(running), num_returns=1)
            worker, seed = running.pop(done[0])
            try:
                answer: _Answer = ray.get(done[0])
            except ray.exceptions.RayActorError as error:
                lost[seed] = lost.get(seed, 0) + 1
                if lost[seed] > _LOST:
                    text = f"seed {seed}: {lost[seed]} workers were lost with it, the last: {error}"
                    raise OpenArmError(Code.EXECUTION_FAILED, f"{text}; the rows so far are kept") from error
                queue.append(seed)
                idle.append(make(robot_source(), robots))
                continue
            idle.append(worker)
            _check_versions(answer)
            unpack(answer.kept, folder / "failures" / str(seed))
            yield {**answer.row, "node": answer.node}
    finally:
        ray.shutdown()


def _connect(options: CampaignOptions) -> Any:
    try:
        import ray
    except ImportError as error:
        text = (
            "campaigns on several machines need Ray: install the extra `cluster` (pip install openarm-vision[cluster])"
        )
        raise OpenArmError(Code.ENVIRONMENT, text) from error
    host, _, port = options.ray.rpartition(":")
    try:
        if host and port.isdigit():  # Ray itself would go on trying for minutes
            socket.create_connection((host, int(port)), _REACH_S).close()
        ray.init(address=options.ray, log_to_driver=False, logging_level=logging.WARNING)
    except (OSError, ValueError) as error:
        raise OpenArmError(
            Code.ENVIRONMENT,
            f"no Ray cluster at {options.ray!r}: {error}; start one with `ray start --head` here and"
            " `ray start --address=HOST:6379` on the other machines",
        ) from error
    cores = int(ray.cluster_resources().get("CPU", 0))
    if cores < options.workers:
        ray.shutdown()
        raise OpenArmError(
            Code.ENVIRONMENT,
            f"the cluster at {options.ray} has {cores} processors, {options.workers} workers were requested; use"
            f" --workers {cores} or add machines",
        )
    return ray


def _prepare_robots(options: CampaignOptions, seeds: Sequence[int], folder: Path) -> None:
    """Calibrate and identify here what is missing, once, instead of on every machine."""
    turns = [len(draws) or 1 for draws in (options.mount_seeds, options.dynamics_seeds, options.hand_seeds)]
    first = {tuple(seed % turn for turn in turns): seed for seed in reversed(seeds)}
    for seed in first.values():
        with_robot(make_task(options.set_name, seed, options.objects), options, folder)


def _check_versions(answer: _Answer) -> None:
    here = provenance.versions()
    other = {key: value for key, value in answer.versions.items() if here.get(key) != value}
    if other:
        there = ", ".join(f"{key} {value} (here {here.get(key)})" for key, value in other.items())
        raise OpenArmError(
            Code.ENVIRONMENT, f"machine {answer.node[:8]} of the cluster runs {there}; rows must come from one version"
        )


def pack(folder: Path) -> Files:
    """Files of a folder by relative path; none when it is not there."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def unpack(files: Files, folder: Path) -> None:
    """Write what `pack` read."""
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
