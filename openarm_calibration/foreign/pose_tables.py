# SPDX-License-Identifier: Apache-2.0
"""Poses in the lines of a table: by its header or names that are given, by labels, or by how many numbers there are."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from openarm_calibration.foreign.pose_documents import MOST, Column
from openarm_common.documents import Cells, is_missing, number
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.types import Array


def of_table(path: Path, cells: Cells, names: tuple[str, ...]) -> tuple[list[Column], tuple[str, ...]]:
    """Return the columns of a table, and names of images."""
    if not cells.rows:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} has no poses: expected a line of numbers for each")
    if len(cells.rows) > 2 * MOST:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} has {len(cells.rows)} lines, expected at most {MOST} poses")
    wide = len(cells.rows[0])
    for line, row in zip(cells.lines, cells.rows, strict=True):
        if len(row) != wide:
            raise OpenArmError(
                Code.CONFIG_INVALID, f"{path}:{line} has {len(row)} cells, expected {wide} as the first line has"
            )
    values = [[number(cell) for cell in row] for row in cells.rows]
    words = [k for k in range(wide) if all(row[k] is None for row in values)]
    if len(words) == wide:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} has no poses: expected a line of numbers for each")
    kept: list[int] = []
    for k, (line, row, value) in enumerate(zip(cells.lines, cells.rows, values, strict=True)):
        torn = [cell for j, cell in enumerate(row) if j not in words and value[j] is None]
        if wrong := [cell for cell in torn if not is_missing(cell)]:
            raise OpenArmError(Code.CONFIG_INVALID, f"{path}:{line}: {brief(wrong[0])} is no finite number")
        if not torn:  # where the board was not found there is nothing
            kept.append(k)
    if not kept:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} has no line whose numbers are all there")
    numbers = np.array([[values[k][j] for j in range(wide) if j not in words] for k in kept], dtype=np.float64)
    labels = tuple(f"line {cells.lines[k]}" for k in kept)
    header = names or cells.header
    if names and len(names) != wide:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"--columns names {len(names)} columns, {path} has {wide}; write - for one to leave out",
        )
    who = [tuple(cells.rows[k][j] for k in kept) for j in words]
    for label in who:
        kinds = sorted(set(label), key=label.index)
        if len(kinds) == 2 and all(label.count(kind) == len(label) // 2 for kind in kinds):
            return _by_label(header, numbers, label, labels, words), ()
    header = tuple(name for k, name in enumerate(header) if k not in words) if len(header) == wide else ()
    images = who[0] if who else ()
    keys, stamps = _told_by(header, numbers)
    columns = _split(path, header, numbers, labels)
    return [replace(one, keys=images or keys, stamps=stamps) for one in columns], images


def _told_by(header: tuple[str, ...], numbers: Array) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Return what tells which lines of two tables belong together: numbers of records, or times."""
    keys: tuple[str, ...] = ()
    stamps: tuple[float, ...] = ()
    for name, values in zip(header, numbers.T, strict=False):
        word = re.sub(r"[^a-z]", "", name.lower())
        if word in ("id", "index", "idx", "frame", "frameid", "record", "sample", "pose", "image", "no", "number"):
            keys = tuple(f"{value:g}" for value in values)
        elif word in ("timestamp", "time", "stamp", "t", "sec", "ts", "timestampns", "timens"):
            stamps = tuple(values.tolist())
    if not header and numbers.shape[1] in (8, 15) and (np.diff(numbers[:, 0]) > 0.0).all():
        stamps = tuple(numbers[:, 0].tolist())
    return keys, stamps


def _by_label(
    header: tuple[str, ...], numbers: Array, who: tuple[str, ...], labels: tuple[str, ...], words: list[int]
) -> list[Column]:
    """Return the columns of a table whose lines say whose pose they are, such as hand and eye."""
    out: list[Column] = []
    header = tuple(name for k, name in enumerate(header) if k not in words)
    for kind in sorted(set(who), key=who.index):
        mine = [k for k, one in enumerate(who) if one == kind]
        named = _by_header(header, numbers[mine], tuple(labels[k] for k in mine))
        column = named[0] if named else Column(kind, _without_time(numbers[mine]), tuple(labels[k] for k in mine))
        out.append(Column(kind, column.rows, column.labels, column.rotation, column.unit))
    return out


