# SPDX-License-Identifier: Apache-2.0
"""Samples for the offline commands of `openarm calibrate`: of a session file, or of a bag."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import Parameter

from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_calibration.board.board import Board
    from openarm_calibration.handeye.offline import Result
    from openarm_calibration.sampling.samples import SampleSet
    from openarm_calibration.store.store import CalibrationStore
    from openarm_common.records import RecordStore
    from openarm_common.robot.learned import LearnedStore, StoredZeros


@Parameter(name="*")
@dataclass(frozen=True)
class Source:
    """Which samples of a file are solved, what a bag does not say, and where calibrations are stored.

    Args:
        exclude: Names of samples to leave out.
        store: Folder of stored calibrations.
        camera: Camera of a bag: whose images are used; needed when it has several.
        board: Board of a bag, such as charuco:7x5:34mm:26mm:DICT_6X6_250, its keys as YAML, or a YAML file; 4x11
            circles when not given.
        carrier: Link that holds the board of a bag when the camera is fixed; that of the right hand when not given.
        mount_seed: Seed of a bag: of simulated mounts; what it says of itself when not given.
        session: File (.npz) to write the samples of a bag to.
    """

    exclude: tuple[str, ...] = ()
    store: Path | None = None
    camera: str = ""
    board: str = ""
    carrier: str = ""
    mount_seed: int | None = None
    session: Path | None = None


#: No option is given.
ALL_SAMPLES = Source()
_OF_BAGS = ("camera", "board", "carrier", "mount_seed", "session")


@dataclass(frozen=True, eq=False)
class Solved:
    """Samples, the result, and what became of the images of a bag (empty for a session file)."""

    samples: SampleSet
    result: Result
    stills: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    text: str = ""


def with_solved(
    path: Path,
    source: Source,
    then: Callable[[Solved], Outcome],
    *,
    algorithm: str = "REFINED",
    free_intrinsics: bool = False,
) -> Outcome:
    """Open a session file or a bag, solve it, and go on; what a bag lacks for that is reported with its stills.

    Args:
        path: Session file (.npz), or a bag.
        source: Options of the command line.
        then: Makes the outcome of what was solved.
        algorithm: REFINED, or a closed form.
        free_intrinsics: Estimate the intrinsics, too.

    Raises:
        OpenArmError: Fault of the file or the options; DEGENERATE, when a session determines nothing.
    """
    from openarm_calibration.handeye.closed_form import REFINED
    from openarm_calibration.handeye.offline import calibrate, checked_algorithm
    from openarm_calibration.handeye.solve import SolveConfig
    from openarm_common.records import now

    name = checked_algorithm(algorithm)
    if free_intrinsics and name != REFINED:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--free-intrinsics: only {REFINED} finds intrinsics, not {name}")
    config = SolveConfig(extras=("intrinsics",)) if free_intrinsics else None
    samples, digest, stills, text = opened(path, source)
    stored = store_in(source.store).in_use(samples.head.camera, samples.head.mount_seed)
    try:
        result = calibrate(samples, algorithm=name, config=config, session=digest, created=now(), stored=stored)
    except OpenArmError as error:
        if not stills:
            raise
        return Outcome(False, error.message, error.code, {"stills": stills}, text)
    return then(Solved(samples, result, stills, text))


def opened(path: Path, source: Source) -> tuple[SampleSet, str, list[dict[str, Any]], str]:
    """Open a session file or a bag at the stored zeros of its robot's joints.

    Args:
        path: Session file (.npz), or a bag.
        source: Options of the command line.

    Returns:
        Samples, their hash, what became of the images of a bag, and the same as text.

    Raises:
        OpenArmError: Fault of the file or the options.
    """
    from openarm_bringup.bags.files import is_recording
    from openarm_calibration.handeye.offline import without_named

    if path.is_dir() or is_recording(path):
        samples, digest, stills, text = _from_bag(path, source)
    else:
        samples, digest = _from_session(path, source)
        stills, text = [], ""
    without_named(samples, source.exclude)
    return at_stored_zeros(samples, source.store), digest, stills, text


def at_stored_zeros(samples: SampleSet, store: Path | None) -> SampleSet:
    """Return samples of a robot with the zeros of its joints that are stored; a foreign robot's stay as they are.

    Args:
        samples: Samples of a session.
        store: Folder of stored calibrations.

    Raises:
        OpenArmError: CONFIG_INVALID, when the stored zeros are damaged.
    """
    from openarm_common.robot.zeros import REAL

    of = samples.head.zeros_of
    if samples.foreign or (of == REAL and samples.head.mount_seed is not None):  # simulated, by an older version
        return samples
    return samples.with_zeros(zeros_in(store).in_use(of).offsets)


def _from_session(path: Path, source: Source) -> tuple[SampleSet, str]:
    from openarm_calibration.sampling.samples import load_session
    from openarm_common.robot.description import RobotDescription

    given = [f"--{name.replace('_', '-')}" for name in _OF_BAGS if getattr(source, name) != getattr(ALL_SAMPLES, name)]
    if given:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{', '.join(given)}: for a bag (folder of rosbag2, .mcap, .db3) only; a session file such as {path} says"
            " it itself",
        )
    return load_session(path, RobotDescription.load())


def _from_bag(path: Path, source: Source) -> tuple[SampleSet, str, list[dict[str, Any]], str]:
    from openarm_bringup.bags.about import require_robot
    from openarm_bringup.bags.bag import open_bag
    from openarm_bringup.calibration.ros.samples import samples_of
    from openarm_calibration.sampling import stills

    session = source.session
    if session is not None and session.suffix != ".npz":
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--session {session}: expected a name that ends in .npz")
    if source.mount_seed is not None and source.mount_seed < 0:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--mount-seed {source.mount_seed}: expected 0 or more")
    board = given_board(source.board)
    with open_bag(path) as bag:
        require_robot(bag)
        samples, found = samples_of(bag, source.camera, board, source.carrier, source.mount_seed)
    digest = samples.save(session) if session is not None else samples.digest()
    return samples, digest, stills.rows(found), stills.summary(found)


def given_board(text: str) -> Board:
    """Return the board of an option `--board`.

    Raises:
        OpenArmError: INVALID_ARGUMENT, with what is valid.
    """
    from openarm_calibration.board.board import read_board

    try:
        return read_board(text, "--board")
    except OpenArmError as error:
        raise OpenArmError(Code.INVALID_ARGUMENT, error.message) from error


def stored_in(folder: Path | None) -> dict[str, tuple[RecordStore[Any], str]]:
    """Return all that is stored in a folder, as store and name, by what users call it; errors as `store_in`."""
    from openarm_calibration.store.table import StoredTable
    from openarm_common.records import RecordStore
    from openarm_common.robot.learned import StoredHands, StoredZeros
    from openarm_common.robot.servo_store import StoredServos

    cameras, out = store_in(folder), dict[str, tuple[RecordStore[Any], str]]()
    kinds = (StoredTable, StoredZeros, StoredHands, StoredServos)
    for stored in (cameras, *(RecordStore(cameras.folder, kind) for kind in kinds)):
        place, usual = stored.kind.place, stored.kind.usual
        for name in stored.names():
            out[place if name == usual else f"{place}/{name}".lstrip("/")] = stored, name
    return out


def zeros_in(folder: Path | None) -> LearnedStore[StoredZeros]:
    """Return the stored zeros of the joints in a folder; errors as `store_in`."""
    from openarm_common.robot.learned import LearnedStore, StoredZeros

    return LearnedStore(store_in(folder).folder, StoredZeros)


def store_in(folder: Path | None) -> CalibrationStore:
    """Return the store of a folder; without one, the default.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is a file.
    """
    from openarm_calibration.store.store import CalibrationStore
    from openarm_common.records import default_folder

    if folder is not None and folder.exists() and not folder.is_dir():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--store {folder} is a file, expected a folder")
    return CalibrationStore(folder if folder is not None else default_folder())
