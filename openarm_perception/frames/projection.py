# SPDX-License-Identifier: Apache-2.0
"""Clouds that are no images as those of a pinhole camera, which is chosen to fit them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from openarm_common.camera.cameras import Intrinsics
from openarm_common.kernels import kernel
from openarm_common.types import Array, Bytes, Floats, Ints
from openarm_perception.geometry.depth import Points
from openarm_perception.segmentation.kernels import SLANT

#: Largest image, pixels each way, in all and for each point.
_LONGEST, _MOST_PIXELS, _EACH = 4096, 2_000_000, 16
#: Rays in the middle of the image, and those of them that are asked for the distance of their neighbours.
_MIDDLE, _ASKED = 300_000, 5000
#: Places on a grid differ so much from whole numbers, rms; those of strewn points by 0.29.
_ON_GRID = 0.1
#: Pixels grow by this while what the points cover grows by more than this: by gaps between them.
_STEP, _GAPS = 1.25, 1.04
#: Pixels around one, itself too.
_AROUND = np.ones((3, 3), np.uint8)
#: A ray further aside (tangent) belongs to no image.
WIDEST = 2.5


def fitting_camera(points: Points) -> Intrinsics:
    """Return a camera at the origin whose image has a pixel for each of the points, as far as they are as regular.

    The points of a depth image are each in a pixel of their own again; of those that are strewn a pixel has about one.

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
    place, first, covered = _raster(rays, pitch)
    while not _on_grid(place) and covered.size > 16:
        wider, at, more = _raster(rays, _STEP * pitch)
        if np.count_nonzero(more) * _STEP**2 <= _GAPS * np.count_nonzero(covered):
            break
        pitch, place, first, covered = _STEP * pitch, wider, at, more
    height, width = covered.shape
    cx, cy = (float(v) for v in -rays[0] / pitch - first)
    return Intrinsics(width, height, 1.0 / pitch, 1.0 / pitch, cx, cy)


def _raster(rays: Array, pitch: float) -> tuple[Array, NDArray[np.int64], Bytes]:
    """Return where rays (n, 2) are in an image, in pixels from the first, its first pixel, and (h, w) what they cover.

    Pixels lie where points of a grid do.
    """
    place = (rays - rays[0]) / pitch
    at = np.round(place).astype(np.int64)
    first = at.min(axis=0)
    width, height = (int(n) for n in at.max(axis=0) - first + 1)
    filled = np.zeros((height, width), np.uint8)
    filled[at[:, 1] - first[1], at[:, 0] - first[0]] = 1
    return place, first, np.asarray(cv2.morphologyEx(filled, cv2.MORPH_CLOSE, _AROUND), np.uint8)


def project(points: Points, lens: Intrinsics) -> tuple[Floats, Ints]:
    """Return the depth image of points, the nearest of each pixel; strewn ones have no gaps within a surface.

    Args:
        points: (n, 3) float32, z forward, m.
        lens: Lens of the camera.

    Returns:
        (h, w) float32, m, NaN where there is no point; and (h, w) the number of the point, -1 where there is none.
    """
    depth: Floats = np.full((lens.height, lens.width), np.nan, np.float32)
    number: Ints = np.full(depth.shape, -1, np.int64)
    _project(points, lens.fx, lens.fy, lens.cx, lens.cy, depth, number)
    seen = points[:: max(1, len(points) // _MIDDLE)]
    seen = seen[seen[:, 2] > 0.0].astype(np.float64)
    if not _on_grid(seen[:, :2] / seen[:, 2:] * (lens.fx, lens.fy) + (lens.cx, lens.cy)):
        _close(depth, number, 1.0 / lens.fx)
    return depth, number


def _on_grid(place: Array) -> bool:
    """Whether places (n, 2) in an image, pixels, are those of its pixels."""
    return float(np.sqrt(np.mean((place - np.round(place)) ** 2))) < _ON_GRID


def _close(depth: Floats, number: Ints, pixel: float) -> None:
    """Fill what is empty or seen through between the points of a surface, whose outline stays where it is.

    That is a morphological closing of what is near: each pixel gets the farthest of the nearest around it.

    Args:
        depth: (h, w) m, NaN where there is no point; changed.
        number: (h, w) of the points; changed.
        pixel: Metres across of a pixel at 1 m.
    """
    nothing = np.finfo(np.float32).max
    far = np.where(np.isnan(depth), nothing, depth)
    closed = cv2.morphologyEx(far, cv2.MORPH_OPEN, _AROUND)
    v, u = np.nonzero((closed < nothing) & (far - closed > np.float32(SLANT * pixel) * closed))
    depths, numbers = (np.pad(image, 2) for image in (depth, number))
    for dv, du in np.ndindex(5, 5):
        same = depths[v + dv, u + du] == closed[v, u]
        number[v[same], u[same]] = numbers[v + dv, u + du][same]
    depth[v, u] = closed[v, u]


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