def _split(path: Path, header: tuple[str, ...], numbers: Array, labels: tuple[str, ...]) -> list[Column]:
    """Return the poses in the lines of a table: by its header, or by how many numbers there are."""
    named = _by_header(header, numbers, labels)
    if named:
        return named
    numbers = _without_time(numbers)
    wide = numbers.shape[1]
    if wide in (6, 7, 16) or (wide == 12 and _rigid(numbers)):
        return [Column(path.stem, numbers, labels)]
    if wide in (12, 14, 24, 32):
        return [Column(name, numbers[:, part], labels)
                for name, part in (("robot", slice(0, wide // 2)), ("board", slice(wide // 2, wide)))]  # fmt: skip
    raise OpenArmError(
        Code.CONFIG_INVALID,
        f"{path} has {wide} numbers a pose; expected 6 (angles or a rotation vector), 7 (a quaternion), 12 or 16 (a"
        " matrix), twice as many for pairs, or names of columns: --columns 'x y z qx qy qz qw', with robot_ and"
        " board_ before the names of pairs, - for what is to be left out",
    )


def _without_time(numbers: Array) -> Array:
    """Return numbers without a first column of times (TUM's eight columns)."""
    if numbers.shape[1] in (8, 15) and (np.diff(numbers[:, 0]) > 0.0).all():
        return numbers[:, 1:]
    return numbers


def _rigid(numbers: Array) -> bool:
    R = numbers.reshape(-1, 3, 4)[:, :, :3]
    return bool(np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 0.02)


#: Names of numbers in a header, in the order in which a pose has them.
_FORMS = (
    (("x", "y", "z", "qx", "qy", "qz", "qw"), "xyzw"), (("x", "y", "z", "rx", "ry", "rz"), ""),
    (("x", "y", "z", "roll", "pitch", "yaw"), "rpy"), (("x", "y", "z", "a", "b", "c"), ""),
    (tuple(f"m{i}{j}" for i in range(4) for j in range(4)), "matrix"),
    (tuple(f"m{i}{j}" for i in range(3) for j in range(4)), "matrix"),
)  # fmt: skip


def _by_header(header: tuple[str, ...], numbers: Array, labels: tuple[str, ...]) -> list[Column]:
    """Return the columns of poses whose numbers the header names, such as hand_x, ..., hand_qw."""
    if len(header) != numbers.shape[1]:
        return []
    groups: dict[str, dict[str, tuple[int, str]]] = {}
    for k, name in enumerate(header):
        prefix, part, unit = _parsed(name)
        if part:
            groups.setdefault(prefix, {}).setdefault(part, (k, unit))
    out: list[Column] = []
    for prefix, parts in groups.items():
        for wanted, form in _FORMS:
            if set(wanted) <= parts.keys():
                units = {parts[name][1] for name in wanted}
                unit = next((one for one in ("mm", "cm", "m") if one in units), "")
                turned = next((one for one in ("deg", "rad") if one in units), "")
                # of angles the unit is found where it is not said
                rotation = {"": "", "deg": "rpy_deg", "rad": "rpy"}[turned] if form == "rpy" else form
                out.append(
                    Column(prefix or "poses", numbers[:, [parts[name][0] for name in wanted]], labels, rotation, unit)
                )
                break
    return out


#: Name of a number: whose, and x, qx, rx, roll or m00.
_NAME = re.compile(
    r"(?:(.*?)_)?(?:t|p|pos|position|trans|translation)?_?(x|y|z)"
    r"|(?:(.*?)_)?(?:q|quat|quaternion|orientation)_?(x|y|z|w)"
    r"|(?:(.*?)_)?(?:r|rot|rotvec|rvec|rotation)_?(x|y|z)"
    r"|(?:(.*?)_)?(roll|pitch|yaw|a|b|c)"
    r"|(?:(.*?)_)?(?:m|r|t)_?(\d)_?(\d)"
)


def _parsed(name: str) -> tuple[str, str, str]:
    """Return whose number a name of a column is, which, and its unit."""
    text = name.lower().strip().strip("'\"")
    unit = ""
    if found := re.search(r"[\s_\[(]*\b(mm|cm|m|deg|degrees|rad|°)[\])]?$|_(mm|cm|m|deg|rad)$", text):
        unit, text = (found[1] or found[2]).replace("degrees", "deg").replace("°", "deg"), text[: found.start()]
    text = re.sub(r"[^a-z0-9]+", "_", text).strip("_")
    parts = _NAME.fullmatch(text)
    if parts is None:
        return "", "", unit
    for group, before in ((2, ""), (4, "q"), (6, "r"), (8, "")):
        if parts[group]:
            return parts[group - 1] or "", before + parts[group], unit
    return parts[9] or "", f"m{parts[10]}{parts[11]}", unit
