# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate auto` and `sample`: with a robot, simulated in a graph of its own or running already."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from openarm_bringup.calibration.source import at_stored_zeros, store_in
from openarm_bringup.commands.connect import Domain, Robot, Sets, join_graph, requires_node
from openarm_bringup.outcome import GraphReport, Outcome
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import choose_robot

if TYPE_CHECKING:
    from openarm_interfaces.action import AutoCalibrate

    from openarm_bringup.calibration.run import CalibrationOptions, CalibrationRun
    from openarm_calibration.handeye.zero_sets import ZerosCalibration
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
    carrier: str = "",
    session: Path | None = None,
    domain: Domain = None,
    set_: Sets = (),
    robot: Robot = None,
) -> Outcome:
    """Calibrate automatically: the arm moves from one informative pose to the next, takes samples, and solves.

    Starts a simulated robot with a board of its own, and stops it afterwards. For all cameras the board is in each hand
    in turn, then on the table, and the samples determine the zeros of the joints with the mounts. Leaves a folder below
    runs/ with the samples, a page with pictures for each board, and one for the zeros. Ctrl-C stops the arm.

    Args:
        camera: Name of a camera, at the zeros that are stored; or "all" whose mounts are uncertain, with the zeros.
        mount_seed: Seed of the simulated mounts, or "none"; that of the graph `calibrate` when not given.
        poses: Samples a camera at most; 0: the node's parameter auto.poses.
        save: Store the result, unless it fails the limits.
        store: Folder of stored calibrations.
        delay: Also measure how old images are at their stamps.
        running: Use the graph that runs, with the board in place, instead of a simulated one; of one camera.
        carrier: Link that holds the board of a fixed camera, with --running; the last arm's flange when not given.
        session: File (.npz) to write the samples to, for `openarm calibrate zeros`; with --running.
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
    if not running and (carrier or session is not None):
        raise OpenArmError(Code.INVALID_ARGUMENT, "--carrier and --session are for --running; else each arm holds it")
    if session is not None and session.suffix != ".npz":
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--session {session}: expected a name that ends in .npz")
    show = _Show()
    options = CalibrationOptions(
        uncertain_cameras() if camera == "all" else (camera,), mount_seed=seed, poses=poses, save=save,
        zeros=camera == "all", store=store, delay=delay, domain=domain, sets=tuple(set_),
    )  # fmt: skip
    if running:
        return _running(options, show, carrier, session)
    run = run_calibration(options, CalibrationListeners(show.event, show.ready, show.camera, show.feedback))
    if run.found is not None:
        _pages_of(run.found, run.sessions)
    else:
        for samples in run.sessions:
            _page(samples, samples.with_suffix(".html"), store)
    return _outcome(run)


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
        camera: Camera whose depth is used; that of the camera over the table when not given.
        block_height: Height of a block on the table, m, whose top is measured instead of the table's surface.
        label: Label of that block, when several objects are in view.
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
        arm: Arm, or both.
        postures: Number of postures in which it moves; more are slower and more exact.
        dry_run: Identify, and store nothing.
    """
    join_graph(domain)
    from openarm_bringup.calibration.ros.dynamics import DynamicsClient, named_arms
    from openarm_common.records import RecordStore, default_folder
    from openarm_common.robot.servo_store import StoredServos

    if not LEAST_POSTURES <= postures <= MOST_POSES:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--postures {postures}: expected {LEAST_POSTURES} to {MOST_POSES}")
    sides, store = named_arms(arm), RecordStore(default_folder(), StoredServos)
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


