# SPDX-License-Identifier: Apache-2.0
"""Clouds as plain numbers: arrays of numpy, and rows of text."""

from __future__ import annotations

import warnings
from pathlib import Path
from tokenize import TokenError
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from openarm_perception.frames.cloud_fields import MOST_POINTS, Cloud, cloud_of, refused

#: Most bytes of a file of text.
_MOST_TEXT = 1_000_000_000
_COLUMNS = "x, y, z, and red, green, blue of 0 to 255 where there are six"


def read_array(path: Path, expected: str) -> NDArray[Any]:
    """Map an array of numbers of two or three dimensions.

    Args:
        path: Path of a .npy file.
        expected: What it should have, for the error.

    Raises:
        OpenArmError: BAD_IMAGE, for another file.
    """
    try:
        array: Any = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError, TypeError, TokenError, OverflowError, MemoryError) as error:
        raise refused(path, "is no array of numbers, or is cut short", "a .npy file of numpy.save") from error
    shape = getattr(array, "shape", ())
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu" or len(shape) not in (2, 3):
        raise refused(path, f"has an array {shape}", expected)
    return cast("NDArray[Any]", array)


def read_npy(path: Path) -> Cloud:
    """Read a cloud: an array (n, k) or, organised, (h, w, k), of x, y, z and perhaps red, green, blue.

    Raises:
        OpenArmError: BAD_IMAGE, for another file.
    """
    return _cloud(read_array(path, f"numbers (n, 3), (n, 6), (h, w, 3) or (h, w, 6): {_COLUMNS}"), path)


def read_xyz(path: Path) -> Cloud:
    """Read a cloud of a text: a row for each point, x, y, z first, with spaces, commas or semicolons between.

    Rows that begin with no number are comments.

    Raises:
        OpenArmError: BAD_IMAGE, for another file.
    """
    try:
        if path.stat().st_size > _MOST_TEXT:
            raise refused(path, f"has {path.stat().st_size} bytes", f"at most {_MOST_TEXT}")
        with path.open("rb") as file:
            lines = (line for line in file if line.lstrip()[:1] in b"+-.0123456789" and line.strip())
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a file without a row
                array = np.loadtxt(
                    (line.replace(b",", b" ").replace(b";", b" ") for line in lines), max_rows=MOST_POINTS + 1, ndmin=2
                )
    except OSError as error:
        raise refused(path, f"can't be read: {error.strerror}", "a file") from error
    except (ValueError, OverflowError) as error:
        raise refused(path, "has a row that is none of numbers, or of another length", f"rows of {_COLUMNS}") from error
    return _cloud(array, path)


def _cloud(array: Any, path: Path) -> Cloud:
    width = array.shape[-1]
    height, columns = (1, array.shape[0]) if array.ndim == 2 else array.shape[:2]
    if width < 3 or not 1 <= height * columns <= MOST_POINTS:
        raise refused(path, f"has {height * columns} points of {width} numbers", f"1 to {MOST_POINTS} of {_COLUMNS}")
    flat = array.reshape(-1, width)
    names = ("x", "y", "z", *(("red", "green", "blue") if width == 6 else ()))
    return cloud_of({name: np.array(flat[:, i]) for i, name in enumerate(names)}, (height, columns))
