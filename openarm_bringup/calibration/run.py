# SPDX-License-Identifier: Apache-2.0
"""Calibrates cameras of the simulated robot: a graph of its own, a scene a board, the action of the node.

A fixed camera looks at the board in the hand of each arm in turn, one in a hand at a board on the table. With `zeros`
the samples of all of them then determine the zeros of the joints and all mounts in one problem; what that gives is
stored as a whole.
"""

from __future__ import annotations

import asyncio
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from openarm_bringup.supervision import runs
from openarm_bringup.supervision.environment import zeros_name
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.session import running_graph, work_until_stopped
from openarm_common.camera.cameras import uncertain_cameras
from openarm_common.domain import reserve_domain
from openarm_common.errors import Code, OpenArmError
from openarm_common.records import default_folder, now
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.learned import LearnedStore, StoredZeros
from openarm_common.robot.zeros import Zeros, keep_zeros
from openarm_common.scene.boards import CALIBRATION, board_places, board_start

if TYPE_CHECKING:
    from openarm_interfaces.action import AutoCalibrate

    from openarm_bringup.supervision.supervisor import Event
    from openarm_calibration.handeye.zero_sets import ZerosCalibration
    from openarm_calibration.ros.client import OnFeedback
    from openarm_calibration.store.store import CalibrationStore

GRAPH = "calibrate"
#: Deviation of the tilt of a table that was levelled against the base by a spirit level (0.5 mm/m at each), rad.
LEVELLED = math.radians(0.05)
#: Deviation of zeros that poses are chosen for, rad.
_ZEROS = math.radians(0.1)


@dataclass(frozen=True)
class CalibrationOptions:
    """What to calibrate.

    Args:
        cameras: Names.
        mount_seed: Seed of the true mounts, or "none"; None is the graph's.
        poses: Samples a camera at most; 0 is the node's parameter.
        enough: Repeatability that ends it, m and rad; 0 is the node's parameter.
        save: Store results that do not fail.
        zeros: Determine the zeros of the joints, too, with a board in every hand; else they are taken as stored.
        zeros_store: Folder below which zeros are stored; None is `store`.
        level: Deviation of the table's tilt, rad.
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
    zeros: bool = False
    zeros_store: Path | None = None
    level: float = LEVELLED
    store: Path | None = None
    delay: bool = False
    domain: int | None = None
    sets: tuple[str, ...] = ()

    def stores(self) -> tuple[CalibrationStore, LearnedStore[StoredZeros]]:
        """Return where mounts and zeros are stored."""
        from openarm_calibration.store.store import CalibrationStore

        folder = default_folder() if self.store is None else self.store.expanduser().absolute()
        return CalibrationStore(folder), LearnedStore(self.zeros_store or folder, StoredZeros)

    @property
    def goal(self) -> dict[str, Any]:
        """What `CalibrationClient.auto` is given for every camera."""
        save = self.save and not self.zeros
        return {"poses": self.poses, "sigma": self.enough, "measure_delay": self.delay, "save": save}


@dataclass
class CalibrationListeners:
    """Callbacks while it happens; each is called in some thread."""

    on_event: Callable[[Event], None] = lambda event: None
    on_ready: Callable[[float], None] = lambda seconds: None
    on_camera: Callable[[str], None] = lambda camera: None
    on_feedback: OnFeedback = lambda feedback: None


@dataclass
class CalibrationRun:
    """What came of it; a session file of each scene is in the run folder.

    Args:
        run_dir: Folder of the graph's run; None: it runs on.
        results: Results by camera, in the order of the work; with the board in the first hand.
        sessions: Files of samples.
        found: Zeros and all mounts, where they were to be determined.
        stored: Files that they were stored in.
        ready_s: Until the graph was ready.
        robot_s: The arms moved and samples were taken, s of wall clock.
        error: Error that ended it.
    """

    run_dir: Path | None
    results: dict[str, AutoCalibrate.Result] = field(default_factory=dict[str, "AutoCalibrate.Result"])
    sessions: list[Path] = field(default_factory=list[Path])
    found: ZerosCalibration | None = None
    stored: tuple[str, ...] = ()
    ready_s: float = 0.0
    robot_s: float = 0.0
    error: OpenArmError | None = None

    def rows(self) -> dict[str, dict[str, Any]]:
        """Return what `--json` and reports write of each camera: with the zeros, where these were determined."""
        rows = {name: as_row(result) for name, result in self.results.items()}
        if (found := self.found) is None:
            return rows
        for mount in found.mounts:
            grade, reasons = found.verdict(mount.camera)
            rows[mount.camera] |= {
                "grade": grade, "message": f"{grade}: {'; '.join(reasons) or 'within all limits'}",
                "sigma_translation": mount.sigma_translation, "sigma_rotation": mount.sigma_rotation,
                "hand": found.hand(mount.camera), "samples": mount.samples,
                "T_parent_link": mount.T_parent_link.tolist(),
                "path": next((path for path in self.stored if Path(path).stem == mount.camera), ""),
            }  # fmt: skip
        return rows


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
        OpenArmError: Fault of the options; what happens later is in the result.
    """
    cameras = chosen_cameras(options.cameras)
    domain = reserve_domain() if options.domain is None else options.domain
    sets = [*options.sets, f"calibration.camera={cameras[0]}"]
    mounts, zeros = options.stores()
    if options.store is not None:
        sets += [f"{node}.store={mounts.folder}" for node in ("calibration", "calibration_publisher")]
    places = board_places(cameras, every_arm=options.zeros)
    if options.zeros:
        sets += [f"calibration.auto.search.zeros={_ZEROS}"]
    overrides = {"domain": domain, "scene": places[0].scene, "mount_seed": options.mount_seed}
    graph = load_graph(GRAPH, overrides=overrides, sets=sets)
    run = CalibrationRun(run_dir := runs.new_run_dir())
    known = zeros.in_use(zeros_name(graph))
    keep_zeros(Zeros(robot=known.robot, of=known.of, offsets=known.offsets), run_dir / "zeros")
    listeners = listeners or CalibrationListeners()
    stop = threading.Event()

    def calibrate_all() -> None:
        from openarm_bringup.ros.simulation import reset_world
        from openarm_calibration.ros.client import CalibrationClient

        description = RobotDescription.load()
        with CalibrationClient() as client:
            for place in places:
                camera = place.camera.name
                listeners.on_camera(camera + (f", board in the {place.arm} hand" if place.arm else ""))
                reset_world(client, place.scene, joints=board_start(place))
                session = (run_dir / f"{place.scene.removeprefix(f'{CALIBRATION}_')}.npz").absolute()
                carrier = description.arm(place.arm).flange if place.arm else ""
                result = client.auto(
                    camera, carrier=carrier, **options.goal, session=str(session), on_feedback=listeners.on_feedback,
                    stop=stop,
                )  # fmt: skip
                run.robot_s += result.duration
                run.results.setdefault(camera, result)
                if result.success:
                    run.sessions.append(session)
                    continue
                run.results[camera] = result
                if options.zeros:  # they need the samples of every board
                    return

    async def work() -> None:
        async with running_graph(graph, run_dir, listeners.on_event) as supervisor:
            run.ready_s = await supervisor.wait_ready()
            listeners.on_ready(run.ready_s)
            await work_until_stopped(supervisor, calibrate_all, stop.set)

    try:
        asyncio.run(work())
        if options.zeros and len(run.sessions) == len(places):
            listeners.on_camera("zeros of the joints and all mounts")
            run.found = together(run.sessions, options.level)
            if options.save and run.found.grade != "fail":
                run.stored = store_found(run.found, mounts, zeros)
    except OpenArmError as error:
        run.error = error
    return run


