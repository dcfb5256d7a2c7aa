# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate`: boards, and work on session files; only `auto` and `sample` need a robot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import App

from openarm_bringup.calibration.source import (
    ALL_SAMPLES,
    Solved,
    Source,
    at_stored_zeros,
    given_board,
    store_in,
    stored_in,
    with_solved,
)
from openarm_bringup.commands import calibrate_foreign, calibrate_live, calibrate_touch, calibrate_zeros
from openarm_bringup.outcome import Outcome
from openarm_bringup.suggest import unknown
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_calibration.store.store import CalibrationStore

calibrate = App(name="calibrate", help="Hand-eye calibration: boards, sampling, solving, checking and storing.")

calibrate.command(calibrate_live.auto)
calibrate.command(calibrate_live.sample)
calibrate.command(calibrate_touch.touch)
calibrate.command(calibrate_live.table)
calibrate.command(calibrate_live.dynamics)
calibrate.command(calibrate_zeros.zeros)
calibrate.command(calibrate_foreign.import_, name="import")
calibrate.command(calibrate_foreign.export)


@calibrate.command
def board(out: Path, *, board: str = "circles", dpi: int = 300) -> Outcome:
    """Write a calibration board: .png or .pdf true to scale for a printer, .xml (MJCF) for a simulated scene.

    Args:
        out: File to write; its ending chooses the form.
        board: Board in a word, such as circles:4x11:20mm:15mm, symmetric_circles:7x6:30mm:15mm, chessboard:8x5:25mm,
            charuco:7x5:34mm:26mm:DICT_5X5_100, aprilgrid:6x6:24mm:0.3 or marker:100mm:DICT_APRILTAG_36h11:id=0; or its
            keys as YAML, or a YAML file, also of Kalibr.
        dpi: Resolution of a PNG.
    """
    from openarm_calibration.board.board_files import write_board

    made = given_board(board)
    message = write_board(made, out, dpi)
    return Outcome(True, message, data={"written": str(out), "board": made.model_dump(), "size": list(made.size)})


@calibrate.command
def solve(
    samples: Path,
    *,
    algorithm: str = "REFINED",
    free_intrinsics: bool = False,
    save: bool = False,
    source: Source = ALL_SAMPLES,
) -> Outcome:
    """Solve a session file or a bag and say how good the result is.

    Args:
        samples: Session file (.npz), or a bag: folder of rosbag2, .mcap or .db3.
        algorithm: REFINED, or a closed form: TSAI PARK HORAUD ANDREFF DANIILIDIS SHAH LI.
        free_intrinsics: Estimate focal lengths and principal point as well, where those of camera_info are in doubt.
        save: Store the result, unless it fails.
    """
    place = store_in(source.store) if save else None
    return with_solved(
        samples, source, lambda done: _outcome(done, place), algorithm=algorithm, free_intrinsics=free_intrinsics
    )


@calibrate.command
def check(
    samples: Path,
    *,
    touches: Path | None = None,
    tip: tuple[float, float, float] = (0.0, 0.0, 0.0),
    steady: float = 1e-3,
    source: Source = ALL_SAMPLES,
) -> Outcome:
    """Validate a session file or a bag, and its distance from what is stored; exit code 1 when it fails the limits.

    With touches, the tip of a hand also has to meet the marks where the camera sees them: a second evidence, of joints
    alone. The board must not have moved since the samples.

    Args:
        samples: Session file (.npz), or a bag: folder of rosbag2, .mcap or .db3.
        touches: CSV file of `openarm calibrate touch`.
        tip: Tip that touched, in the frame of the tool centre point, m.
        steady: Standard deviation of a touch by axis, m.
    """
    compare = calibrate_touch.comparison(touches, tip, steady) if touches is not None else None

    def said(done: Solved) -> Outcome:
        outcome = _outcome(done, None)
        return outcome if compare is None else compare(done, outcome)

    return with_solved(samples, source, said)


@calibrate.command
def save(samples: Path, *, algorithm: str = "REFINED", force: bool = False, source: Source = ALL_SAMPLES) -> Outcome:
    """Solve a session file or a bag and store the result; a running graph takes it over at once.

    Args:
        samples: Session file (.npz), or a bag: folder of rosbag2, .mcap or .db3.
        algorithm: Same as for `solve`.
        force: Store also what fails the limits.
    """
    place = store_in(source.store)
    return with_solved(samples, source, lambda done: _outcome(done, place, force=force), algorithm=algorithm)


