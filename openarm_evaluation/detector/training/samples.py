# SPDX-License-Identifier: Apache-2.0
"""Pictures and labels of a data set, as they are and as they are varied for training.

Boxes are left, top, right, bottom in pixels of which each covers one unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_evaluation.detector.yolo_text import read_classes, read_labels

Image = NDArray[np.uint8]
Rng = np.random.Generator

#: Grey level outside a picture.
FILL = 114
#: An object of which a crop leaves less than this share is not labelled.
_LEFT = 0.35
_SCALES = (0.45, 1.15)


@dataclass(frozen=True)
class Sample:
    """A picture (h, w, 3) uint8 with classes (n,) and boxes (n, 4)."""

    rgb: Image
    classes: NDArray[np.int64]
    boxes: Array


class Samples:
    """A set of a data set; pictures stay compressed in memory.

    Args:
        folder: Folder of the data set.
        name: Name of the set.

    Raises:
        OpenArmError: CONFIG_INVALID, when the set is missing or empty; INVALID_ARGUMENT, for a wrong label.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.names = read_classes(folder)
        paths = sorted(p for p in (folder / "images" / name).glob("*") if p.suffix in (".jpg", ".jpeg", ".png"))
        if not paths:
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"no pictures (.jpg, .jpeg, .png) in {folder / 'images' / name}; make some: openarm detector data",
            )
        self._files = [path.read_bytes() for path in paths]
        self._labels: list[tuple[NDArray[np.int64], Array]] = []
        self.paths = paths
        for path in paths:
            label = folder / "labels" / name / f"{path.stem}.txt"
            # a picture without a file is a picture without objects, as label tools leave it
            text = label.read_text(encoding="utf-8") if label.is_file() else ""
            self._labels.append(read_labels(text, 1, 1, len(self.names), str(label)))

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> Sample:
        classes, shares = self._labels[index]
        rgb = _decode(self._files[index], self.paths[index])
        height, width = rgb.shape[:2]
        return Sample(rgb, classes, shares * [width, height, width, height])


def vary(sample: Sample, rng: Rng, width: int, height: int) -> Sample:
    """A random crop of a sample at a random scale, mirrored, in other colours; (height, width, 3)."""
    scale = float(np.exp(rng.uniform(*np.log(_SCALES))))
    cut_w, cut_h = width / scale, height / scale
    h, w = sample.rgb.shape[:2]
    middle = np.array([w, h]) / 2.0 + rng.uniform(-0.1, 0.1, 2) * (w, h)
    if len(sample.boxes) and rng.random() < 0.85 and (cut_w < w or cut_h < h):
        box = sample.boxes[rng.integers(len(sample.boxes))]
        middle = (box[:2] + box[2:]) / 2.0 + rng.uniform(-0.4, 0.4, 2) * (cut_w, cut_h)
        # no further beyond the picture than needed
        middle = np.array([_within(middle[0], cut_w, w), _within(middle[1], cut_h, h)])
    left, top = middle[0] - cut_w / 2.0, middle[1] - cut_h / 2.0
    # a pixel covers one unit: its middle is at one half
    A = np.array([[scale, 0.0, (0.5 - left) * scale - 0.5], [0.0, scale, (0.5 - top) * scale - 0.5]])
    rgb = cv2.warpAffine(sample.rgb, A, (width, height), flags=cv2.INTER_LINEAR, borderValue=(FILL,) * 3)
    boxes = (sample.boxes - [left, top, left, top]) * scale
    inside = boxes.clip(0.0, [width, height, width, height])
    kept = _area(inside) > _LEFT * _area(boxes)
    classes, boxes = sample.classes[kept], inside[kept]
    if rng.random() < 0.5:
        rgb, boxes = rgb[:, ::-1], np.stack([width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], 1)
    if rng.random() < 0.2:
        rgb, boxes = rgb[::-1], np.stack([boxes[:, 0], height - boxes[:, 3], boxes[:, 2], height - boxes[:, 1]], 1)
    return Sample(_recolour(cast(Image, rgb), rng), classes, boxes)


def _recolour(rgb: Image, rng: Rng) -> Image:
    """Other colours: shape is what the network should learn, colour is the other detector's."""
    out = rgb.astype(np.float32) * rng.uniform(0.7, 1.3, 3).astype(np.float32) + np.float32(rng.uniform(-15.0, 15.0))
    draw = rng.random()
    if draw < 0.4:
        out = out[..., rng.permutation(3)]
    elif draw < 0.5:
        out = np.repeat(out.mean(axis=2, keepdims=True), 3, axis=2)
    return np.ascontiguousarray(np.clip(out, 0, 255).astype(np.uint8))


def _within(middle: float, cut: float, whole: float) -> float:
    return whole / 2.0 if cut >= whole else float(np.clip(middle, cut / 2.0, whole - cut / 2.0))


def _area(boxes: Array) -> Array:
    return (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])


def _decode(data: bytes, path: Path) -> Image:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise OpenArmError(Code.BAD_IMAGE, f"{path} is no picture that OpenCV reads; replace or remove it")
    return cast(Image, cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
