# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate auto` and `sample`: with a robot, simulated in a graph of its own or running already."""

from __future__ import annotations

import math
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from openarm_bringup.calibration.source import at_stored_zeros, store_in
from openarm_bringup.commands.connect import Domain, Robot, Sets, join_graph, requires_node
from openarm_bringup.outcome import GraphReport, Outcome
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import choose_robot

if TYPE_CHECKING:
    from openarm_interfaces.action import AutoCalibrate

    from openarm_bringup.calibration.run import CalibrationOptions
    from openarm_common.robot.servo_store import StoredServos

#: Of the node's parameter auto.poses.
MOST_POSES = 100
#: In which servos can be identified at all.
LEAST_POSTURES = 2


def auto(
    *,
    camera: str = "all",
    mount_seed: str | None = None,
    poses: int = 0,
    save: bool = False,
    store: Path | None = None,
    delay: bool = False,
    running: bool = False,
    domain: Domain = None,
    set_: Sets = (),
    robot: Robot = None,
) -> Outcome:
    """Calibrate automatically: the arm moves from one informative pose to the next, takes samples, and solves.

    Starts a simulated robot with a board of its own, and stops it afterwards. Leaves a folder below runs/ with the
    samples and a page with pictures for each camera. Ctrl-C stops the arm.

    Args:
        camera: Name of a camera, or "all" whose mounts are uncertain, one after the other.
        mount_seed: Of the simulated mounts, or "none"; that of the graph `calibrate` when not given.
        poses: Samples a camera at most; 0: the node's parameter auto.poses.
        save: Store the result, unless it fails the limits.
        store: Folder of stored calibrations.
        delay: Also measure how old images are at their stamps.
        running: Use the graph that runs, with the board in place, instead of a simulated one.
        domain: ROS_DOMAIN_ID; a free one, or that of the running graph, when not given.
    """
    choose_robot(robot)
    from openarm_bringup.calibration.run import CalibrationListeners, CalibrationOptions, run_calibration
    from openarm_common.camera.cameras import uncertain_cameras

    if poses and not 4 <= poses <= MOST_POSES:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--poses {poses}: expected 4 to {MOST_POSES}; 10 to 15 are usual")
    seed: int | Literal["none"] | None = "none" if mount_seed == "none" else None
    if mount_seed is not None and seed is None:
        if not mount_seed.isdecimal():
            raise OpenArmError(Code.INVALID_ARGUMENT, f"--mount-seed {mount_seed}: expected 0 or more, or none")
        seed = int(mount_seed)
    if store is not None:
        store_in(store)
    show = _Show()
    options = CalibrationOptions(
        uncertain_cameras() if camera == "all" else (camera,),
        mount_seed=seed, poses=poses, save=save, store=store, delay=delay, domain=domain, sets=tuple(set_),
    )  # fmt: skip
    if running:
        return _running(options, show)
    run = run_calibration(options, CalibrationListeners(show.event, show.ready, show.camera, show.feedback))
    for name in run.results:
        _page(run.run_dir / f"{name}.npz", run.run_dir / f"{name}.html", store)
    return _outcome(run.results, run.error, run.run_dir)


def sample(*, remove: str | None = None, session: str = "", advice: bool = False, domain: Domain = None) -> Outcome:
    """Take a sample at the present posture, in the running graph, and advise what to do next.

    Args:
        remove: Instead, remove the sample of that name ("last" is the last one).
        session: Write all samples to this file (.npz) afterwards.
        advice: Take none; list the samples and advise what to do next.
    """
    if remove is not None and advice:
        raise OpenArmError(Code.INVALID_ARGUMENT, "--remove and --advice exclude each other")
    if session and not session.endswith(".npz"):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--session {session}: expected a name that ends in .npz")
    join_graph(domain)
    from openarm_calibration.ros.client import CalibrationClient

    with requires_node("calibration", "calibrate"), CalibrationClient() as client:
        if remove is not None:
            done = client.remove("" if remove == "last" else remove)
        elif advice:
            done = client.samples()
        else:
            done = client.take()
        if done.success and session:
            done = client.save_samples(str(Path(session).expanduser().absolute()))
        now = client.samples()
    data: dict[str, Any] = {"camera": now.camera, "samples": list(now.samples), "advice": now.advice}
    return Outcome(done.success, done.message, done.code or Code.OK, data, f"next: {now.advice}")


