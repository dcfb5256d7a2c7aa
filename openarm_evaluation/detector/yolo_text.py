# SPDX-License-Identifier: Apache-2.0
"""Labels of pictures in the YOLO text format, which CVAT, LabelImg and most trainers read and write.

A line is `class cx cy width height`; lengths are shares of the picture's width and height, 0 to 1. Boxes here are left,
top, right, bottom in pixels of which each covers one unit: the whole of a picture is 0, 0, width, height.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openarm_common.config import load_yaml
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array


def write_labels(classes: NDArray[np.int64], boxes: Array, width: int, height: int) -> str:
    """The text of a picture: classes (n,), boxes (n, 4) in pixels; empty for a picture without objects."""
    low, high = boxes[:, :2], boxes[:, 2:]
    shares = np.hstack([(low + high) / 2, high - low]) / (width, height, width, height)
    rows = zip(classes, shares, strict=True)
    return "".join(f"{kind} {cx:.6f} {cy:.6f} {w:.6f} {h:.6f}\n" for kind, (cx, cy, w, h) in rows)


def read_labels(text: str, width: int, height: int, classes: int, where: str) -> tuple[NDArray[np.int64], Array]:
    """Classes (n,) and boxes (n, 4), pixels, of the text of a picture.

    Args:
        text: Lines of `class cx cy width height`.
        width: Width of the picture, pixels.
        height: Height of the picture, pixels.
        classes: Number of classes.
        where: Prefix of every fault, such as the path of the file.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming line and value that are wrong.
    """
    kinds: list[int] = []
    boxes: list[tuple[float, float, float, float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        place = f"{where}:{number}"
        try:
            kind, cx, cy, w, h = map(float, line.split())
        except ValueError as error:
            text = f"{place}: {line!r}; expected `class cx cy width height`"
            raise OpenArmError(Code.INVALID_ARGUMENT, text) from error
        if kind != int(kind) or not 0 <= kind < classes:
            text = f"{place}: class {kind:g}; expected a whole number 0 .. {classes - 1}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        # half of the last of six digits may be missing on either side
        inside = cx - w / 2 >= -1e-5 and cx + w / 2 <= 1 + 1e-5 and cy - h / 2 >= -1e-5 and cy + h / 2 <= 1 + 1e-5
        if not (inside and w > 0.0 and h > 0.0):
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{place}: box {cx:g} {cy:g} {w:g} {h:g} is empty or leaves the picture; expected shares of"
                " the width and height, 0 .. 1, not pixels",
            )
        kinds.append(int(kind))
        boxes.append(((cx - w / 2) * width, (cy - h / 2) * height, (cx + w / 2) * width, (cy + h / 2) * height))
    return np.array(kinds, np.int64), np.array(boxes, np.float64).reshape(-1, 4)


def write_classes(folder: Path, names: Sequence[str], sets: Sequence[str]) -> None:
    """Name the classes of a data set: `classes.txt` for label tools, `dataset.yaml` for trainers."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "classes.txt").write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    lines = [f"{name}: images/{name}" for name in sets] + ["names:"] + [f"  {i}: {n}" for i, n in enumerate(names)]
    (folder / "dataset.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_classes(folder: Path) -> tuple[str, ...]:
    """Names of the classes of a data set, from `dataset.yaml` (a list, or a mapping from 0 on).

    Raises:
        OpenArmError: CONFIG_INVALID, when the file is missing or names no classes.
    """
    path = folder / "dataset.yaml"
    names: Any = load_yaml(path).get("names")
    if isinstance(names, dict):
        names = [names.get(i) for i in range(len(names))]
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names):
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{path}:names: {names!r}; expected a list of names, or a mapping 0: name, 1: name, …"
        )
    return tuple(names)
