# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate import`: what is read of other tools and robots, and how it is solved."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from openarm_bringup.calibration.foreign_options import NOTHING, Foreign, lens_given
from openarm_bringup.calibration.source import given_board, store_in
from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_calibration.foreign.explain import Poses
    from openarm_calibration.foreign.pose_source import Column, Source
    from openarm_calibration.handeye.problem import Setup
    from openarm_calibration.sampling.samples import SampleSet

_OF_BAGS = ("image_topic", "info_topic", "joint_topic", "urdf")
_OF_VIEWS = ("board", "images", "intrinsics", "session")
_OF_PAIRS = ("board_rotation", "board_unit", "board_frames", "fix")
_OF_POSES = ("with_", "columns", "roles", "rotation", "unit", "frames")
_NOT_OF: dict[str, tuple[str, ...]] = {
    "a bag": (*_OF_POSES, *_OF_PAIRS, "images"),
    "pairs of poses": (*_OF_BAGS, *_OF_VIEWS),
    "poses and images": (*_OF_BAGS, *_OF_PAIRS),
}


def imported(path: Path, given: Foreign) -> Outcome:
    """Read, solve and, if asked to, store.

    Args:
        path: File, folder or bag.
        given: Options of the command line.

    Raises:
        OpenArmError: Fault of file or options; DEGENERATE, when the poses determine nothing.
    """
    from openarm_bringup.bags.files import is_recording
    from openarm_calibration.foreign.explain import Unexplained, table
    from openarm_calibration.foreign.pose_source import read_source

    if not path.exists():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"there is no {path}")
    if is_recording(path):
        _refuse(given, "a bag")
        return _of_bag(path, given)
    source = read_source(path, given.with_, given.columns, given.roles)
    pairs = source.board is not None and given.images is None
    if not pairs and source.corners is None and given.images is None:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{path} has poses of the robot alone ({source.robot.name!r}, {len(source.robot.rows)}); give --images"
            " FOLDER with --board and --intrinsics, or --with FILE, which has the board's poses or corners",
        )
    _refuse(given, "pairs of poses" if pairs else "poses and images")
    try:
        return _of_pairs(path, source, given) if pairs else _of_views(path, source, given)
    except Unexplained as error:
        data = {"conventions": [one.as_json() for one in error.tried]}
        return Outcome(False, error.message, error.code, data, table(error.tried))


def _refuse(given: Foreign, what: str) -> None:
    """Refuse options that are of something else."""
    wrong = [name for name in _NOT_OF[what] if getattr(given, name) != getattr(NOTHING, name)]
    if wrong:
        every = {name for names in _NOT_OF.values() for name in names} - {*_NOT_OF[what]}
        listed = ", ".join(sorted(_option(name) for name in every))
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{_option(wrong[0])} is no option for {what}; options: {listed}")


def _option(name: str) -> str:
    return f"--{name.strip('_').replace('_', '-')}"


def _stated(column: Column, frames: str, given: tuple[str, Any, str | None], inverse: bool) -> Poses:
    """Return poses with what the command line or the file says of them."""
    from openarm_calibration.foreign.conventions import checked_form
    from openarm_calibration.foreign.explain import Poses

    rotation, unit, direction = given
    rotation = checked_form(rotation or column.rotation) if rotation or column.rotation else ""
    inverse = direction != frames if direction else inverse
    said: Any = unit or column.unit or None
    return Poses(column.rows, frames, rotation, said, inverse, column.labels)


def _robot(source: Source, given: Foreign, setup: Setup) -> Poses:
    """Return the robot's poses; easy_handeye2 writes those for a fixed camera the other way round."""
    from openarm_calibration.foreign.explain import ROBOT_FRAMES
    from openarm_calibration.foreign.pose_source import EASY_HANDEYE2

    inverse = setup == "to_hand" if source.robot.name == EASY_HANDEYE2 else source.robot.inverse("robot")
    return _stated(source.robot, ROBOT_FRAMES, (given.rotation, given.unit, given.frames), inverse)