def table(
    *,
    camera: str = "",
    block_height: float = 0.0,
    label: str = "",
    dry_run: bool = False,
    domain: Domain = None,
) -> Outcome:
    """Measure the height of the table in the running graph and store it; every node takes it over at once.

    Args:
        camera: Whose depth is used; that of the camera over the table when not given.
        block_height: Of a block that stands on the table, m, whose top is measured instead of the table's surface.
        label: Of that block, when several objects are in view.
        dry_run: Measure, and store nothing.
    """
    join_graph(domain)
    from openarm_calibration.ros.client import CalibrationClient
    from openarm_common.camera.cameras import detector_nodes, table_camera

    detectors, camera = detector_nodes(), camera or table_camera()
    if camera not in detectors:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--camera {camera}: unknown; cameras: {', '.join(detectors)}")
    with requires_node(detectors[camera], "sim"), CalibrationClient() as client:
        measured = client.measure_table(camera, block_height, label)
        data: dict[str, Any] = {name: getattr(measured, name) for name in ("height", "std", "tilt", "points")}
        if not measured.success:
            return Outcome(False, measured.message, Code(measured.code))
        text = (
            f"height {measured.height * 1e3:.1f} mm, std {measured.std * 1e3:.2f} mm,"
            f" tilt {math.degrees(measured.tilt):.2f}°, {measured.points} points"
        )
        if dry_run:
            return Outcome(True, f"{measured.message}; nothing is stored", data=data, text=text)
        saved = client.save_table(measured, f"{camera}: {'block' if block_height else 'surface'}")
    return Outcome(saved.success, saved.message, Code(saved.code), data | {"stored": saved.path}, text)


def dynamics(*, arm: str = "both", postures: int = 6, dry_run: bool = False, domain: Domain = None) -> Outcome:
    """Identify the servos of the arms in the running graph and store them: gain, damping, friction, latency a joint.

    The arm goes to some postures and moves around each; nothing may be within its reach but the table. The bridge
    carries the arms by what is stored from then on.

    Args:
        arm: Which, or both.
        postures: In which it moves; more are slower and more exact.
        dry_run: Identify, and store nothing.
    """
    join_graph(domain)
    from openarm_bringup.calibration.ros.dynamics import DynamicsClient, named_arms
    from openarm_common.records import default_folder
    from openarm_common.robot.servo_store import ServoStore

    if not LEAST_POSTURES <= postures <= MOST_POSES:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--postures {postures}: expected {LEAST_POSTURES} to {MOST_POSES}")
    sides, store = named_arms(arm), ServoStore(default_folder())
    data, lines, show = dict[str, Any](), list[str](), _Show()
    with requires_node("motion", "motion"), DynamicsClient() as client:
        seed = client.dynamics_seed()
        for side in sides:
            found = client.identify(side, postures, show.posture)
            record = found.record(side, seed)
            data[side] = record.model_dump(mode="json")
            lines += [f"{side} arm", *_servo_lines(record)]
            if not dry_run:
                data[side]["stored"] = str(store.save(record))
    done = "nothing is stored" if dry_run else f"stored in {store.folder}"
    return Outcome(True, f"identified: {' and '.join(sides)}; {done}", data=data, text="\n".join(lines))


def _servo_lines(record: StoredServos) -> list[str]:
    """Return a table of the servos, with standard deviations."""
    lines = ["  joint  gain, N m/rad  damping, N m s/rad   friction, N m     latency, ms"]
    for j in range(len(record.stiffness)):
        cells = [
            f"{values[j]:8.{digits}f} ± {stds[j]:.{digits}f}"
            for values, stds, digits in (
                (record.stiffness, record.stiffness_std, 1),
                (record.damping, record.damping_std, 2),
                (record.friction, record.friction_std, 2),
            )
        ]
        latency = f"{1e3 * record.latency[j]:8.0f} ± {1e3 * record.latency_std[j]:.1f}"
        lines.append(f"  {j + 1:5d} " + " ".join(f"{cell:>17}" for cell in (*cells, latency)))
    return lines


