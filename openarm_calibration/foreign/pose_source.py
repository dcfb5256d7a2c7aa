# SPDX-License-Identifier: Apache-2.0
"""Poses of a robot and of a board in the files of other tools, whatever their form.

A document (YAML, JSON, OpenCV's FileStorage, NumPy's arrays; a file, or one for each pose in a folder) is searched for
what can be a pose: a 4x4 or 3x4 matrix, a position and a quaternion, rotation vector or angles, a rotation matrix and a
translation. What has the same name in each record is one column of poses; names of columns tell which is the robot's
and which is the board's. A table has a pose, or one of either, in a line; its header or `--columns` names the numbers.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from openarm_calibration.foreign.pose_documents import MOST, Column, searched
from openarm_calibration.foreign.pose_tables import of_table
from openarm_calibration.handeye.problem import Setup
from openarm_common.documents import DOCUMENTS, TABLES, number, read_cells, read_document
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.types import Array

#: Kinds of cameras by the names that are in use for them.
KINDS: dict[str, Setup] = {"eye_in_hand": "in_hand", "eye_on_hand": "in_hand", "eye_to_hand": "to_hand",
                           "eye_on_base": "to_hand"}  # fmt: skip
#: Name of the robot's poses in a file of easy_handeye2, which has those for a fixed camera the other way round.
EASY_HANDEYE2 = "samples.robot"
_ROBOT = ("robot", "gripper", "hand", "effector", "eef", "ee", "tcp", "tool", "tool0", "flange", "tip", "arm", "end",
          "fk")  # fmt: skip
_BOARD = ("board", "target", "tracking", "optical", "marker", "object", "obj", "camera", "cam", "eye", "pattern",
          "chessboard", "checkerboard", "charuco", "tag", "sensor", "color", "rgb", "tvec", "rvec")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Source:
    """What a file holds.

    Args:
        robot: Poses of the robot.
        board: Poses of the board in the camera; None where there are none.
        corners: Corners of the board in the images; None where there are none.
        images: (n,) names of images; () where they are not named.
        kind: Kind of the camera that the file states; "" where it does not.
        frames: Names of base, tip and camera, where the file has them.
        left_out: Records that have a pose of one of the two only.
    """

    robot: Column
    board: Column | None = None
    corners: Column | None = None
    images: tuple[str, ...] = ()
    kind: str = ""
    frames: Mapping[str, str] = field(default_factory=dict[str, str])
    left_out: tuple[str, ...] = ()


def kind_of(name: str, what: str) -> Setup:
    """Return the set-up that a name of a kind of camera stands for.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the kinds; `what` says why it is needed.
    """
    if name not in KINDS:
        given = (
            f"no kind of camera {brief(name)}" if name else f"{what} does not say whether the hand carries the camera"
        )
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{given}; give --camera-kind eye_in_hand or eye_to_hand")
    return KINDS[name]


def read_source(path: Path, other: Path | None = None, columns: str = "", roles: str = "") -> Source:
    """Read poses, and what else a file holds.

    Args:
        path: File, or folder with a file for each pose.
        other: A second one, of the board, where the poses are in two.
        columns: Names of the columns of a table, such as `image x y z qx qy qz qw`; those of the second behind a `;`.
        roles: Names of the robot's poses and of the board's in the file, such as `A,B`; "": found by their names.

    Raises:
        OpenArmError: CONFIG_INVALID, naming what is wrong, and what is read.
    """
    first, _, behind = columns.partition(";")
    found, images, document = _columns_of(path, tuple(first.replace(",", " ").split()))
    if other is not None:
        more, _, _ = _columns_of(other, tuple(behind.replace(",", " ").split()))
        if len(found) != 1 or len(more) != 1:
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"{path} has the poses {_listed(found)} and {other} {_listed(more)}; expected one column in each",
            )
        found = [_named(found[0], "robot"), _named(more[0], "board")]
    robot, second = _named_by(path, found, roles) if roles else _told_apart(path, found)
    left_out: tuple[str, ...] = ()
    if second is not None:
        robot, second, left_out = _aligned(path, robot, second)
    board = None if second is None or second.corners else second
    corners = second if second is not None and second.corners else None
    said: Any = document.get("parameters") if isinstance(document, dict) else None  # pyright: ignore
    about = {key: str(value) for key, value in said.items()} if isinstance(said, dict) else {}  # pyright: ignore
    kind = about.get("calibration_type", "")
    if isinstance(document, dict) and not kind:  # pyright: ignore
        kind = next(
            (str(document[key]) for key in ("setup", "camera_kind", "kind", "type") if str(document.get(key)) in KINDS),
            "",
        )  # pyright: ignore
    frames = {
        key: about.get(f"{name}_frame", "")
        for key, name in (("base", "robot_base"), ("tip", "robot_effector"), ("camera", "tracking_base"))
    }
    return Source(robot, board, corners, images, kind, frames, left_out)


def _named(column: Column, name: str) -> Column:
    return replace(column, name=f"{name} {column.name}")


def _columns_of(path: Path, names: tuple[str, ...]) -> tuple[list[Column], tuple[str, ...], Any]:
    """Return the columns of a file or folder, names of images, and the document."""
    if path.is_dir():
        files = sorted(
            (one for one in path.rglob("*") if one.suffix in (*DOCUMENTS, *TABLES) and one.is_file()), key=_natural
        )
        if not files:
            raise OpenArmError(Code.CONFIG_INVALID, f"{path} has no file of poses; read are {_kinds()}")
        if len(files) > 2 * MOST:
            raise OpenArmError(Code.CONFIG_INVALID, f"{path} has {len(files)} files, expected at most {2 * MOST}")
        records = {str(one.relative_to(path).with_suffix("")): _whole(one) for one in files}
        return searched(path, records), (), records
    if path.suffix in TABLES:
        columns, images = of_table(path, read_cells(path), names)
        return columns, images, None
    document = read_document(path)
    return searched(path, document), (), document


def _whole(path: Path) -> Any:
    """Return a file of one pose: a document, or all numbers of a text."""
    if path.suffix not in TABLES:
        return read_document(path)
    rows = [[number(cell) for cell in row] for row in read_cells(path).rows]
    return [one for row in rows for one in row if one is not None]


def _natural(path: Path) -> list[Any]:
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", str(path)) if part]


def _kinds() -> str:
    return f"{', '.join((*DOCUMENTS, *TABLES))}, a folder of those, or a bag"


def _listed(columns: Sequence[Column]) -> str:
    return ", ".join(f"{one.name!r} ({len(one.rows)})" for one in columns[:8]) or "none"


def _told_apart(path: Path, found: list[Column]) -> tuple[Column, Column | None]:
    """Return the robot's poses, and those of the board or its corners, by names."""
    corners = [one for one in found if one.corners]
    poses = [one for one in found if not one.corners]
    if not poses:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} has no poses; it has {_listed(found)}")
    # the frame that moves is named first, or alone: gripper2base, effector_wrt_world, T_base_hand, hand
    robots = [one for one in poses if _score(one, _ROBOT) > _score(one, _BOARD)]
    boards = [one for one in poses if _score(one, _BOARD) > _score(one, _ROBOT)]
    if len(robots) == 1 and len(boards) == 1:
        return robots[0], boards[0]
    if len(poses) == 2 and all(re.fullmatch(r"(.*\.)?(\d|poses)", one.name) for one in poses):
        return poses[0], poses[1]  # pairs in a list: the robot's comes first
    if len(poses) == 1 or (len(robots) == 1 and corners):
        return (poses if len(poses) == 1 else robots)[0], max(corners, key=lambda one: len(one.rows), default=None)
    raise OpenArmError(
        Code.CONFIG_INVALID,
        f"{path} has the poses {_listed(poses)}; expected one column of the robot and one of the board, by names such"
        " as robot, hand, gripper2base and board, eye, target2cam: which is which changes the answer; say it by --roles"
        " ROBOT,BOARD",
    )


