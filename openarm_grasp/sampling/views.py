# SPDX-License-Identifier: Apache-2.0
"""From labelled clouds to what each camera has seen of an object and around it. Base frame, m."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from openarm_common.labelled_cloud import LabelledCloud
from openarm_grasp.sampling.surface import View

#: What is lower above the table is table, m.
_TABLE = 0.006
#: Images from cameras nearer to each other are of one camera, m.
_SAME_CAMERA = 0.002
#: What belongs to no detection and is this near to the object is its border, m.
_FRINGE = 0.010


def views_of(clouds: Sequence[LabelledCloud], table_z: float) -> tuple[View, ...]:
    """Return what each camera has seen of an object and around it, its images put together.

    Args:
        clouds: Clouds of a `Sighting`; the first is of the camera over the table, which looks at all around the object.
        table_z: Height of the table top.
    """
    cameras: list[list[LabelledCloud]] = []
    for cloud in clouds:
        same = (group for group in cameras if np.linalg.norm(group[0].camera - cloud.camera) < _SAME_CAMERA)
        group = next(same, None)
        if group is None:
            cameras.append([cloud])
        else:
            group.append(cloud)
    return tuple(_view(group, table_z, whole=number == 0) for number, group in enumerate(cameras))


def _view(clouds: Sequence[LabelledCloud], table_z: float, *, whole: bool) -> View:
    points = np.concatenate([cloud.points for cloud in clouds]).astype(np.float64)
    labels = np.concatenate([cloud.labels for cloud in clouds])
    target, standing = points[labels == 1], points[:, 2] > table_z + _TABLE
    others = np.flatnonzero((labels != 1) & standing)
    fringe = np.zeros(len(others), np.bool_)
    loose = labels[others] == 0
    if len(target) and loose.any():
        away, _ = KDTree(target).query(points[others[loose]])
        fringe[loose] = away < _FRINGE
    return View(clouds[-1].camera, target, points[others[~fringe]], points[(labels != 1) & ~standing], whole)