def _running(options: CalibrationOptions, show: _Show) -> Outcome:
    camera, *others = options.cameras
    if others:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, "--running needs --camera NAME: the board has to be moved between the cameras"
        )
    join_graph(options.domain)
    from openarm_calibration.ros.client import CalibrationClient

    show.camera(camera)
    stop = threading.Event()
    with requires_node("calibration", "calibrate"), CalibrationClient() as client:
        try:
            result = client.auto(camera, **options.goal, on_feedback=show.feedback, stop=stop)
        except KeyboardInterrupt:
            return Outcome(False, "cancelled by Ctrl-C; the arm holds where it is", Code.CANCELLED)
    return _outcome({camera: result}, None, None)


class _Show(GraphReport):
    """Prints what happens, on stderr."""

    _last = ""

    def camera(self, camera: str) -> None:
        self._console.print(f"{camera}", style="bold")

    def posture(self, number: int, count: int) -> None:
        self._console.print(f"posture {number} of {count}", markup=False)

    def feedback(self, feedback: AutoCalibrate.Feedback) -> None:
        sigma = ""
        if feedback.sigma_translation:
            degrees = math.degrees(feedback.sigma_rotation)
            sigma = f"repeatable to {feedback.sigma_translation * 1e3:.3f} mm {degrees:.4f}°"
        line = f"pose {feedback.pose:>2} of {feedback.poses}  {feedback.stage:<9}{sigma:<42}{feedback.message}"
        if line != self._last:
            self._last = line
            self._console.print(line, markup=False, soft_wrap=True)


def _outcome(results: dict[str, AutoCalibrate.Result], error: OpenArmError | None, run_dir: Path | None) -> Outcome:
    from openarm_bringup.calibration.run import as_row
    from openarm_common.ros.convert import xyz

    lines: list[str] = []
    for name, result in results.items():
        if not result.grade:
            lines.append(f"{name}: {result.code}: {result.message}")
            continue
        x, y, z = xyz(result.mount.position) * 1e3
        lines.append(
            f"{name}: {x:.2f}, {y:.2f}, {z:.2f} mm, accurate to {result.sigma_translation * 1e3:.3f} mm"
            f" {math.degrees(result.sigma_rotation):.4f}°, {result.samples} samples in {result.duration:.0f} s;"
            f" {result.message}"
        )
        if result.delay_sigma > 0.0:
            delay, sigma = result.delay * 1e3, result.delay_sigma * 1e3
            lines.append(f"{name}: images are {delay:.2f} ± {sigma:.2f} ms old at their stamps")
    data: dict[str, Any] = {"cameras": {name: as_row(result) for name, result in results.items()}}
    if run_dir is not None:
        data["run_dir"] = str(run_dir)
    where = f"; samples, pages and logs are in {run_dir}" if run_dir is not None else ""
    text = "\n".join(lines)
    if error is not None:
        return Outcome(False, f"{error.message}{where}", error.code, data, text)
    failed = [name for name, result in results.items() if not result.success or result.grade == "fail"]
    if failed:
        first = results[failed[0]]
        code = Code(first.code) if first.code != Code.OK else Code.DEGENERATE
        return Outcome(False, f"{failed[0]}: {first.message}{where}", code, data, text)
    return Outcome(True, f"calibrated {', '.join(results)}{where}", data=data, text=text)


def _page(session: Path, out: Path, store: Path | None) -> None:
    """Write the page of a session, when there is one that can be solved."""
    from openarm_calibration.handeye.offline import calibrate
    from openarm_calibration.report.report import page
    from openarm_calibration.sampling.samples import load_session
    from openarm_common.robot.description import RobotDescription

    if not session.is_file():
        return
    samples, digest = load_session(session, RobotDescription.load())
    samples = at_stored_zeros(samples, store)
    try:
        result = calibrate(samples, session=digest)
    except OpenArmError as error:
        if error.code != Code.DEGENERATE:
            raise
        return  # the command has said so
    out.write_text(page(samples, result), encoding="utf-8")
