# SPDX-License-Identifier: Apache-2.0
"""What can be a pose in a document, or the corners of a board in an image: nested lists, mappings and arrays."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from openarm_common.documents import number
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

#: Most poses of a file, and most levels of a document.
MOST, _DEEPEST = 2000, 12
#: A name such as base2gripper, or base_to_gripper, is of poses the other way round.
_BACK = r"(?:2|_?to_?)"
_INVERSE = {
    "robot": re.compile(rf"(?:base|world|robot){_BACK}(?:gripper|hand|ee|eef|effector|end|tcp|tool|flange|tip|link)"),
    "board": re.compile(rf"(?:cam|camera|eye|sensor|optical){_BACK}(?:target|board|marker|object|obj|tag|pattern)"),
}  # fmt: skip
_PLACE = ("translation", "position", "trans", "pos", "tvec", "t", "xyz", "p", "location")
_TURN = ("rotation", "orientation", "quaternion", "quat", "q", "rot", "rvec", "rotvec", "r", "rpy", "euler")
#: Parts of names of rotations and of translations that are written apart.
_TURNS = ("rvec", "rvecs", "rot", "rotation", "rotations", "r")
_SHIFTS = ("tvec", "tvecs", "trans", "translation", "translations", "t", "pos", "position", "positions")
#: Of mappings and lists on the way to a pose.
_Keys = tuple[str | int, ...]
_PART = re.compile("|".join((*_PLACE, *_TURN, "[xyzabcw]", "[qr][xyzw]", "roll", "pitch", "yaw")))
_LETTERS = ("x", "y", "z", "w")


@dataclass(frozen=True, eq=False)
class Column:
    """What has the same name in each record.

    Args:
        name: Name in its file.
        rows: (n, k) numbers of poses, position first; of corners (n, m, 2) px, or (n, m, 3) with the number of each
            corner first, NaN beyond those of a record.
        labels: (n,) of the records.
        rotation: Form that the file tells; "" where it does not.
        unit: The same of positions.
        keys: (n,) what says which records of two columns belong together; () where nothing does.
        stamps: (n,) times, s or ns; () where there are none.
    """

    name: str
    rows: Array
    labels: tuple[str, ...]
    rotation: str = ""
    unit: str = ""
    keys: tuple[str, ...] = ()
    stamps: tuple[float, ...] = ()

    @property
    def corners(self) -> bool:
        """Whether these are corners in images."""
        return self.rows.ndim == 3

    def subset(self, chosen: list[int]) -> Column:
        """Return some of the records."""
        keys, stamps = (tuple(each[k] for k in chosen) if each else () for each in (self.keys, self.stamps))
        labels = tuple(self.labels[k] for k in chosen)
        return replace(self, rows=self.rows[chosen], labels=labels, keys=keys, stamps=stamps)

    def inverse(self, whose: str) -> bool:
        """Whether its name says that the poses are the other way round; `whose` is robot or board."""
        return _INVERSE[whose].search(self.name.lower()) is not None


def searched(path: Path, document: Any) -> list[Column]:
    """Return what is repeated in a document and can be poses or corners."""
    found: dict[tuple[str, int], list[tuple[str, Array, str]]] = {}
    for keys, value, form in _poses(document, ()):
        name, label = _name_of(keys)
        numbered = value.ndim == 2 and value.shape[1] == 3
        size = value.size if value.ndim == 1 else 0 if numbered else -value.size
        found.setdefault((name, size), []).append((label, value, form))
    out: list[Column] = []
    for (name, _), entries in found.items():
        forms = {form for _, _, form in entries}
        rows = _stacked([value for _, value, _ in entries])
        labels = tuple(label for label, _, _ in entries)
        keys = tuple((re.findall(r"\d+", label) or [label])[-1] for label in labels)
        out.append(Column(name, rows, labels, forms.pop() if len(forms) == 1 else "", keys=keys))
    most = max((len(one.rows) for one in out), default=0)
    if most > MOST:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} has {most} poses, expected at most {MOST}")
    if most < 2:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"{path} has no poses that are repeated: read are 4x4 or 3x4 matrices, position and quaternion, rotation"
            " vector or angles, a rotation matrix and a translation, under the same name in each record; or give a"
            " table with --columns",
        )
    # what stands once is about the camera, or a result
    return [one for one in out if len(one.rows) > 1]


def _stacked(values: list[Array]) -> Array:
    """Return values as one array; of corners with numbers there may be more in one record than in another."""
    most = max(len(value) for value in values)
    return np.array([np.pad(value, ((0, most - len(value)), *((0, 0),) * (value.ndim - 1)), constant_values=np.nan)
                     for value in values])  # fmt: skip


def _name_of(keys: _Keys) -> tuple[str, str]:
    """Return the name of a column, without what counts the records, and the record."""
    words: list[str] = []
    label = ""
    for key in keys:
        counted = isinstance(key, int) or re.search(r"\d", re.sub(r"\d(?=[a-z])", "", key))
        if counted and not label:
            label = f"record {key + 1}" if isinstance(key, int) else key
            word = "" if isinstance(key, int) else re.sub(r"[_\-. ]*\d+$|^\d+[_\-. ]*", "", key)
        else:
            word = str(key)
        if word:
            words.append(word)
    return ".".join(words) or "poses", label or "record"


def _poses(value: Any, keys: _Keys) -> Iterator[tuple[_Keys, Array, str]]:
    """Yield what can be a pose (k,) or corners (m, 2), with its keys and the form that it tells."""
    if len(keys) > _DEEPEST:
        return
    if isinstance(value, dict):
        entries: dict[str, Any] = {str(key): one for key, one in value.items()}  # pyright: ignore
        matrix = _storage_matrix(entries)
        if matrix is not None:
            yield from _poses(matrix, keys)
            return
        entries = {key: one for key, one in entries.items() if "joint" not in key.lower()}
        pose = _of_parts(entries)
        if pose is not None:
            # what stands next to it may be another one
            entries = {key: one for key, one in entries.items() if not _PART.fullmatch(key.lower().lstrip("_"))}
            others = any(True for _ in _poses(entries, keys))
            yield (*keys, "rvec tvec") if others else keys, *pose
            if not others:
                return
        yield from _of_pairs(entries, keys)
        numbered, entries = _numbered(entries)
        if numbered is not None:
            yield (*keys, "corners"), numbered, ""
        for key, one in entries.items():
            yield from _poses(one, (*keys, key))
        return
    if not isinstance(value, list | tuple | np.ndarray):
        return
    array = _numbers(value)
    if array is not None and array.ndim >= 3 and array.shape[-2:] == (1, 2):
        array = array[..., 0, :]  # OpenCV has a list of one point for each corner
    if array is None:
        for k, one in enumerate(value):  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
            yield from _poses(one, (*keys, k))
    elif _is_pose(array):
        yield keys, array.ravel(), ""
    elif array.ndim == 2 and array.shape[1] == 2 and len(array) >= 4:
        yield keys, array, ""
    elif array.ndim >= 2:
        for k, one in enumerate(array):
            yield from _poses(one, (*keys, k))


def _numbered(entries: dict[str, Any]) -> tuple[Array | None, dict[str, Any]]:
    """Return corners with their numbers in a record, (m, 3): number, u, v; and what else the record has."""
    arrays = {key: array for key, one in entries.items() if (array := _numbers(_plain(one))) is not None}
    for key, ids in arrays.items():
        n = ids.size
        if not re.fullmatch(r"(.*_)?ids?", key.lower()) or n < 2 or (ids != ids.round()).any():
            continue
        for other, corners in arrays.items():
            if other != key and corners.shape in ((n, 2), (n, 1, 2)):
                rest = {name: one for name, one in entries.items() if name not in (key, other)}
                return np.column_stack([ids.ravel(), corners.reshape(n, 2)]), rest
    return None, entries


def _is_pose(array: Array) -> bool:
    if array.shape in ((4, 4), (3, 4), (16,), (12,), (7,), (6,), (1, 7), (1, 6), (7, 1), (6, 1)):
        return array.shape not in ((16,), (4, 4), (3, 4), (12,)) or bool(np.abs(array).max() > 0.0)
    return False


def _numbers(value: Any) -> Array | None:
    """Return nested lists of numbers as an array; None when they are something else."""
    if isinstance(value, np.ndarray):
        return value.astype(np.float64) if np.isfinite(value).all() else None  # pyright: ignore
    try:
        array = np.array(value)
        if array.dtype.kind in "US":  # numbers that YAML takes for text, such as 1e-3
            array = array.astype(np.float64)
    except (ValueError, TypeError, OverflowError, RecursionError):
        return None
    if array.dtype.kind not in "fiu" or array.size == 0 or not np.isfinite(array).all():
        return None
    return array.astype(np.float64)


def _storage_matrix(entries: Mapping[str, Any]) -> Array | None:
    """Return a matrix of OpenCV's FileStorage, or of camera_info: rows, cols and data."""
    if not {"rows", "cols", "data"} <= entries.keys():
        return None
    data = _numbers(entries["data"])
    rows, columns = number(entries["rows"]), number(entries["cols"])
    if data is None or rows is None or columns is None or rows * columns == 0 or data.size % (rows * columns):
        return None
    deep = int(data.size // (rows * columns))
    shape = (int(rows), int(columns)) if deep == 1 else (int(rows) * int(columns), deep)
    return data.reshape(shape)


def _of_parts(entries: Mapping[str, Any]) -> tuple[Array, str] | None:
    """Return a pose that is written as position and rotation, in one mapping."""
    lower = {key.lower().lstrip("_"): value for key, value in entries.items()}
    flat = _flat(lower)
    if flat is not None:
        return flat
    place = next((_three(lower[key]) for key in _PLACE if key in lower), None)
    turn = next((lower[key] for key in _TURN if key in lower), None)
    if place is None or turn is None:
        return None
    if isinstance(turn, dict):
        letters = {str(key).lower().lstrip("q"): value for key, value in turn.items()}  # pyright: ignore
        parts = [number(letters.get(letter)) for letter in _LETTERS]
        if None not in parts:
            return np.array([*place, *parts], dtype=np.float64), "xyzw"
        turn = [letters.get(letter) for letter in ("x", "y", "z")]
        if None in turn:
            turn = [letters.get(name) for name in ("roll", "pitch", "yaw")]
            three = _three(turn)
            return None if three is None else (np.concatenate([place, three]), "")
    array = _numbers(turn)
    if array is None:
        return None
    if array.size == 9:
        R = array.reshape(3, 3)
        return np.hstack([R, place[:, None]]).ravel(), "matrix"
    if array.size in (3, 4):
        vector = any(key in lower for key in ("rvec", "rotvec"))
        return np.concatenate([place, array.ravel()]), "rotvec" if vector and array.size == 3 else ""
    return None


def _flat(lower: Mapping[str, Any]) -> tuple[Array, str] | None:
    """Return a pose whose numbers stand next to each other: x y z, and qx qy qz qw, rx ry rz, or roll pitch yaw."""
    place = [number(lower.get(letter)) for letter in ("x", "y", "z")]
    if None in place:
        return None
    for names, form in ((("qx", "qy", "qz", "qw"), "xyzw"), (("rx", "ry", "rz"), ""), (("roll", "pitch", "yaw"), ""),
                        (("a", "b", "c"), "")):  # fmt: skip
        turn = [number(lower.get(name)) for name in names]
        if None not in turn:
            return np.array([*place, *turn], dtype=np.float64), form
    return None


def _three(value: Any) -> Array | None:
    if isinstance(value, dict):
        value = [value.get(letter) for letter in ("x", "y", "z")]  # pyright: ignore
    array = _numbers(value)
    return array.ravel() if array is not None and array.size == 3 else None


def _of_pairs(entries: Mapping[str, Any], keys: _Keys) -> Iterator[tuple[_Keys, Array, str]]:
    """Yield poses of lists of rotations and of translations whose names differ in their beginning only.

    Such as `R_gripper2base` and `t_gripper2base` of OpenCV's calibrateHandEye.
    """
    arrays = {key: array for key, one in entries.items() if (array := _numbers(_plain(one))) is not None}
    shifts = {stem: key for key in arrays if (stem := _without(key, _SHIFTS)) is not None}
    for key, turns in arrays.items():
        stem = _without(key, _TURNS)
        other = shifts.get(stem) if stem is not None else None
        if stem is None or other is None:
            continue
        places = arrays[other].reshape(-1, 3) if arrays[other].size % 3 == 0 else np.empty((0, 3))
        n, name = len(places), stem or "poses"
        if n == 0 or turns.size not in (3 * n, 9 * n):
            continue
        form = "matrix" if turns.size == 9 * n else "rotvec" if key.lower().startswith("rvec") else ""
        for k, (turn, place) in enumerate(zip(turns.reshape(n, -1), places, strict=True)):
            row = (
                np.hstack([turn.reshape(3, 3), place[:, None]]).ravel() if form == "matrix" else np.append(place, turn)
            )
            yield (*keys, name, k) if n > 1 else (*keys, name), row, form


def _without(name: str, words: tuple[str, ...]) -> str | None:
    """Return a name without the first of its parts that is among some words; None where none is."""
    parts = name.lower().split("_")
    k = next((k for k, part in enumerate(parts) if part in words), None)
    return None if k is None else "_".join((*parts[:k], *parts[k + 1 :]))


def _plain(value: Any) -> Any:
    """Return a list of FileStorage's matrices as nested lists."""
    if isinstance(value, dict):
        matrix = _storage_matrix({str(key): one for key, one in value.items()})  # pyright: ignore
        return value if matrix is None else matrix
    if isinstance(value, list) and value and all(isinstance(one, dict) for one in value):  # pyright: ignore
        return [_plain(one) for one in value]  # pyright: ignore
    return value
