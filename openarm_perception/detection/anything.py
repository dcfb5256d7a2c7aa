# SPDX-License-Identifier: Apache-2.0
"""Whatever stands on the table, as detections: clusters of depth, without classes."""

from __future__ import annotations

import cv2
import numpy as np

from openarm_common.detection import ANYTHING
from openarm_perception.detection.detector import Detection2D
from openarm_perception.detection.localize import Localizer
from openarm_perception.geometry.depth import Deprojector, View
from openarm_perception.segmentation.clusters import Cluster, segment
from openarm_perception.segmentation.divide import SegmentationConfig
from openarm_perception.segmentation.support import support_at

#: Nothing is taller than this over what it stands on, m.
_TALLEST = 0.30
#: What is found: things that a hand may take whole, flat ones too.
_CONFIG = SegmentationConfig(least_height=0.005, faint=0.5, join_parts=True)


def clusters(view: View, localizer: Localizer) -> tuple[Detection2D, ...]:
    """Return everything above the table that is not the robot, largest first; the score is the share of its hull.

    Args:
        view: The frame.
        localizer: Has the height of the table.
    """
    points = Deprojector(localizer.limits).organised(view.depth, view.intrinsics)
    support = support_at(points, view.T_base_camera, localizer.table_height)
    over = 0.0 if view.levels is None else view.levels.height[view.levels.under]
    with np.errstate(invalid="ignore"):
        apart = support.heights(points) - over > _TALLEST
    if view.robot is not None:
        apart |= view.robot
    found = segment(
        points, view.intrinsics, _CONFIG, rgb=view.rgb, T_base_camera=view.T_base_camera, robot=apart, support=support,
        levels=view.levels,
    )  # fmt: skip
    return tuple(sorted((_detection(one) for one in found.clusters), key=lambda one: -one.area))


def _detection(cluster: Cluster) -> Detection2D:
    """Return the detection of a cluster; through a hole in it the table is seen, or the floor."""
    u, v, w, h = cv2.boundingRect(cluster.mask.astype(np.uint8))
    mask = cluster.mask[v : v + h, u : u + w]
    hull = cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32))
    full = min(1.0, float(np.count_nonzero(mask)) / max(float(cv2.contourArea(hull)), 1.0))
    rows, columns = cluster.window
    centre = (columns.start + u + (w - 1) / 2.0, rows.start + v + (h - 1) / 2.0)
    return Detection2D(ANYTHING, full, centre, (w, h), mask, cluster.outline.border > 0.0, cluster=cluster)
