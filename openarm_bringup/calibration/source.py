# SPDX-License-Identifier: Apache-2.0
"""What the offline commands of `openarm calibrate` work on: a session file, or a bag of which samples are taken."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import Parameter

from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_calibration.board.board import Board
    from openarm_calibration.handeye.offline import Result
    from openarm_calibration.sampling.samples import SampleSet
    from openarm_calibration.store.store import CalibrationStore, StoredCalibration


@Parameter(name="*")
@dataclass(frozen=True)
class Recording:
    """What a bag does not say.

    Args:
        camera: Of a bag: whose images are used; needed when it has several.
        board: Of a bag: keys of the board as YAML, such as "{kind: charuco}"; 4x11 circles when not given.
        carrier: Of a bag: link that holds the board when the camera stands; that of the right hand when not given.
        mount_seed: Of a bag: of simulated mounts; what it says of itself when not given.
        session: Of a bag: file (.npz) to write the samples to.
    """

    camera: str = ""
    board: str = ""
    carrier: str = ""
    mount_seed: int | None = None
    session: Path | None = None


#: No option of a bag was given.
NOT_GIVEN = Recording()


@dataclass(frozen=True, eq=False)
class Solved:
    """Samples, what they give, and what became of the images of a bag (empty for a session file)."""

    samples: SampleSet
    result: Result
    stills: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    text: str = ""


def with_solved(
    source: Path,
    recording: Recording,
    exclude: tuple[str, ...],
    store: Path | None,
    then: Callable[[Solved], Outcome],
    *,
    algorithm: str = "REFINED",
    free_intrinsics: bool = False,
) -> Outcome:
    """Open a session file or a bag, solve it, and go on; what a bag lacks for that is told with its stills.

    Raises:
        OpenArmError: What is wrong with the file or the options; DEGENERATE, when a session determines nothing.
    """
    from openarm_calibration.handeye.offline import REFINED, calibrate, checked_algorithm, without_named
    from openarm_calibration.handeye.solve import SolveConfig

    name = checked_algorithm(algorithm)
    if free_intrinsics and name != REFINED:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--free-intrinsics: only {REFINED} finds intrinsics, not {name}")
    config = SolveConfig(extras=("intrinsics",)) if free_intrinsics else None
    stills: list[dict[str, Any]] = []
    text = ""
    if source.is_dir() or source.suffix == ".mcap":
        samples, digest, stills, text = _from_bag(source, recording)
    else:
        samples, digest = _from_session(source, recording)
    without_named(samples, exclude)
    stored = stored_of(samples, store)
    try:
        result = calibrate(samples, algorithm=name, config=config, session=digest, created=now(), stored=stored)
    except OpenArmError as error:
        if not stills:
            raise
        return Outcome(False, error.message, error.code, {"stills": stills}, text)
    return then(Solved(samples, result, stills, text))


def _from_session(path: Path, recording: Recording) -> tuple[SampleSet, str]:
    from openarm_calibration.sampling.session_file import load_session
    from openarm_common.robot.description import RobotDescription

    given = [f"--{f.name.replace('_', '-')}" for f in fields(recording) if getattr(recording, f.name) != f.default]
    if given:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{', '.join(given)}: for a bag (folder of rosbag2, or .mcap) only; a session file such as {path} says it"
            " itself",
        )
    return load_session(path, RobotDescription.load())


def _from_bag(path: Path, recording: Recording) -> tuple[SampleSet, str, list[dict[str, Any]], str]:
    from openarm_bringup.bags.bag import open_bag
    from openarm_bringup.calibration.ros.samples import BagOptions, samples_of
    from openarm_calibration.sampling import stills

    session = recording.session
    if session is not None and session.suffix != ".npz":
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--session {session}: expected a name that ends in .npz")
    if recording.mount_seed is not None and recording.mount_seed < 0:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--mount-seed {recording.mount_seed}: expected 0 or more")
    options = BagOptions(recording.camera, _board(recording.board), recording.carrier, recording.mount_seed)
    with open_bag(path) as bag:
        samples, found = samples_of(bag, options)
    digest = samples.save(session) if session is not None else samples.digest()
    return samples, digest, stills.rows(found), stills.told(found)


def _board(text: str) -> Board:
    from openarm_calibration.board.board import read_board

    try:
        return read_board(text, "--board")
    except OpenArmError as error:
        raise OpenArmError(Code.INVALID_ARGUMENT, error.message) from error


def store_in(folder: Path | None) -> CalibrationStore:
    """The store of a folder; without one, the default.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is a file.
    """
    from openarm_calibration.store.store import CalibrationStore, default_folder

    if folder is not None and folder.exists() and not folder.is_dir():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--store {folder} is a file, expected a folder")
    return CalibrationStore(folder if folder is not None else default_folder())


def stored_of(samples: SampleSet, store: Path | None) -> StoredCalibration | None:
    """What is stored of the camera; None also for one of other mounts, whose distance says nothing."""
    found = store_in(store).find(samples.head.camera)
    if found is None or found.calibration.mount_seed != samples.head.mount_seed:
        return None
    return found.calibration


def now() -> str:
    """Date and time for the record."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