def _named_by(path: Path, found: list[Column], roles: str) -> tuple[Column, Column]:
    """Return the columns that two names stand for: those of the robot and of the board."""
    names = [name.strip() for name in roles.split(",")]
    columns = [next((one for one in found if name in (one.name, one.name.rpartition(".")[2])), None) for name in names]
    if len(columns) != 2 or columns[0] is None or columns[1] is None:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--roles {roles}: expected two names of {path}: {_listed(found)}")
    return columns[0], columns[1]


def _score(column: Column, words: tuple[str, ...]) -> int:
    """Return how many parts of a name are among some words."""
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", column.name).lower()
    return sum(part in words for part in re.findall(r"[a-z]+\d*(?=$|[^a-z0-9])|[a-z]+", name))


def _aligned(path: Path, one: Column, other: Column) -> tuple[Column, Column, tuple[str, ...]]:
    """Return two columns whose rows belong together, and the records that only one of them has.

    Records are matched by their numbers or names, by their times, or by their order, in this order of preference.
    """
    keys, others = list(one.keys), list(other.keys)
    shared = {*keys} & {*others}
    if len({*keys}) == len(keys) and len({*others}) == len(others) and 2 * len(shared) > min(len(keys), len(others)):
        mine = [k for k, key in enumerate(keys) if key in shared]
        theirs = [others.index(keys[k]) for k in mine]
    elif one.stamps and other.stamps:
        mine, theirs = _at_once(np.array(one.stamps), np.array(other.stamps))
    elif len(one.rows) == len(other.rows):
        return one, other, ()
    else:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"{path} has {_listed([one, other])}: not as many of either, and neither numbers of records nor times tell"
            " which belong together",
        )
    fewer, used = (one, mine) if len(one.rows) <= len(other.rows) else (other, theirs)
    alone = [label for k, label in enumerate(fewer.labels) if k not in used]
    if not one.stamps or keys:  # else one of the two was recorded more often
        more, known = (other, theirs) if fewer is one else (one, mine)
        alone += [label for k, label in enumerate(more.labels) if k not in known]
    return one.subset(mine), other.subset(theirs), tuple(alone)


def _at_once(first: Array, second: Array) -> tuple[list[int], list[int]]:
    """Return which of two lists of times are the nearest to each other, and nearer than others are to either."""
    apart = np.abs(first[:, None] - second)
    nearest, back = apart.argmin(axis=1), apart.argmin(axis=0)
    step = min((float(np.median(np.diff(np.sort(t)))) for t in (first, second) if len(t) > 1), default=np.inf)
    mine = [k for k, j in enumerate(nearest) if back[j] == k and apart[k, j] <= 0.5 * step]
    return mine, [int(nearest[k]) for k in mine]