def _running(options: CalibrationOptions, show: _Show, carrier: str, session: Path | None) -> Outcome:
    camera, *others = options.cameras
    if others:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, "--running needs --camera NAME: the board has to be moved between the cameras"
        )
    join_graph(options.domain)
    from openarm_bringup.calibration.run import CalibrationRun
    from openarm_calibration.ros.client import CalibrationClient

    show.camera(camera)
    stop = threading.Event()
    with requires_node("calibration", "calibrate"), CalibrationClient() as client:
        try:
            file = "" if session is None else str(session.expanduser().absolute())
            result = client.auto(
                camera, carrier=carrier, session=file, **options.goal, on_feedback=show.feedback, stop=stop
            )
        except KeyboardInterrupt:
            return Outcome(False, "cancelled by Ctrl-C; the arm holds where it is", Code.CANCELLED)
    return _outcome(CalibrationRun(None, {camera: result}))


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


def _outcome(run: CalibrationRun) -> Outcome:
    """Return the end of a calibration: exit code and sentence follow the worst camera."""
    rows, where = run.rows(), "" if run.run_dir is None else f"; samples, pages and logs are in {run.run_dir}"
    lines: list[str] = []
    for name, row in rows.items():
        if not row["grade"]:
            lines.append(f"{name}: {row['code']}: {row['message']}")
            continue
        x, y, z = (f"{1e3 * line[3]:.2f}" for line in row["T_parent_link"][:3])
        hand = f"; the hand meets what it sees to {1e3 * row['hand']:.2f} mm" if "hand" in row else ""
        lines.append(
            f"{name}: {x}, {y}, {z} mm, accurate to {row['sigma_translation'] * 1e3:.2f} mm"
            f" {math.degrees(row['sigma_rotation']):.3f}°{hand}; {row['samples']} samples; {row['message']}"
        )
        if row["delay"]:
            delay, sigma = (1e3 * row["delay"][key] for key in ("seconds", "sigma"))
            lines.append(f"{name}: images are {delay:.2f} ± {sigma:.2f} ms old at their stamps")
    data: dict[str, Any] = {"cameras": rows}
    if run.run_dir is not None:
        data["run_dir"] = str(run.run_dir)
    if run.found is not None:
        lines += run.found.result.sentences()
        data |= {"zeros": run.found.zeros.model_dump(mode="json"), "stored": list(run.stored)}
    text = "\n".join(lines)
    if run.error is not None:
        return Outcome(False, f"{run.error.message}{where}", run.error.code, data, text)
    failed = [name for name, row in rows.items() if not row["success"] or row["grade"] == "fail"]
    if failed:
        code = Code(rows[failed[0]]["code"])
        message = f"{failed[0]}: {rows[failed[0]]['message']}{where}"
        return Outcome(False, message, code if code != Code.OK else Code.DEGENERATE, data, text)
    stored = f"; stored in {', '.join(run.stored)}" if run.stored else ""
    return Outcome(True, f"calibrated {', '.join(rows)}{stored}{where}", data=data, text=text)


def _pages_of(found: ZerosCalibration, sessions: Sequence[Path]) -> None:
    """Write a page of each session next to it, with the zeros that were found, and one of these."""
    from openarm_calibration.report.report import page, zeros_page
    from openarm_calibration.sampling.samples import load_session
    from openarm_common.robot.description import RobotDescription

    for session, result in zip(sessions, found.cameras, strict=True):
        samples, _ = load_session(session, RobotDescription.load())
        text = page(samples.with_zeros(found.zeros.offsets), result)
        session.with_suffix(".html").write_text(text, encoding="utf-8")
    sessions[0].with_name("zeros.html").write_text(zeros_page(found), encoding="utf-8")


def _page(session: Path, out: Path, store: Path | None) -> None:
    """Write the page of a session, when it can be solved."""
    from openarm_calibration.handeye.offline import calibrate
    from openarm_calibration.report.report import page
    from openarm_calibration.sampling.samples import load_session
    from openarm_common.robot.description import RobotDescription

    samples, digest = load_session(session, RobotDescription.load())
    samples = at_stored_zeros(samples, store)
    try:
        result = calibrate(samples, session=digest)
    except OpenArmError as error:
        if error.code != Code.DEGENERATE:
            raise
        return  # the command has said so
    out.write_text(page(samples, result), encoding="utf-8")
