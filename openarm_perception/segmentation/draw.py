# SPDX-License-Identifier: Apache-2.0
"""Segmentations and depth as pictures, for people."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.types import Bytes, Floats

#: Turns of the colour wheel from one thing to the next: neighbours in number differ as much as they can.
_GOLDEN = 0.618034


def palette(count: int) -> Bytes:
    """Return colours (count + 1, 3) of things; that of number 0 is black."""
    hue = (np.arange(count) * _GOLDEN % 1.0 * 180.0).astype(np.uint8)
    hsv = np.stack([hue, np.full(count, 190), np.where(np.arange(count) % 2, 255, 215)], axis=-1).astype(np.uint8)
    out = np.zeros((count + 1, 3), np.uint8)
    if count:
        out[1:] = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]
    return out


def label_picture(label: NDArray[np.integer]) -> Bytes:
    """Return a label image (h, w) in colours (h, w, 3)."""
    names, index = np.unique(label, return_inverse=True)
    first = int(names[0] != 0)
    return palette(len(names) - 1 + first)[index.reshape(label.shape) + first]


def overlay(rgb: Bytes, label: NDArray[np.integer], numbers: bool = False) -> Bytes:
    """Return an image (h, w, 3) with the things of a label image (h, w) in colour, outlined.

    Args:
        rgb: (h, w, 3).
        label: (h, w), 0: none.
        numbers: Whether the number of each thing is written on it.
    """
    colored = label_picture(label)
    on = label != 0
    out = rgb.copy()
    out[on] = rgb[on] // 2 + colored[on] // 2
    edge = np.zeros(label.shape, np.bool_)
    edge[:, 1:] |= label[:, 1:] != label[:, :-1]
    edge[1:] |= label[1:] != label[:-1]
    out[edge] = 255
    for i in np.unique(label[on]) if numbers else ():
        distance = cv2.distanceTransform(np.pad(label == i, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
        v, u = np.unravel_index(int(distance.argmax()), label.shape)
        at = (int(u) - 5 * len(str(i)), int(v) + 5)
        for ink, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(out, str(i), at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, ink, width, cv2.LINE_AA)
    return out


def depth_picture(z: Floats) -> Bytes:
    """Return depth (h, w), m, in colours (h, w, 3), near is red; black where nothing was measured."""
    seen = np.isfinite(z)
    if not seen.any():
        return np.zeros((*z.shape, 3), np.uint8)
    near, far = np.percentile(z[seen], (1.0, 99.0))
    share = np.nan_to_num((far - z) / max(far - near, 1e-6)).clip(0.0, 1.0)
    out = cv2.cvtColor(cv2.applyColorMap((share * 255.0).astype(np.uint8), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    out[~seen] = 0
    return np.asarray(out, np.uint8)
