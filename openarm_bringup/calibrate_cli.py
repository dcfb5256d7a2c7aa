# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate`: boards, and what is done with a session file; only `auto` and `sample` need a robot."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

from openarm_bringup import calibrate_live_cli
from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_calibration.offline import Result
    from openarm_calibration.samples import SampleSet
    from openarm_calibration.store import CalibrationStore, StoredCalibration

app = App(name="calibrate", help="Where are the cameras? Boards, solving, checking and storing hand-eye calibrations.")

app.command(calibrate_live_cli.auto)
app.command(calibrate_live_cli.sample)


@app.command
def board(
    out: Path,
    *,
    kind: Literal["circles", "charuco"] = "circles",
    columns: int | None = None,
    rows: int | None = None,
    spacing: float | None = None,
    diameter: float | None = None,
    border: float | None = None,
    dpi: int = 300,
) -> Outcome:
    """Write a calibration board: .png or .pdf true to scale for a printer, .xml (MJCF) for a simulated scene.

    Args:
        out: File to write; its ending chooses the form.
        kind: An asymmetric circle grid, or ChArUco.
        columns: Circles in a row (4), or squares in a row (7).
        rows: Rows of circles (11, odd), or of squares (5).
        spacing: Between rows of circles (0.02), or edge of a square (0.034), m.
        diameter: Of a circle (0.015), or edge of a marker (0.026), m.
        border: White around the marks, m.
        dpi: Of a PNG.
    """
    from openarm_calibration.board import parse_board
    from openarm_calibration.board_files import write_board

    given = {"columns": columns, "rows": rows, "spacing": spacing, "diameter": diameter, "border": border}
    chosen = {key: value for key, value in given.items() if value is not None}
    try:
        made = parse_board({"kind": kind, **chosen}, "board")
    except OpenArmError as error:
        raise OpenArmError(Code.INVALID_ARGUMENT, error.message) from error
    message = write_board(made, out, dpi)
    return Outcome(True, message, data={"written": str(out), "board": made.model_dump(), "size": list(made.size)})


@app.command
def solve(
    session: Path,
    *,
    algorithm: str = "REFINED",
    exclude: tuple[str, ...] = (),
    save: Annotated[bool, Parameter(negative=())] = False,
    store: Path | None = None,
) -> Outcome:
    """Solve a session file and say how good the result is.

    Args:
        session: File of samples (.npz).
        algorithm: REFINED, or a closed form: TSAI PARK HORAUD ANDREFF DANIILIDIS SHAH LI.
        exclude: Names of samples to leave out.
        save: Store the result, unless it fails.
        store: Folder of stored calibrations.
    """
    samples, result = _solved(session, algorithm, exclude, store)
    return _outcome(samples, result, _store(store) if save else None)


@app.command
def check(session: Path, *, exclude: tuple[str, ...] = (), store: Path | None = None) -> Outcome:
    """Judge a session file and its distance from what is stored; exit code 1 when it fails the limits.

    Args:
        session: File of samples (.npz).
        exclude: Names of samples to leave out.
        store: Folder of stored calibrations.
    """
    samples, result = _solved(session, "REFINED", exclude, store)
    return _outcome(samples, result, None)


@app.command
def save(
    session: Path,
    *,
    algorithm: str = "REFINED",
    exclude: tuple[str, ...] = (),
    store: Path | None = None,
    force: Annotated[bool, Parameter(negative=())] = False,
) -> Outcome:
    """Solve a session file and store the result; a running graph takes it over at once.

    Args:
        session: File of samples (.npz).
        algorithm: As for `solve`.
        exclude: Names of samples to leave out.
        store: Folder of stored calibrations.
        force: Store also what fails the limits.
    """
    samples, result = _solved(session, algorithm, exclude, store)
    return _outcome(samples, result, _store(store), force=force)


@app.command
def together(
    *sessions: Path, save: Annotated[bool, Parameter(negative=())] = False, store: Path | None = None
) -> Outcome:
    """Solve sessions of several cameras at once: they share the robot's errors, and the board where it is the same.

    Args:
        sessions: Files of samples (.npz), one for each camera.
        save: Store the results, unless one fails.
        store: Folder of stored calibrations.
    """
    from openarm_calibration.report import summary
    from openarm_calibration.samples import load_session
    from openarm_calibration.together import calibrate_together
    from openarm_common.description import RobotDescription

    if len(sessions) < 2:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{len(sessions)} sessions given, expected two or more; one: `solve`")
    opened = [load_session(session, RobotDescription.load()) for session in sessions]
    results = calibrate_together(
        [samples for samples, _ in opened],
        hashes=[digest for _, digest in opened],
        created=_now(),
        stored=[_stored(samples, store) for samples, _ in opened],
    )
    names = [samples.head.camera for samples, _ in opened]
    data: dict[str, Any] = {"cameras": {n: result.as_json() for n, result in zip(names, results, strict=True)}}
    text = "\n\n".join(summary(result) for result in results)
    grades = ", ".join(f"{n} {result.verdict.grade}" for n, result in zip(names, results, strict=True))
    if any(result.verdict.grade == "fail" for result in results):
        return Outcome(False, f"{grades}; nothing was stored", Code.DEGENERATE, data, text)
    if save:
        paths = [str(_store(store).save(result.calibration)) for result in results]
        return Outcome(True, f"{grades}. Stored in {', '.join(paths)}", data=data, text=text)
    return Outcome(True, grades, data=data, text=text)


