# SPDX-License-Identifier: Apache-2.0
"""Data sets for a detector, in the YOLO text format: three sets that share no picture, the same for the same seed.

A set is `images/SET/NUMBER.jpg` and `labels/SET/NUMBER.txt` with a line `class cx cy width height` per object, all but
the class in shares of the picture's width and height; `classes.txt` and `dataset.yaml` name the classes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from cv2.typing import MatLike
from pydantic import Field

from openarm_bringup.view.wire import jpeg
from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import write_whole
from openarm_common.scene.scene import SHAPES
from openarm_evaluation.detector.scene import RandomViews
from openarm_evaluation.detector.yolo_text import read_labels, write_classes, write_labels

_QUALITY = 95
_VERSION = 1


class DataConfig(Config):
    """How many pictures, and their seed."""

    train: int = Field(default=4000, ge=0, le=1_000_000, description="pictures for training")
    select: int = Field(default=400, ge=0, le=1_000_000, description="pictures that choose the best weights")
    report: int = Field(default=600, ge=0, le=1_000_000, description="pictures that are used once, for the report")
    seed: int = Field(default=0, ge=0, description="of all three")

    def counts(self) -> dict[str, int]:
        """Pictures by set."""
        return {"train": self.train, "select": self.select, "report": self.report}


def make_data(folder: Path, config: DataConfig, progress: Callable[[str, int], None] | None = None) -> dict[str, int]:
    """Render the sets into a folder; pictures that are there already are kept, so that it goes on where it stopped.

    Args:
        folder: Folder of the data set.
        config: Number of pictures, and the seed.
        progress: Called after each picture with its set and number.

    Returns:
        How many pictures were rendered now, by set.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the folder holds a set of another seed; ENVIRONMENT, without OpenGL.
    """
    _claim(folder, config.seed)
    write_classes(folder, SHAPES, tuple(config.counts()))
    views: RandomViews | None = None
    made = dict.fromkeys(config.counts(), 0)
    try:
        for index, (name, count) in enumerate(config.counts().items()):
            images, labels = folder / "images" / name, folder / "labels" / name
            for number in range(count):
                image, label = images / f"{number:06}.jpg", labels / f"{number:06}.txt"
                if not (image.is_file() and label.is_file()):
                    # a picture of a run that was stopped must not count as done: files are written whole
                    views = views or RandomViews()
                    # the set is part of the seed: no picture of one set can be one of another
                    picture = views.draw(np.random.default_rng([config.seed, index, number]))
                    write_whole(image, jpeg(picture.rgb, _QUALITY))
                    height, width = picture.rgb.shape[:2]
                    write_whole(label, write_labels(picture.classes, picture.boxes, width, height).encode())
                    made[name] += 1
                if progress is not None:
                    progress(name, number)
    finally:
        if views is not None:
            views.close()
    _summarise(folder, config)
    return made


def write_sheet(folder: Path, name: str, columns: int = 6, rows: int = 5) -> Path:
    """A picture of the first pictures of a set with their boxes, `SET_preview.jpg`; returns it."""
    colors = ((40, 40, 230), (60, 200, 60), (230, 130, 40), (30, 200, 240))
    tiles: list[MatLike] = []
    for path in sorted((folder / "images" / name).glob("*.jpg"))[: columns * rows]:
        image = cast(MatLike, cv2.imread(str(path)))
        height, width = image.shape[:2]
        text = (folder / "labels" / name / f"{path.stem}.txt").read_text(encoding="utf-8")
        kinds, boxes = read_labels(text, width, height, len(SHAPES), path.name)
        for kind, (left, top, right, bottom) in zip(kinds, boxes.round().astype(int).tolist(), strict=True):
            cv2.rectangle(image, (left, top), (right, bottom), colors[kind % len(colors)], 2)
        tiles.append(cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA))
    tiles += [np.zeros((240, 320, 3), np.uint8)] * (-len(tiles) % columns)
    sheet = folder / f"{name}_preview.jpg"
    lines = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    cv2.imwrite(str(sheet), np.vstack(lines), [cv2.IMWRITE_JPEG_QUALITY, 90])
    return sheet


def digest(folder: Path, name: str) -> str:
    """SHA-256 over all labels of a set, in order: what it must be for the same pictures."""
    total = hashlib.sha256()
    for path in sorted((folder / "labels" / name).glob("*.txt")):
        total.update(path.name.encode() + b"\n" + path.read_bytes())
    return total.hexdigest()


def _claim(folder: Path, seed: int) -> None:
    path = folder / "seed.json"
    mine = {"seed": seed, "version": _VERSION}
    if path.is_file():
        there = json.loads(path.read_text(encoding="utf-8"))
        if there != mine:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{folder} holds pictures of seed {there.get('seed')} (format {there.get('version')}), requested is"
                f" seed {seed} (format {_VERSION}); take another folder, or remove that one",
            )
    else:
        write_whole(path, json.dumps(mine).encode())


def _summarise(folder: Path, config: DataConfig) -> None:
    sets: dict[str, Mapping[str, object]] = {}
    for name in config.counts():
        lines = [path.read_text().split("\n") for path in sorted((folder / "labels" / name).glob("*.txt"))]
        kinds = [int(line.split()[0]) for page in lines for line in page if line]
        sets[name] = {
            "pictures": len(lines),
            "empty": sum(not any(page) for page in lines),
            "objects": {SHAPES[k]: kinds.count(k) for k in range(len(SHAPES))},
            "labels_sha256": digest(folder, name),
        }
    write_whole(folder / "summary.json", json.dumps({"seed": config.seed, "sets": sets}, indent=1).encode())
