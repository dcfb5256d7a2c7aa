# SPDX-License-Identifier: Apache-2.0
"""Depth images of boxes on a table, by rays: what a camera sees, and which box each pixel shows."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import DepthView
from openarm_common.labelled_cloud import LabelledCloud

LENS = Intrinsics.from_fovy(320, 240, 60.0)
#: 0.8 m over the table, which is at height 0, looking down.
ABOVE = se3.make(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 0.8))
Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # middle, full edges, m


def image(
    boxes: Mapping[int, Box], T_base_camera: np.ndarray = ABOVE, noise: np.random.Generator | None = None
) -> tuple[DepthView, np.ndarray]:
    """Depth, and the number of the box of each pixel, 0: the table. The noise is what smoothing leaves of a D435's."""
    x, y = LENS.rays
    rays = np.stack([*np.meshgrid(x, y), np.ones((LENS.height, LENS.width))], axis=-1) @ T_base_camera[:3, :3].T
    origin = T_base_camera[:3, 3]
    with np.errstate(divide="ignore"):
        depth = -origin[2] / rays[..., 2]
        number = np.zeros(depth.shape, np.uint32)
        for i, (middle, edges) in boxes.items():
            ends = [(np.asarray(middle) + s * np.asarray(edges) / 2.0 - origin) / rays for s in (-1.0, 1.0)]
            enter, leave = np.minimum(*ends).max(axis=-1), np.maximum(*ends).min(axis=-1)
            hit = (enter < leave) & (enter > 0.0) & (enter < depth)
            depth[hit], number[hit] = enter[hit], i
    if noise is not None:
        depth = depth + noise.normal(0.0, 0.001, depth.shape) * depth**2
    return DepthView(depth.astype(np.float32), LENS, T_base_camera, 0.05, 3.0), number


def clouds(view: DepthView, labels: np.ndarray) -> LabelledCloud:
    """The points of an image in the base frame; labels (h, w) of detections, 0: none."""
    x, y = LENS.rays
    points = np.stack([x * view.depth, y[:, None] * view.depth, view.depth], axis=-1).reshape(-1, 3)
    return LabelledCloud(points, labels.ravel().astype(np.uint32), np.zeros(3)).moved(view.T_base_camera)
