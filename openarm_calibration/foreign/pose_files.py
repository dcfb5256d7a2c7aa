# SPDX-License-Identifier: Apache-2.0
"""Files of poses of other tools: samples of easy_handeye2 and of moveit_calibration, and tables of numbers.

easy_handeye2 writes its message SampleList as YAML: `robot` is base to effector for a camera on the hand, and effector
to base for a fixed one; `tracking` is camera to marker. moveit_calibration writes a list of `effector_wrt_world` and
`object_wrt_sensor`, 4x4 by rows, for both kinds of camera; its test files are pairs of matrices in JSON. m.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from openarm_calibration.handeye.closed_form import nearest_rotation
from openarm_calibration.handeye.pose_pairs import PosePairs
from openarm_calibration.handeye.problem import Setup, inverses
from openarm_common import se3
from openarm_common.config import parse_json, parse_yaml, read_text
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.types import Array

#: Most poses of a file.
MOST = 2000
#: A matrix or quaternion may be off a rotation by this: files have few digits.
_LOOSE = 1e-3
#: Kinds of cameras by the names that are in use for them.
KINDS: dict[str, Setup] = {"eye_in_hand": "in_hand", "eye_on_hand": "in_hand", "eye_to_hand": "to_hand",
                           "eye_on_base": "to_hand"}  # fmt: skip


@dataclass(frozen=True)
class PoseFile:
    """Pairs of poses and what the file says of its frames ("" where it says nothing)."""

    pairs: PosePairs
    base: str = ""
    tip: str = ""
    camera: str = ""


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of a CSV: names (of images) where it has them, and numbers (n, k)."""

    names: tuple[str, ...]
    rows: Array


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


def read_easy_handeye2(path: Path, kind: str) -> PoseFile:
    """Read samples of easy_handeye2.

    Args:
        path: File, such as NAME.samples.
        kind: Of the camera; "": as the file says, which it often does not.

    Raises:
        OpenArmError: CONFIG_INVALID, naming the sample that is wrong; INVALID_ARGUMENT, when the kind is not known.
    """
    document: Any = parse_yaml(read_text(path), str(path))
    samples: Any = document.get("samples") if isinstance(document, dict) else None  # pyright: ignore
    if not isinstance(samples, list):
        raise _no_file(path, "easy_handeye2", "a mapping with a list `samples` of `robot` and `tracking`")
    parameters: Any = document.get("parameters") or {}
    said = {key: str(value) for key, value in parameters.items()} if isinstance(parameters, dict) else {}  # pyright: ignore
    setup = kind_of(kind or said.get("calibration_type", ""), f"{path}:parameters.calibration_type")
    A, C = _pairs(path, samples, _of_message, (("robot",), ("tracking", "optical")))  # pyright: ignore
    pairs = PosePairs(setup, A if setup == "in_hand" else inverses(A), C, _numbered(len(A)))
    frames = (said.get(f"{key}_frame", "") for key in ("robot_base", "robot_effector", "tracking_base"))
    return PoseFile(pairs, *frames)


def read_moveit(path: Path, kind: str) -> PoseFile:
    """Read samples of moveit_calibration, YAML or JSON; arguments and errors as `read_easy_handeye2`."""
    text = read_text(path)
    document: Any = (
        parse_json(text, str(path), Code.CONFIG_INVALID) if path.suffix == ".json" else parse_yaml(text, str(path))
    )
    if not isinstance(document, list):
        raise _no_file(path, "moveit_calibration", "a list of `effector_wrt_world` and `object_wrt_sensor`")
    setup = kind_of(kind, str(path))
    A, C = _pairs(path, document, _of_matrix, (("effector_wrt_world", 0), ("object_wrt_sensor", 1)))  # pyright: ignore
    return PoseFile(PosePairs(setup, A, C, _numbered(len(A))))


def _no_file(path: Path, tool: str, expected: str) -> OpenArmError:
    return OpenArmError(Code.CONFIG_INVALID, f"{path} has no samples of {tool}: expected {expected}")


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(f"s{k + 1:03d}" for k in range(count))


