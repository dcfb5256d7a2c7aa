# SPDX-License-Identifier: Apache-2.0
"""The demonstration: a graph of its own, grasps requested over DDS and judged by ground truth, report and pictures."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from openarm_bringup.supervision import environment, runs
from openarm_bringup.supervision.graph import Graph, load_graph
from openarm_bringup.supervision.session import running_graph, work_until_stopped
from openarm_common.domain import reserve_domain
from openarm_common.errors import OpenArmError
from openarm_common.robot.folder import robot_name
from openarm_common.scene.scene import load_scene
from openarm_evaluation.demo import mounts
from openarm_evaluation.demo.options import DemoOptions
from openarm_evaluation.judging import provenance
from openarm_evaluation.judging.statistics import summarise
from openarm_evaluation.judging.trial import Step, Trial, choose_targets, run_trial
from openarm_grasp.requests.request import GraspRequest

if TYPE_CHECKING:
    from openarm_bringup.supervision.supervisor import Event
    from openarm_evaluation.judging.ros.observer import Observer

DETECTION = "/detection_image"


@dataclass
class Listeners:
    """Callbacks while it happens; each is called in some thread."""

    on_event: Callable[[Event], None] = lambda event: None
    on_ready: Callable[[float], None] = lambda seconds: None
    on_step: Callable[[Step], None] = lambda step: None
    on_trial: Callable[[Trial], None] = lambda trial: None
    on_note: Callable[[str], None] = lambda note: None


@dataclass
class DemoResult:
    """What came out; `pictures` are files in the run folder, `mounts` how far off cameras are (see `mounts.errors`)."""

    run_dir: Path
    trials: list[Trial] = field(default_factory=list["Trial"])
    pictures: list[str] = field(default_factory=list[str])
    warnings: list[str] = field(default_factory=list[str])
    mounts: dict[str, dict[str, float]] = field(default_factory=dict[str, "dict[str, float]"])
    ready_s: float = 0.0
    error: OpenArmError | None = None


def run_demo(options: DemoOptions, listeners: Listeners | None = None) -> DemoResult:
    """Run the demonstration to its end; the graph is stopped whatever happens.

    Raises:
        OpenArmError: Fault of the options; what happens later is in the result.
    """
    domain = reserve_domain() if options.domain is None else options.domain
    overrides = {
        "domain": domain,
        "scene": "random" if options.seeds else options.scene,
        "mount_seed": options.mount_seed,
    }
    if options.seeds:
        overrides["seed"] = options.seeds[0]
    # the detector would notice most mounts that are off by the table, and refuse
    uncalibrated = ("calibration_publisher.nominal=true", "detector.watch.enabled=false")
    sets = (*options.sets, *(uncalibrated if options.uncalibrated else ()))
    graph = load_graph(options.graph, overrides=overrides, sets=sets)
    # Faults of the call show before anything is started.
    for seed in options.seeds or (graph.seed,):
        choose_targets(load_scene(graph.scene, seed), options.label or "")
    result = DemoResult(runs.new_run_dir())
    listeners = listeners or Listeners()
    try:
        if graph.mount_seed != "none":
            if not options.uncalibrated:
                mounts.calibrate_once(graph.mount_seed, listeners.on_note)
            result.mounts = mounts.errors(graph.mount_seed, nominal=options.uncalibrated)
        asyncio.run(_demo(options, graph, result, listeners))
    except OpenArmError as error:
        result.error = error
    write_report(options, graph, result)
    return result


async def _demo(options: DemoOptions, graph: Graph, result: DemoResult, listeners: Listeners) -> None:
    async with running_graph(graph, result.run_dir, listeners.on_event) as supervisor:
        result.ready_s = await supervisor.wait_ready()
        listeners.on_ready(result.ready_s)
        from openarm_evaluation.judging.ros.observer import Observer
        from openarm_grasp.ros.client import GraspClient

        studio: Studio | None = None

        def on_step(step: Step) -> None:
            listeners.on_step(step)
            if studio is not None:
                studio.on_step(step)

        with Observer(environment.domain_id(graph), on_step) as observer, GraspClient() as client:
            studio = Studio(result, observer) if options.film else None
            wanted = GraspRequest(options.label or "", options.arm, options.place)
            before = studio.begin if studio is not None else None
            rounds: list[tuple[str, int | None]] = [("random", seed) for seed in options.seeds]

            def work() -> None:
                for name, seed in rounds or [(graph.scene, graph.seed if graph.scene == "random" else None)]:
                    after_ns = observer.reset_world(name, seed or 0) if options.seeds else 0
                    scene = load_scene(name, graph.seed if seed is None else seed)
                    trial = run_trial(observer, client, scene, wanted, seed=seed, after_ns=after_ns, before=before)
                    result.trials.append(trial)
                    listeners.on_trial(trial)

            try:
                await work_until_stopped(supervisor, work, client.cancel)
            finally:
                if studio is not None:
                    studio.finish()


class Studio:
    """Takes the pictures of a run: before, what was detected, held, after; and a film of all of it."""

    def __init__(self, result: DemoResult, observer: Observer) -> None:
        from openarm_common.camera.cameras import load_cameras, spectator_camera
        from openarm_evaluation.judging.film import Film

        self._result = result
        self._folder = result.run_dir
        camera = load_cameras()[spectator_camera()]
        self._film, self._view = Film(result.run_dir / "grasp.mp4", camera.rate), f"/{camera.name}/color/image_raw"
        self._observer = observer
        self._filming = False

    def begin(self) -> None:
        """Start filming and take the picture before; called in the thread of the trials."""
        self._filming = True
        self._observer.watch_camera(self._view, self._film.add)
        self._save_next(self._view, "before.png")
        self._observer.watch_camera(DETECTION)
        self._save_next(DETECTION, "detection.png")
        self._observer.unwatch_camera(DETECTION)

    def on_step(self, step: Step) -> None:
        """Take the picture of the held object when it has been lifted."""
        if step.previous == "LIFT" and step.state == "PLACE":
            self._save_newest("held.png")

    def finish(self) -> None:
        """Take the last picture and finish the film."""
        if self._filming:
            self._save_newest("after.png")
            self._observer.unwatch_camera(self._view)
        if self._film.close():
            self._result.pictures.append("grasp.mp4")
        if self._film.save_animation(self._folder / "grasp.webp"):
            self._result.pictures.append("grasp.webp")
        if self._film.dropped:
            self._result.warnings.append(f"the film lost {self._film.dropped} frames")

    def _save_next(self, topic: str, name: str) -> None:
        try:
            self._save(name, self._observer.wait(lambda: self._observer.frame(topic), 10.0, f"an image of {topic}")[1])
        except OpenArmError as error:
            self._result.warnings.append(f"{name}: {error.message}")

    def _save_newest(self, name: str) -> None:
        frame = self._observer.frame(self._view)
        if frame is None:
            self._result.warnings.append(f"{name}: no image of {self._view}")
        else:
            self._save(name, frame[1])

    def _save(self, name: str, picture: Any) -> None:
        from openarm_evaluation.judging.film import save_picture

        save_picture(self._folder / name, picture)
        self._result.pictures.append(name)


def write_report(options: DemoOptions, graph: Graph, result: DemoResult) -> dict[str, Any]:
    """Write report.json into the run folder and return it."""
    rows = [trial.as_row() for trial in result.trials]
    data: dict[str, Any] = {
        "graph": graph.name,
        "robot": robot_name(),
        "domain": graph.domain,
        "mount_seed": graph.mount_seed,
        "mounts": result.mounts,
        "seeds": list(options.seeds),
        "ready_s": round(result.ready_s, 2),
        "summary": summarise(rows),
        "rows": rows,
        "error": {"code": str(result.error.code), "message": result.error.message} if result.error else None,
        "pictures": result.pictures,
        "warnings": result.warnings,
        "versions": provenance.versions(),
        "machine": provenance.machine(),
    }
    runs.write_json(result.run_dir / "report.json", data)
    return data
