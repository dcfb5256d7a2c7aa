# SPDX-License-Identifier: Apache-2.0
"""Detections drawn into the image, for people."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_perception.pipeline import Perceived

Image = NDArray[np.uint8]
_LINE = (255, 255, 255)
_SHADOW = (20, 20, 20)


def annotate(rgb: Image, perceived: Perceived) -> Image:
    """A copy of an image (h, w, 3) with contour, label, score and, where known, position and size of each object."""
    picture = rgb.copy()
    located = {id(place.source): place for place in perceived.located}
    for found in perceived.found:
        u, v = found.origin
        width, height = found.size
        contours, _ = cv2.findContours(found.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        cv2.drawContours(picture, contours, -1, _LINE, 1, offset=(u, v))
        cv2.rectangle(picture, (u - 3, v - 3), (u + width + 2, v + height + 2), _SHADOW, 1)
        lines = [f"{found.label} {found.score:.2f}"]
        if place := located.get(id(found)):
            x, y, _ = place.position
            a, b, c = (edge * 1e3 for edge in place.size)
            lines.append(f"x {x:.3f} y {y:+.3f} m, {math.degrees(place.yaw):+.0f} deg")
            lines.append(f"{a:.0f} x {b:.0f} x {c:.0f} mm")
        else:
            lines.append("not located")
        for i, line in enumerate(reversed(lines)):
            _text(picture, line, (u - 3, v - 8 - 13 * i))
    return picture


def _text(picture: Image, text: str, at: tuple[int, int]) -> None:
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.38, 1)
    u = min(max(at[0], 2), picture.shape[1] - width - 2)
    v = max(at[1], height + 2)
    cv2.putText(picture, text, (u, v), cv2.FONT_HERSHEY_SIMPLEX, 0.38, _SHADOW, 3, cv2.LINE_AA)
    cv2.putText(picture, text, (u, v), cv2.FONT_HERSHEY_SIMPLEX, 0.38, _LINE, 1, cv2.LINE_AA)