def _of_pairs(path: Path, source: Source, given: Foreign) -> Outcome:
    from openarm_calibration.foreign.explain import BOARD_FRAMES, KIND, decided, search, table
    from openarm_calibration.foreign.image_sets import Names
    from openarm_calibration.foreign.pair_result import pair_result
    from openarm_calibration.foreign.pose_source import EASY_HANDEYE2, KINDS, kind_of
    from openarm_calibration.handeye.pose_pairs import PosePairs
    from openarm_common.records import now

    assert source.board is not None
    of_board = (given.board_rotation, given.board_unit, given.board_frames)
    board = _stated(source.board, BOARD_FRAMES, of_board, source.board.inverse("board"))
    kind = given.camera_kind or source.kind
    if kind not in KINDS:
        tried = search(_robot(source, given, "in_hand"), board, ("in_hand", "to_hand"))
        # which of the two the poses tell where their direction is known
        certain = tried[0].fits and source.robot.name != EASY_HANDEYE2
        fits = f": {tried[0].text} leaves {tried[0].left}" if certain else ""
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{path} does not say whether the hand carries the camera; give --camera-kind eye_in_hand or"
            f" eye_to_hand{fits}",
        )
    setup = kind_of(kind, str(path))
    labels = source.robot.labels
    robot = _robot(source, given, setup)
    tried = search(robot, board, (setup,))
    chosen = decided(tried, (setup,), robot, board)
    A, C = chosen.robot.poses(source.robot.rows), chosen.board.poses(source.board.rows)
    assert A is not None  # both were tried
    assert C is not None
    C[:, :3, 3] *= chosen.scale
    names = Names(
        given.camera, given.base or source.frames.get("base") or "base", given.tip or source.frames.get("tip") or "tip"
    )
    result = pair_result(PosePairs(setup, A, C, labels), names, created=now(), fixed=given.fixed, scale=chosen.scale)
    message = f"{result.grade}: {'; '.join(result.reasons) or 'within all limits'}"
    if source.kind in KINDS and KINDS[source.kind] != setup:
        message += f" ({path} says {source.kind}; the poses say {KIND[setup]})"
    if source.left_out:
        message += f" (a pose of one of the two only: {', '.join(source.left_out)})"
    data = {"format": "pairs", "conventions": [one.as_json() for one in tried], **result.as_json()}
    who = f"the robot's poses are {source.robot.name!r}, the board's {source.board.name!r}"
    text = f"{who}\n{table(tried[:1])}\n\n{result.text}"
    if result.grade == "fail":
        kept = "; not stored" if given.save else ""
        return Outcome(False, message + kept, Code.DEGENERATE, data, text)
    if given.save:
        stored = store_in(given.store).save(result.calibration)
        return Outcome(True, f"{message}. Stored in {stored}", data=data | {"stored": str(stored)}, text=text)
    return Outcome(True, message, data=data, text=text)


def _of_views(path: Path, source: Source, given: Foreign) -> Outcome:
    from openarm_calibration.foreign.image_sets import Names, image_set
    from openarm_calibration.foreign.pose_source import kind_of

    setup = kind_of(given.camera_kind or source.kind, str(path))
    for name, value in (("board", given.board), ("intrinsics", given.intrinsics)):
        if not value:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"poses with images or corners need --{name}; {path} has none")
    board, lens = given_board(given.board), lens_given(given.intrinsics)
    names = Names(given.camera, given.base or "base", given.tip or "tip")
    found = image_set(source, given.images, board, lens, _robot(source, given, setup), setup, names)
    tried = [one.as_json() for one in found.tried]
    return _solved(found.samples, given, found.text, {"format": "views", "images": found.rows, "conventions": tried})


def _of_bag(path: Path, given: Foreign) -> Outcome:
    from openarm_bringup.bags.bag import open_bag
    from openarm_bringup.calibration.ros.foreign_bag import samples_of_foreign
    from openarm_calibration.sampling import stills

    board = given_board(given.board)
    with open_bag(path) as bag:
        samples, found = samples_of_foreign(bag, board, given)
    return _solved(samples, given, stills.summary(found), {"format": "bag", "stills": stills.rows(found)})


def _solved(samples: SampleSet, given: Foreign, text: str, data: dict[str, Any]) -> Outcome:
    """Write the session if asked to, solve, and report."""
    from openarm_calibration.handeye.offline import calibrate
    from openarm_calibration.report.report import summary
    from openarm_common.records import now

    digest = samples.save(given.session) if given.session is not None else samples.digest()
    if given.session is not None:
        data["session"] = str(given.session)
    try:
        result = calibrate(samples, session=digest, created=now())
    except OpenArmError as error:
        return Outcome(False, error.message, error.code, data, text)
    data |= result.as_json()
    text = f"{text}\n\n{summary(result)}"
    message = f"{result.verdict.grade}: {'; '.join(result.verdict.reasons) or 'within all limits'}"
    if result.verdict.grade == "fail":
        kept = "; not stored" if given.save else ""
        return Outcome(False, message + kept, Code.DEGENERATE, data, text)
    if given.save:
        stored = store_in(given.store).save(result.calibration)
        return Outcome(True, f"{message}. Stored in {stored}", data=data | {"stored": str(stored)}, text=text)
    return Outcome(True, message, data=data, text=text)
