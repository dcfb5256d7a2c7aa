# SPDX-License-Identifier: Apache-2.0
"""Points for frames that have none: what a camera would see of their boxes, and of the table around. Base frame, m.

Detectors without depth, and those of others, say where boxes are and no more. Behind the door that a frame comes
through, everything is judged by points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.detection import Detection
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.types import Array, Mask
from openarm_grasp.perception.detections import Frame

#: Of the table every so manieth row and column is enough, as in the clouds of the detector.
_STEP = 2
#: Corners of a box of edge 1.
_CORNERS = np.indices((2, 2, 2)).reshape(3, -1).T - 0.5


def with_points(
    frame: Frame, lens: Intrinsics, T_base_camera: Array, table_z: float, robot: Mask | None = None
) -> Frame:
    """Return a frame of boxes alone with the points that its camera would see of them; arguments as `points_of`.

    What nothing else is known of has the shape of its box.
    """
    found = tuple(replace(d, kind=d.kind or "box") for d in frame.detections)
    return replace(frame, detections=found, cloud=points_of(found, lens, T_base_camera, table_z, robot))


def points_of(
    boxes: Sequence[Detection], lens: Intrinsics, T_base_camera: Array, table_z: float, robot: Mask | None = None
) -> LabelledCloud:
    """Return the points that a camera would see of boxes, labelled by their number from 1, and of the table.

    What is round is an upright cylinder. Of what was seen in part, and what is behind it, there are none.

    Args:
        boxes: All that stands there.
        lens: Intrinsics of the camera.
        T_base_camera: (4, 4) optical frame.
        table_z: Height of the table top.
        robot: (h, w) pixels in which the robot may hide the table; None: none.
    """
    x, y = np.meshgrid(*lens.rays)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ T_base_camera[:3, :3].T
    camera, labels = T_base_camera[:3, 3], np.zeros(x.shape, np.uint32)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (table_z - camera[2]) / rays[..., 2]
        depth[~(depth > 0.0)] = np.inf
        for number, box in enumerate(boxes, start=1):
            T_camera_box = se3.inverse(T_base_camera) @ box.T_base_object
            where = _window(lens, se3.apply(T_camera_box, _CORNERS * box.size))
            to_unit = box.T_base_object[:3, :3] / (0.5 * box.size)  # a cube, or a cylinder, between -1 and 1
            start, along = (camera - box.p_base) @ to_unit, rays[where] @ to_unit
            ends = (np.array([-1.0, 1.0])[:, None, None, None] - start) / along
            if box.round:
                ends[..., 0] = ends[..., 1] = _through_circle(start[:2], along[..., :2])
            enter, leave = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
            hit = (enter > 0.0) & (enter <= leave) & (enter < depth[where])
            depth[where][hit], labels[where][hit] = enter[hit], number
    kept = (labels == 0) & np.isfinite(depth)
    if robot is not None:
        kept &= ~robot
    kept[1::_STEP] = kept[:, 1::_STEP] = False
    kept |= np.array([False, *(box.measured for box in boxes)])[labels]  # what was measured is in view
    points = camera + depth[kept, None] * rays[kept]
    return LabelledCloud(points.astype(np.float32), labels[kept], camera, measured=False)


def _through_circle(start: Array, along: Array) -> Array:
    """Where rays (h, w, 2) from a point (2,) enter and leave the unit circle, (2, h, w); NaN where they miss it."""
    a, b, c = (along**2).sum(axis=-1), along @ start, start @ start - 1.0
    return (np.array([-1.0, 1.0])[:, None, None] * np.sqrt(b * b - a * c) - b) / a


def _window(lens: Intrinsics, corners: Array) -> tuple[slice, slice]:
    """Rows and columns of an image in which something with corners (n, 3) in the optical frame may be."""
    if (corners[:, 2] <= 0.0).any():
        return slice(None), slice(None)
    (u0, v0), (u1, v1) = (np.maximum(end(lens.project(corners), axis=0), 0.0) for end in (np.min, np.max))
    return slice(int(v0), int(v1) + 2), slice(int(u0), int(u1) + 2)
