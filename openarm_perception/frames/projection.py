# SPDX-License-Identifier: Apache-2.0
"""Clouds that are no images as those of a pinhole camera, which is chosen to fit them."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import KDTree

from openarm_common.camera.cameras import Intrinsics
from openarm_common.kernels import kernel
from openarm_common.types import Floats, Ints
from openarm_perception.geometry.depth import Points

#: Largest image, pixels each way, in all and for each point.
_LONGEST, _MOST_PIXELS, _EACH = 4096, 2_000_000, 16
#: Rays in the middle of the image, and those of them that are asked for the distance of their neighbours.
_MIDDLE, _ASKED = 300_000, 5000
#: Places on a grid differ so much from whole numbers, rms; those of strewn points by 0.29.
_ON_GRID = 0.1
#: Pixels grow by this until fewer than this share of those that are surrounded have no point.
_STEP, _HOLES = 1.25, 0.02
#: A ray further aside (tangent) belongs to no image.
WIDEST = 2.5


def fitting_camera(points: Points) -> Intrinsics:
    """Return a camera at the origin whose image has a pixel for each of the points, as far as they are as regular.

    The points of a depth image are each in a pixel of their own again; a pixel has four or so of those that are strewn.

    Args:
        points: (n, 3) float32, z forward and positive, m; at least one.
    """
    with np.errstate(over="ignore"):
        rays = points[:, :2] / points[:, 2:].astype(np.float64)
    rays = rays[(np.abs(rays) < WIDEST).all(axis=1)]
    aside = np.abs(rays - np.median(rays, axis=0)).max(axis=1)
    middle = rays[np.argpartition(aside, _MIDDLE)[:_MIDDLE]] if len(rays) > _MIDDLE else rays
    # of a grid the fourth neighbour is one step away, and of strewn points about as far as their mean distance
    distance, _ = KDTree(middle).query(middle[:: max(1, len(middle) // _ASKED)], k=min(5, len(middle)))
    extent = np.ptp(rays, axis=0)
    pitch = max(float(np.median(distance[:, -1])) if len(rays) > 1 else 0.0, float(extent.max()) / (_LONGEST - 1))
    pitch = max(pitch, float(np.sqrt(np.prod(extent) / min(_MOST_PIXELS, _EACH * len(rays)))), 1e-5)
    while True:
        # pixels lie where points of a grid do
        place = (rays - rays[0]) / pitch
        at = np.round(place).astype(np.int64)
        first, last = at.min(axis=0), at.max(axis=0)
        width, height = (int(n) for n in last - first + 1)
        filled = np.zeros((height, width), np.uint8)
        filled[at[:, 1] - first[1], at[:, 0] - first[0]] = 1
        around = cv2.boxFilter(filled, cv2.CV_16S, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        holes = int(np.count_nonzero((filled == 0) & (around >= 5)))
        grid = float(np.sqrt(np.mean((place - at) ** 2))) < _ON_GRID
        if grid or holes <= _HOLES * int(filled.sum()) or max(width, height) < 16:
            break
        pitch *= _STEP
    cx, cy = (float(v) for v in -rays[0] / pitch - first)
    return Intrinsics(width, height, 1.0 / pitch, 1.0 / pitch, cx, cy)


def project(points: Points, lens: Intrinsics) -> tuple[Floats, Ints]:
    """Return the depth image of points, the nearest of each pixel.

    Args:
        points: (n, 3) float32, z forward, m.
        lens: Of the camera.

    Returns:
        (h, w) float32, m, NaN where there is no point; and (h, w) the number of the point, -1 where there is none.
    """
    depth: Floats = np.full((lens.height, lens.width), np.nan, np.float32)
    number: Ints = np.full(depth.shape, -1, np.int64)
    _project(points, lens.fx, lens.fy, lens.cx, lens.cy, depth, number)
    return depth, number


@kernel
def _project(points: Points, fx: float, fy: float, cx: float, cy: float, depth: Floats, number: Ints) -> None:
    height, width = depth.shape
    for i in range(points.shape[0]):
        z = np.float64(points[i, 2])
        if not z > 0.0:
            continue
        u, v = np.round(points[i, 0] / z * fx + cx), np.round(points[i, 1] / z * fy + cy)
        if 0.0 <= u < width and 0.0 <= v < height:
            row, column = int(v), int(u)
            if not z >= depth[row, column]:  # the first one, too
                depth[row, column] = z
                number[row, column] = i
