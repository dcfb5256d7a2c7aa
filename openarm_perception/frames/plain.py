# SPDX-License-Identifier: Apache-2.0
"""Clouds as plain numbers: arrays of numpy, and rows of text."""

from __future__ import annotations

import re
import warnings
from itertools import chain
from pathlib import Path
from tokenize import TokenError
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from openarm_perception.frames.cloud_fields import MOST_POINTS, Cloud, cloud_of, refused

#: Most bytes of a file of text.
_MOST_TEXT = 1_000_000_000
_COLUMNS = "x, y, z, and red, green, blue of 0 to 255 last where there are six or nine"
#: An array (n, k) of so many columns has points in its columns, or is an image.
_MANY_COLUMNS = 16
#: Three numbers with decimal commas.
_DECIMAL = re.compile(rb"\s*(?:[-+]?\d+,\d+(?:[eE][-+]?\d+)?[\s;]+){2}[-+]?\d+,\d")


def read_array(path: Path) -> Any:
    """Map what a .npy file has.

    Raises:
        OpenArmError: BAD_IMAGE, for another file.
    """
    try:
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError, TypeError, TokenError, OverflowError, MemoryError) as error:
        raise refused(path, "is no array of numbers, or is cut short", "a .npy file of numpy.save") from error


def numbers(array: Any, path: Path, expected: str) -> NDArray[Any]:
    """Return an array of numbers of two or three dimensions as such.

    Args:
        array: Array of the file.
        path: Path of the file, for the error.
        expected: Expected content, for the error.

    Raises:
        OpenArmError: BAD_IMAGE, when it is none.
    """
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu" or array.ndim not in (2, 3):
        raise refused(path, f"has an array {getattr(array, 'shape', ())}", expected)
    return cast("NDArray[Any]", array)


def is_image(array: Any) -> bool:
    """Whether an array is an image (h, w), and no cloud (n, k)."""
    return getattr(array, "ndim", 0) == 2 and array.shape[1] >= _MANY_COLUMNS


def read_npy(path: Path) -> Cloud:
    """Read a cloud: an array (n, k) or, organised, (h, w, k), of x, y, z and perhaps more, or of records with names.

    Raises:
        OpenArmError: BAD_IMAGE, for another file.
    """
    array = read_array(path)
    shape = getattr(array, "shape", ())
    named = getattr(array, "dtype", np.dtype(float)).fields or {}
    if {"x", "y", "z"} <= set(named) and len(shape) in (1, 2) and 0 < array.size <= MOST_POINTS:
        columns = {name: np.array(array[name]).ravel() for name, (kind, *_) in named.items() if kind.kind in "fiu"}
        return cloud_of(columns, (array.shape[0] if len(shape) == 2 else 1, array.shape[-1]))
    return _cloud(numbers(array, path, f"numbers (n, 3), (n, 6), (h, w, 3) or (h, w, 6): {_COLUMNS}"), path)


def read_xyz(path: Path) -> Cloud:
    """Read a cloud of a text: a row for each point, x, y, z first, with spaces, commas or semicolons between.

    Rows that begin with no number are comments, and a first one of a single number says how many there are. Commas are
    those of decimals where the first row has three such numbers.

    Raises:
        OpenArmError: BAD_IMAGE, for another file.
    """
    try:
        if path.stat().st_size > _MOST_TEXT:
            raise refused(path, f"has {path.stat().st_size} bytes", f"at most {_MOST_TEXT}")
        with path.open("rb") as file:
            lines = (line for line in file if line.lstrip()[:1] in b"+-.0123456789" and line.strip())
            first = next(lines, b"")
            first = next(lines, b"") if len(first.split()) == 1 and b"," not in first else first
            comma = b"." if _DECIMAL.match(first) else b" "
            rows = (line.replace(b",", comma).replace(b";", b" ") for line in chain([first], lines))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a file without a row
                array = np.loadtxt(rows, max_rows=MOST_POINTS + 1, ndmin=2)
    except OSError as error:
        raise refused(path, f"can't be read: {error.strerror}", "a file") from error
    except (ValueError, OverflowError) as error:
        raise refused(path, "has a row that is none of numbers, or of another length", f"rows of {_COLUMNS}") from error
    return _cloud(array, path)


def _cloud(array: Any, path: Path) -> Cloud:
    width = array.shape[-1]
    height, columns = (1, array.shape[0]) if array.ndim == 2 else array.shape[:2]
    if not 3 <= width < _MANY_COLUMNS or not 1 <= height * columns <= MOST_POINTS:
        way = (
            ""
            if width < 3
            else "; transpose an array (3, n) or (3, h, w); a depth image needs --info, and a colour one"
        )
        raise refused(
            path, f"has {height * columns} points of {width} numbers", f"1 to {MOST_POINTS} of {_COLUMNS}{way}"
        )
    flat = array.reshape(-1, width)
    fields = {name: np.array(flat[:, i]) for i, name in enumerate("xyz")}
    if width in (6, 9) and not (flat[:, -3:] < 0.0).any():  # normals have negative values
        fields |= {name: np.array(flat[:, i]) for i, name in ((-3, "red"), (-2, "green"), (-1, "blue"))}
    return cloud_of(fields, (height, columns))