@app.command
def report(session: Path, out: Path, *, exclude: tuple[str, ...] = (), store: Path | None = None) -> Outcome:
    """Write a page with pictures on a session file: coverage, residuals, poses, samples, methods.

    Args:
        session: File of samples (.npz).
        out: HTML file to write.
        exclude: Names of samples to leave out.
        store: Folder of stored calibrations.
    """
    from openarm_calibration.report import page

    if out.suffix not in (".html", ".htm"):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{out}: a report is written as .html")
    samples, result = _solved(session, "REFINED", exclude, store)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(page(samples, result), encoding="utf-8")
    except OSError as error:
        raise OpenArmError(Code.ENVIRONMENT, f"can't write {out}: {error.strerror}") from error
    return Outcome(True, f"{result.verdict.grade}; wrote {out}", data={"written": str(out), **result.as_json()})


@app.command(name="list")
def list_(*, store: Path | None = None) -> Outcome:
    """Name the stored calibrations, with their history.

    Args:
        store: Folder of stored calibrations.
    """
    opened = _store(store)
    data: dict[str, Any] = {"store": str(opened.folder), "cameras": {}}
    lines: list[str] = []
    faults: list[str] = []
    for camera in opened.cameras():
        history = [item.model_dump(mode="json") for item in opened.history(camera)]
        data["cameras"][camera] = {"history": history}
        try:
            lines.append(_line(opened.load(camera)) + f"  ({len(history)} in its history)")
        except OpenArmError as error:
            faults.append(error.message)
            lines.append(f"{camera}: {error.message}")
    if faults:
        return Outcome(False, "; ".join(faults), Code.CONFIG_INVALID, data, "\n".join(lines))
    return Outcome(True, f"{len(lines)} stored in {opened.folder}", data=data, text="\n".join(lines))


@app.command
def rollback(camera: str, *, store: Path | None = None) -> Outcome:
    """Go back to the calibration of a camera before the present one.

    Args:
        camera: Its name.
        store: Folder of stored calibrations.
    """
    now = _store(store).rollback(camera)
    return Outcome(True, f"now in use: {_line(now)}", data=now.model_dump(mode="json"))


def _solved(session: Path, algorithm: str, exclude: tuple[str, ...], store: Path | None) -> tuple[SampleSet, Result]:
    from openarm_calibration.offline import calibrate, checked_algorithm, without_named
    from openarm_calibration.samples import load_session
    from openarm_common.description import RobotDescription

    checked_algorithm(algorithm)
    samples, digest = load_session(session, RobotDescription.load())
    without_named(samples, exclude)
    stored = _stored(samples, store)
    return samples, calibrate(samples, algorithm=algorithm, session=digest, created=_now(), stored=stored)


def _stored(samples: SampleSet, store: Path | None) -> StoredCalibration | None:
    """What is stored of the camera; None also for one of other mounts, whose distance says nothing."""
    found = _store(store).find(samples.head.camera)
    if found is None or found.calibration.mount_seed != samples.head.mount_seed:
        return None
    return found.calibration


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def _outcome(samples: SampleSet, result: Result, store: CalibrationStore | None, *, force: bool = False) -> Outcome:
    from openarm_calibration.report import summary

    data: dict[str, Any] = result.as_json()
    text = summary(result)
    failed = result.verdict.grade == "fail"
    message = f"{result.verdict.grade}: {'; '.join(result.verdict.reasons) or 'within all limits'}"
    if store is not None and (force or not failed):
        path = store.save(result.calibration)
        data["stored"] = str(path)
        return Outcome(True, f"{message}. Stored in {path}", data=data, text=text)
    if store is not None:
        message += f"; not stored (--force of `openarm calibrate save` stores it all the same), {len(samples)} samples"
    return Outcome(not failed, message, Code.DEGENERATE if failed else Code.OK, data, text)


def _store(folder: Path | None) -> CalibrationStore:
    from openarm_calibration.store import CalibrationStore, default_folder

    return CalibrationStore(folder if folder is not None else default_folder())


def _line(item: StoredCalibration) -> str:
    x, y, z = (v * 1e3 for v in item.position)
    seed = "none" if item.mount_seed is None else str(item.mount_seed)
    return (
        f"{item.camera}: {x:.2f}, {y:.2f}, {z:.2f} mm in {item.parent},"
        f" predicted error {item.sigma_translation * 1e3:.3f} mm, {item.samples} samples,"
        f" mount seed {seed}, {item.created or 'undated'}"
    )
