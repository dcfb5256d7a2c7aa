# SPDX-License-Identifier: Apache-2.0
"""Calibrates cameras of the simulated robot: a graph of its own, one scene a camera, the action of the node."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from openarm_bringup.supervision import runs
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.session import running_graph, work_until_stopped
from openarm_common.camera.cameras import load_cameras, uncertain_cameras
from openarm_common.domain import reserve_domain
from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.boards import CALIBRATION, board_start

if TYPE_CHECKING:
    from openarm_interfaces.action import AutoCalibrate

    from openarm_bringup.supervision.supervisor import Event
    from openarm_calibration.ros.client import OnFeedback

GRAPH = "calibrate"


@dataclass(frozen=True)
class CalibrationOptions:
    """What to calibrate.

    Args:
        cameras: Names; each in its scene `calibration_<camera>`.
        mount_seed: Of the true mounts, or "none"; None is the graph's.
        poses: Samples a camera at most; 0 is the node's parameter.
        enough: Predicted errors that end it, m and rad; 0 is the node's parameter.
        save: Store results that do not fail.
        store: Folder of stored calibrations; None is the default one.
        delay: Also measure the age of the images.
        domain: ROS_DOMAIN_ID; None is a free one.
        sets: Parameters, as node.param=value.
    """

    cameras: tuple[str, ...] = field(default_factory=uncertain_cameras)
    mount_seed: int | Literal["none"] | None = None
    poses: int = 0
    enough: tuple[float, float] = (0.0, 0.0)
    save: bool = False
    store: Path | None = None
    delay: bool = False
    domain: int | None = None
    sets: tuple[str, ...] = ()

    @property
    def goal(self) -> dict[str, Any]:
        """What `CalibrationClient.auto` is given for every camera."""
        return {"poses": self.poses, "sigma": self.enough, "measure_delay": self.delay, "save": self.save}


@dataclass
class CalibrationListeners:
    """Callbacks while it happens; each is called in some thread."""

    on_event: Callable[[Event], None] = lambda event: None
    on_ready: Callable[[float], None] = lambda seconds: None
    on_camera: Callable[[str], None] = lambda camera: None
    on_feedback: OnFeedback = lambda feedback: None


@dataclass
class CalibrationRun:
    """Results by camera, in the order of the work; session files are in the run folder."""

    run_dir: Path
    results: dict[str, AutoCalibrate.Result] = field(default_factory=dict[str, "AutoCalibrate.Result"])
    ready_s: float = 0.0
    error: OpenArmError | None = None


def scene_of(camera: str) -> str:
    """Return the name of the scene in which a camera is calibrated."""
    return f"{CALIBRATION}_{camera}"


def chosen_cameras(names: Sequence[str]) -> tuple[str, ...]:
    """Check names of cameras.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing those that can be calibrated.
    """
    can = uncertain_cameras()
    for name in names:
        if name not in can:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no camera {name!r} to calibrate; cameras: {', '.join(can)}")
    return tuple(names)


def run_calibration(options: CalibrationOptions, listeners: CalibrationListeners | None = None) -> CalibrationRun:
    """Calibrate; the graph is stopped whatever happens.

    Raises:
        OpenArmError: What is wrong with the options; what happens later is in the result.
    """
    cameras = chosen_cameras(options.cameras)
    domain = reserve_domain() if options.domain is None else options.domain
    sets = [*options.sets, f"calibration.camera={cameras[0]}"]
    if options.store is not None:
        folder = options.store.expanduser().absolute()
        sets += [f"calibration.store={folder}", f"calibration_publisher.store={folder}"]
    overrides = {"domain": domain, "scene": scene_of(cameras[0]), "mount_seed": options.mount_seed}
    graph = load_graph(GRAPH, overrides=overrides, sets=sets)
    run = CalibrationRun(runs.new_run_dir())
    listeners = listeners or CalibrationListeners()
    stop = threading.Event()

    def calibrate_all() -> None:
        from openarm_bringup.ros.simulation import reset_world
        from openarm_calibration.ros.client import CalibrationClient

        known = load_cameras()
        with CalibrationClient() as client:
            for camera in cameras:
                listeners.on_camera(camera)
                reset_world(client, scene_of(camera), joints=board_start(known[camera]))
                session = str((run.run_dir / f"{camera}.npz").absolute())
                run.results[camera] = client.auto(
                    camera, **options.goal, session=session, on_feedback=listeners.on_feedback, stop=stop
                )
                if stop.is_set():
                    return

    async def work() -> None:
        async with running_graph(graph, run.run_dir, listeners.on_event) as supervisor:
            run.ready_s = await supervisor.wait_ready()
            listeners.on_ready(run.ready_s)
            await work_until_stopped(supervisor, calibrate_all, stop.set)

    try:
        asyncio.run(work())
    except OpenArmError as error:
        run.error = error
    return run


def as_row(result: AutoCalibrate.Result) -> dict[str, Any]:
    """Return what `--json` and reports write of one camera."""
    from openarm_common.ros.convert import pose_to_matrix

    same = ("success", "code", "message", "grade", "sigma_translation", "sigma_rotation", "samples", "path", "duration")
    return {name: getattr(result, name) for name in same} | {
        "T_parent_link": pose_to_matrix(result.mount).tolist() if result.grade else None,
        "missed": list(result.missed),
        "delay": {"seconds": result.delay, "sigma": result.delay_sigma} if result.delay_sigma > 0.0 else None,
    }