@calibrate.command
def together(*sessions: Path, save: bool = False, store: Path | None = None) -> Outcome:
    """Solve sessions of several cameras at once: they share the robot's errors, and the board where it is the same.

    Args:
        sessions: Files of samples (.npz), one for each camera.
        save: Store the results, unless one fails.
        store: Folder of stored calibrations.
    """
    from openarm_calibration.handeye.offline import calibrate_together
    from openarm_calibration.report.report import summary
    from openarm_calibration.sampling.samples import load_session
    from openarm_common.records import now
    from openarm_common.robot.description import RobotDescription

    if len(sessions) < 2:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{len(sessions)} sessions given, expected two or more; one: `solve`")
    place = store_in(store)
    read = [load_session(session, RobotDescription.load()) for session in sessions]
    opened = [(at_stored_zeros(samples, store), digest) for samples, digest in read]
    results = calibrate_together(
        [samples for samples, _ in opened],
        hashes=[digest for _, digest in opened],
        created=now(),
        stored=[place.in_use(samples.head.camera, samples.head.mount_seed) for samples, _ in opened],
    )
    names = [samples.head.camera for samples, _ in opened]
    data: dict[str, Any] = {"cameras": {n: result.as_json() for n, result in zip(names, results, strict=True)}}
    text = "\n\n".join(summary(result) for result in results)
    grades = ", ".join(f"{n} {result.verdict.grade}" for n, result in zip(names, results, strict=True))
    if any(result.verdict.grade == "fail" for result in results):
        return Outcome(False, f"{grades}; nothing was stored", Code.DEGENERATE, data, text)
    if save:
        paths = [str(place.save(result.calibration)) for result in results]
        return Outcome(True, f"{grades}. Stored in {', '.join(paths)}", data=data, text=text)
    return Outcome(True, grades, data=data, text=text)


@calibrate.command
def report(samples: Path, out: Path, *, source: Source = ALL_SAMPLES) -> Outcome:
    """Write a page with pictures on a session file or a bag: coverage, residuals, poses, samples, methods.

    Args:
        samples: Session file (.npz), or a bag: folder of rosbag2, .mcap or .db3.
        out: HTML file to write.
    """
    from openarm_calibration.report.report import page

    if out.suffix not in (".html", ".htm"):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{out}: a report is written as .html")

    def write(done: Solved) -> Outcome:
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            out.write_text(page(done.samples, done.result), encoding="utf-8")
        except OSError as error:
            raise OpenArmError(Code.ENVIRONMENT, f"can't write {out}: {error.strerror}") from error
        message = f"{done.result.verdict.grade}; wrote {out}"
        return Outcome(True, message, data={"written": str(out), **_json(done)}, text=done.text)

    return with_solved(samples, source, write)


@calibrate.command(name="list")
def list_(*, store: Path | None = None) -> Outcome:
    """Name what is stored, with its history: calibrations, the table, zeros of joints, learned hands, servos.

    Args:
        store: Folder of stored calibrations.
    """
    data: dict[str, Any] = {"store": str(store_in(store).folder), "cameras": {}}
    lines, faults = list[str](), list[str]()
    for label, (stored, name) in stored_in(store).items():
        try:
            found = stored.find(name)
        except OpenArmError as error:
            faults.append(error.message)
            lines.append(f"{label}: {error.message}")
            continue
        if found is None:  # of another robot
            continue
        faults += [found.warning] if found.warning else []
        place, history = stored.kind.place, stored.history(name)
        lines.append(f"{label}: {found.record}  ({len(history)} in its history)")
        rows = data if place == "table" else data.setdefault(place or "cameras", {})  # there is one table
        old = {"history": [item.model_dump(mode="json") for item in history]}
        rows[name] = found.record.model_dump(mode="json") if place else old
    if faults:
        return Outcome(False, "; ".join(faults), Code.CONFIG_INVALID, data, "\n".join(lines))
    return Outcome(True, f"{len(lines)} stored in {data['store']}", data=data, text="\n".join(lines))


@calibrate.command
def rollback(name: str, *, store: Path | None = None) -> Outcome:
    """Go back to what was stored before the present one; with zeros, to the mounts of before.

    Args:
        name: First word of a line of `list`: a camera, table, zeros, hands or servos/ARM; of a simulated robot such
            as hands/simulated_openarm.
        store: Folder of stored calibrations.
    """
    from openarm_common.robot.learned import Learned, StoredZeros

    known = stored_in(store)
    if name not in known:
        raise unknown("stored calibration", name, known)
    stored, key = known[name]
    left, now = stored.find(key), stored.rollback(key)
    said = [f"now in use: {name}: {now}"]
    if left is not None and isinstance(left.record, StoredZeros):
        said += calibrate_zeros.mounts_rolled_back(left.record, store_in(store))
    if isinstance(now, Learned):
        said.append("start the graph again")
    return Outcome(True, "; ".join(said), data=now.model_dump(mode="json"))


def _json(done: Solved) -> dict[str, Any]:
    return done.result.as_json() | ({"stills": done.stills} if done.stills else {})


def _outcome(done: Solved, store: CalibrationStore | None, *, force: bool = False) -> Outcome:
    from openarm_calibration.report.report import summary

    result, data = done.result, _json(done)
    text = "\n\n".join(part for part in (done.text, summary(result)) if part)
    failed = result.verdict.grade == "fail"
    message = f"{result.verdict.grade}: {'; '.join(result.verdict.reasons) or 'within all limits'}"
    if store is not None and (force or not failed):
        path = store.save(result.calibration)
        data["stored"] = str(path)
        return Outcome(True, f"{message}. Stored in {path}", data=data, text=text)
    if store is not None:
        message += "; not stored (--force of `openarm calibrate save` stores it all the same)"
    return Outcome(not failed, message, Code.DEGENERATE if failed else Code.OK, data, text)
