# SPDX-License-Identifier: Apache-2.0
"""Detections drawn into the image, for people."""

from __future__ import annotations

import math

import cv2
import numpy as np

from openarm_perception.detection.detector import Detection2D, Image
from openarm_perception.detection.localize import LocatedObject
from openarm_perception.detection.pipeline import Perceived

Box = tuple[int, int, int, int]  # left, top, right, bottom; pixels

_LOCATED = (0, 120, 140)
_REFUSED = (190, 40, 40)
_INK = (255, 255, 255)
_FONT, _SCALE, _LINE_HEIGHT = cv2.FONT_HERSHEY_SIMPLEX, 0.36, 13


def annotate(rgb: Image, perceived: Perceived) -> Image:
    """A copy of an image (h, w, 3) with outline, label, score and, where known, position and size of each object."""
    picture = rgb.copy()
    located = {id(place.source): place for place in perceived.located}
    for found in perceived.found:
        contours, _ = cv2.findContours(found.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        cv2.drawContours(picture, contours, -1, _INK, 1, offset=found.origin)
        cv2.rectangle(picture, _box(found)[:2], _box(found)[2:], _color(id(found) in located), 1)
    taken = [_box(found) for found in perceived.found]
    for found in perceived.found:
        place = located.get(id(found))
        taken.append(_tag(picture, _lines(found, place), _box(found), taken, _color(place is not None)))
    return picture


def _box(found: Detection2D) -> Box:
    (u, v), (width, height) = found.origin, found.size
    return u - 3, v - 3, u + width + 2, v + height + 2


def _color(located: bool) -> tuple[int, int, int]:
    return _LOCATED if located else _REFUSED


def _lines(found: Detection2D, place: LocatedObject | None) -> list[str]:
    title = f"{found.label} {found.score:.2f}"
    if place is None:
        return [title, "not located"]
    x, y, _ = place.p_base
    a, b, c = (edge * 1e3 for edge in place.size)
    turned = "" if place.method == "circle" else f" {math.degrees(place.yaw):+.0f} deg"
    return [title, f"x {x:.3f} y {y:+.3f} m{turned}", f"{a:.0f} x {b:.0f} x {c:.0f} mm"]


def _tag(picture: Image, lines: list[str], box: Box, taken: list[Box], color: tuple[int, int, int]) -> Box:
    """Write lines next to a box, where they cover least of the objects and the other tags; return what they cover."""
    width = max(cv2.getTextSize(line, _FONT, _SCALE, 1)[0][0] for line in lines) + 6
    height = _LINE_HEIGHT * len(lines) + 4
    corners = [(box[0], box[1] - height - 1), (box[0], box[3] + 2), (box[2] + 2, box[1]), (box[0] - width - 2, box[1])]
    corners += [(box[2] - width, box[1] - height - 1), (box[2] - width, box[3] + 2)]
    spots: list[Box] = []
    for corner in corners:
        left = min(max(corner[0], 0), max(picture.shape[1] - width - 1, 0))
        top = min(max(corner[1], 0), max(picture.shape[0] - height - 1, 0))
        spots.append((left, top, left + width, top + height))
    spot = min(spots, key=lambda s: sum(_overlap(s, other) for other in taken))
    cv2.rectangle(picture, spot[:2], spot[2:], color, cv2.FILLED)
    for i, line in enumerate(lines):
        at = (spot[0] + 3, spot[1] + _LINE_HEIGHT * (i + 1) - 1)
        cv2.putText(picture, line, at, _FONT, _SCALE, _INK, 1, cv2.LINE_AA)
    return spot


def _overlap(a: Box, b: Box) -> int:
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    return max(width, 0) * max(height, 0)
