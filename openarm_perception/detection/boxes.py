# SPDX-License-Identifier: Apache-2.0
"""From an image to the input of a network and from its output back to boxes in the image.

Boxes are left, top, right, bottom in pixels of which each covers one unit: a box around the single pixel (u, v) is
u, v, u + 1, v + 1. Images keep their proportions: they are scaled to fit the input, the rest is filled; networks that
learnt from stretched images get those.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.types import Array

Image = NDArray[np.uint8]

_FILL = 114


@dataclass(frozen=True)
class Letterbox:
    """How an image lies in the input of a network; pixels.

    Attributes:
        width: Width of the input.
        height: Height of the input.
        left: Column at which the image begins.
        top: Row at which the image begins.
        inner: (width, height) that the image takes.
        scale: (x, y) input pixels per image pixel; they differ by the rounding of `inner`.
    """

    width: int
    height: int
    left: int
    top: int
    inner: tuple[int, int]
    scale: tuple[float, float]

    @classmethod
    def fit(cls, image: tuple[int, int], size: tuple[int, int], *, stretched: bool = False) -> Letterbox:
        """Fit an image (width, height) in an input (width, height), or stretch it to fill that."""
        scale = min(size[0] / image[0], size[1] / image[1])
        inner = size if stretched else (max(1, round(image[0] * scale)), max(1, round(image[1] * scale)))
        exact = (inner[0] / image[0], inner[1] / image[1])
        return cls(*size, (size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2, inner, exact)

    def place(self, rgb: Image) -> Image:
        """Return the input (height, width, 3) of an image (h, w, 3)."""
        if rgb.shape[1::-1] != self.inner:
            kind = cv2.INTER_AREA if self.scale[0] < 1.0 else cv2.INTER_LINEAR
            rgb = cast(Image, cv2.resize(rgb, self.inner, interpolation=kind))
        if self.inner == (self.width, self.height):
            return rgb
        out = np.full((self.height, self.width, 3), _FILL, np.uint8)
        out[self.top : self.top + self.inner[1], self.left : self.left + self.inner[0]] = rgb
        return out

    def back(self, boxes: Array) -> Array:
        """Return boxes (n, 4) of the input in the image, cut where the image ends."""
        size = self.inner[0] / self.scale[0], self.inner[1] / self.scale[1]
        out = (boxes - (self.left, self.top, self.left, self.top)) / (*self.scale, *self.scale)
        return out.clip(0.0, (*size, *size))


def blob(rgb: Image) -> NDArray[np.float32]:
    """Return what a network takes, (1, 3, h, w) 0 to 1, of an image (h, w, 3)."""
    out = np.empty((1, 3, *rgb.shape[:2]), np.float32)
    np.multiply(rgb.transpose(2, 0, 1), np.float32(1.0 / 255.0), out=out[0])
    return out


@dataclass(frozen=True)
class Candidates:
    """What a network found: classes (n,), scores (n,), 0 to 1, boxes (n, 4); best first."""

    classes: NDArray[np.int64]
    scores: Array
    boxes: Array


def suppress(found: Candidates, max_overlap: float, limit: int = 100) -> Candidates:
    """Return boxes without the weaker ones of the same object.

    Args:
        found: Best first.
        max_overlap: Overlap (intersection over union) from which on what is worse is dropped, of the same class; of
            another class, what overlaps halfway from there to 1.
        limit: Most boxes.
    """
    left = np.ones(len(found.scores), np.bool_)
    kept: list[int] = []
    for i in range(len(left)):
        if not left[i]:
            continue
        kept.append(i)
        if len(kept) == limit:
            break
        shared = overlap(found.boxes[i], found.boxes)
        left &= shared <= np.where(found.classes == found.classes[i], max_overlap, 0.5 + 0.5 * max_overlap)
    return Candidates(found.classes[kept], found.scores[kept], found.boxes[kept])


def overlap(box: Array, others: Array) -> Array:
    """Return the intersection over union (n,) of a box (4,) with others (n, 4)."""
    size = (np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])).clip(0.0)
    common = size[:, 0] * size[:, 1]
    total = np.prod(box[2:] - box[:2]) + np.prod(others[:, 2:] - others[:, :2], axis=1) - common
    return common / np.maximum(total, 1e-12)
