# SPDX-License-Identifier: Apache-2.0
"""Whatever stands on the table, as detections: clusters of depth, without classes."""

from __future__ import annotations

import cv2
import numpy as np

from openarm_common.types import Mask
from openarm_perception.detection.detector import Detection2D
from openarm_perception.detection.localize import Localizer
from openarm_perception.geometry.depth import Deprojector, View
from openarm_perception.segmentation.divide import SegmentationConfig, divide
from openarm_perception.segmentation.support import support_at

#: Name of what is found without knowing what it is.
ANYTHING = "anything"
#: Nothing on the table is taller than this, m.
_TALLEST = 0.30


def clusters(view: View, localizer: Localizer) -> tuple[Detection2D, ...]:
    """Return everything above the table that is not the robot, largest first; the score is the share of its hull.

    Args:
        view: The frame.
        localizer: Has the height of the table.
    """
    points = Deprojector(localizer.limits).organised(view.depth, view.intrinsics)
    support = support_at(points, view.T_base_camera, localizer.table_height)
    with np.errstate(invalid="ignore"):
        apart = support.heights(points) > _TALLEST
    if view.robot is not None:
        apart |= view.robot
    config = SegmentationConfig(least_height=localizer.config.table_margin)
    label = divide(points, view.intrinsics, support, config, apart, view.rgb).label
    found = [_detection(label == i) for i in range(1, int(label.max()) + 1)]
    return tuple(sorted(found, key=lambda one: -one.area))


def _detection(on: Mask) -> Detection2D:
    """Return the detection of pixels (h, w) of an image; holes in them, without a depth, belong to it."""
    height, width = on.shape
    u, v, w, h = cv2.boundingRect(on.astype(np.uint8))
    part = on[v : v + h, u : u + w].astype(np.uint8)
    contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    mask = np.zeros_like(part)
    cv2.drawContours(mask, [max(contours, key=len)], -1, 1, cv2.FILLED)
    # what is a part of it in the image, but not in one piece, is cut off by something in front of it
    mask |= part
    hull = cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32))
    full = min(1.0, float(np.count_nonzero(mask)) / max(float(cv2.contourArea(hull)), 1.0))
    cut = u == 0 or v == 0 or u + w == width or v + h == height
    centre = (u + (w - 1) / 2.0, v + (h - 1) / 2.0)
    return Detection2D(ANYTHING, full, centre, (w, h), mask > 0, cut)