def together(sessions: Sequence[Path], level: float) -> ZerosCalibration:
    """Determine the zeros of the joints and the mounts of all cameras.

    Args:
        sessions: Files of samples of this process's robot.
        level: Deviation of the tilt of the table that a board lies on, rad.

    Raises:
        OpenArmError: DEGENERATE, when the samples do not determine them.
    """
    from openarm_calibration.handeye.zero_sets import calibrate_zeros
    from openarm_calibration.handeye.zeros import ZerosConfig
    from openarm_calibration.sampling.samples import load_session

    read = [load_session(path, RobotDescription.load()) for path in sessions]
    samples, hashes = [one for one, _ in read], [digest for _, digest in read]
    return calibrate_zeros(samples, ZerosConfig(level=level), hashes=hashes, created=now())


def store_found(found: ZerosCalibration, mounts: CalibrationStore, zeros: LearnedStore[StoredZeros]) -> tuple[str, ...]:
    """Store mounts and zeros that belong together, and return the files."""
    return (*(str(mounts.save(mount)) for mount in found.mounts), str(zeros.save(found.zeros)))


def as_row(result: AutoCalibrate.Result) -> dict[str, Any]:
    """Return what `--json` and reports write of one camera."""
    from openarm_common.ros.convert import pose_to_matrix

    same = ("success", "code", "message", "grade", "sigma_translation", "sigma_rotation", "samples", "path", "duration")
    return {name: getattr(result, name) for name in same} | {
        "T_parent_link": pose_to_matrix(result.mount).tolist() if result.grade else None,
        "missed": list(result.missed),
        "delay": {"seconds": result.delay, "sigma": result.delay_sigma} if result.delay_sigma > 0.0 else None,
    }