def _pairs(path: Path, samples: list[Any], read: Any, keys: tuple[tuple[Any, ...], ...]) -> tuple[Array, Array]:
    """Return both poses (n, 4, 4) of samples; each is under one of its keys."""
    if len(samples) > MOST:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} has {len(samples)} samples, expected at most {MOST}")
    out = np.empty((2, len(samples), 4, 4))
    for k, sample in enumerate(samples):
        for which, names in enumerate(keys):
            where = f"{path}: sample {k + 1}"
            try:
                if isinstance(sample, list):
                    value: Any = sample[names[-1]]  # pyright: ignore[reportUnknownVariableType]
                else:
                    value = next(sample[name] for name in names if name in sample)
            except (LookupError, TypeError, StopIteration) as error:
                raise OpenArmError(Code.CONFIG_INVALID, f"{where} has no {names[0]!r}") from error
            out[which, k] = read(value, f"{where}: {names[0]}")
    return out[0], out[1]


def _of_message(value: Any, where: str) -> Array:
    """Return the pose of a geometry_msgs/Transform as YAML."""
    try:
        p = [float(value["translation"][axis]) for axis in "xyz"]
        q = np.array([float(value["rotation"][axis]) for axis in "xyzw"])
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{where} is no transform: expected translation x y z and rotation x y z w"
        ) from error
    length = float(np.linalg.norm(q))
    if not np.isfinite(p).all() or not abs(length - 1.0) < _LOOSE:
        raise OpenArmError(Code.CONFIG_INVALID, f"{where}: a quaternion of length {length:g}, or a place that is none")
    return se3.make(se3.matrix_from_quat_xyzw(q / length), p)


def _of_matrix(value: Any, where: str) -> Array:
    """Return the pose of a 4x4 matrix, as one list or as four."""
    try:
        M = np.array(value, dtype=np.float64).reshape(4, 4)
    except (TypeError, ValueError, OverflowError) as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"{where} is no 4x4 matrix of numbers") from error
    R = M[:3, :3]
    rigid = np.isfinite(M).all() and np.abs(R @ R.T - np.eye(3)).max() < _LOOSE and np.linalg.det(R) > 0.0
    if not rigid or not np.allclose(M[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{where} is no pose: expected a rotation, a translation, and 0 0 0 1 as its last row"
        )
    return se3.make(nearest_rotation(R), M[:3, 3])


def read_table(path: Path) -> Table:
    """Read a CSV of poses, a pose a line: a name of an image, if any, then position and rotation.

    A first line of words is a header and is left out; commas, semicolons, tabs or blanks separate.

    Raises:
        OpenArmError: CONFIG_INVALID, naming the line that is wrong.
    """
    lines = [line for line in read_text(path).splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if len(lines) > MOST + 1:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} has {len(lines)} lines, expected at most {MOST} poses")
    split = next((mark for mark in (",", ";", "\t") if lines and mark in lines[-1]), None)
    cells = [next(csv.reader([line], delimiter=split)) if split else line.split() for line in lines]
    cells = [[cell.strip() for cell in row if cell.strip()] for row in cells]
    if cells and sum(_number(cell) is None for cell in cells[0]) > 1:
        cells = cells[1:]
    if not cells or all(_number(cell) is None for cell in cells[0]):
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} has no poses: expected a line of numbers for each")
    names: list[str] = []
    rows: list[list[float]] = []
    for k, row in enumerate(cells):
        words = [cell for cell in row if _number(cell) is None]
        numbers = [value for cell in row if (value := _number(cell)) is not None]
        if len(words) > 1 or len(numbers) != len([c for c in cells[0] if _number(c) is not None]):
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"{path}: pose {k + 1} has {len(numbers)} numbers and {len(words)} words, expected as many numbers as"
                " the first, and at most the name of an image",
            )
        names += words
        rows.append(numbers)
    if names and len(names) != len(rows):
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} names an image in {len(names)} of {len(rows)} poses")
    return Table(tuple(names), np.array(rows))


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
