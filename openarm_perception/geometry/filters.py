# SPDX-License-Identifier: Apache-2.0
"""Filters of depth images and clouds: noise, flying pixels, density, outliers.

Depth images are (h, w), uint16 millimetres or float32 metres, 0 or NaN where invalid; points are (n, 3) float32, m, in
any frame.
"""

from __future__ import annotations

import importlib
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import KDTree

from openarm_common.camera.depth_view import DepthImage, unit_scale
from openarm_common.camera.flying_pixels import label_lonely
from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.kernels import kernel
from openarm_common.types import Ints
from openarm_perception.geometry.depth import Points

#: Cells along an axis that a packed key distinguishes, half of them on each side of zero.
_HALF = 1 << 20
#: A pixel of a surface has this many of its eight neighbours on it, also at a corner.
_SAME_SURFACE = 3


class FilterConfig(Config):
    """Which filters a cloud goes through, in this order; all are off by default."""

    median: Literal[0, 3, 5] = Field(default=0, description="median of the depth over so many pixels a side; 0 off")
    flying: float = Field(
        default=0.0, ge=0.0, le=0.5, description="a pixel this far from its neighbours is dropped, m/m; 0 off"
    )
    voxel: float = Field(
        default=0.0, ge=0.0, le=0.2, description="one point a cell of this edge, m; 0 off; not organised"
    )
    outliers: bool = Field(default=False, description="drop points far from their nearest ones; not organised")
    neighbours: int = Field(default=20, ge=2, le=200, description="how many nearest points count for that")
    deviations: float = Field(
        default=2.0, gt=0.0, le=10.0, description="standard deviations above the mean that are too far"
    )
    outliers_by: Literal["scipy", "open3d"] = Field(
        default="scipy", description="whose search finds outliers, by the same rule; open3d where it is installed"
    )


def median_depth(depth: DepthImage, size: int) -> DepthImage:
    """Return the median over 3 × 3 or 5 × 5 pixels; pixels that were invalid stay so, those at holes keep their value.

    Raises:
        OpenArmError: BAD_IMAGE, for another type of image.
    """
    unit_scale(depth)
    clean = np.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0)
    valid = clean > 0
    smooth = cv2.medianBlur(clean, size)
    # invalid neighbours count as zero and pull the median towards the camera
    whole = cv2.erode(valid.astype(np.uint8), np.ones((size, size), np.uint8), borderValue=1) > 0
    out = depth.copy()
    out[whole] = smooth[whole]
    return out


def drop_flying(depth: DepthImage, tolerance: float) -> DepthImage:
    """Drop pixels between a near and a far surface, where a sensor mixes both.

    Args:
        depth: The image.
        tolerance: A neighbour belongs to the same surface when its depth differs by less than this share, m/m. A pixel
            stays when three of its eight neighbours belong to its surface.

    Returns:
        A copy with 0 in place of what is dropped.
    """
    lonely = np.zeros(depth.shape, np.uint8)
    scale, near, far = np.float32(unit_scale(depth)), np.finfo(np.float32).tiny, np.float32(np.inf)
    label_lonely(depth, scale, near, far, np.float32(tolerance), np.float32(0.0), _SAME_SURFACE, lonely)
    out = depth.copy()
    np.copyto(out, 0, where=lonely > 0)
    return out


def voxel_filter(points: Points, edge: float) -> Points:
    """Return one point per cell: the mean of those in it, in the order in which cells are first met.

    Cells lie on the absolute lattice ``floor(p / edge)``, so that they stay where they are from image to image.

    Args:
        points: (n, 3) float32; points that are not finite or further than 10^6 cells away are dropped.
        edge: Edge of a cell, m; positive.
    """
    size = 1 << max(4, int(2 * max(len(points), 1) - 1).bit_length())
    table = np.full(size, -1, np.int64)
    sums = np.zeros((len(points), 4), np.float64)
    count = _collect(points, 1.0 / edge, table, np.empty(size, np.int64), sums)
    return (sums[:count, :3] / sums[:count, 3:]).astype(np.float32)


@kernel
def _collect(points: Points, inverse: float, table: Ints, cells: Ints, sums: NDArray[np.float64]) -> int:
    mask = table.size - 1
    count = 0
    for i in range(points.shape[0]):
        x = np.floor(np.float64(points[i, 0]) * inverse)
        y = np.floor(np.float64(points[i, 1]) * inverse)
        z = np.floor(np.float64(points[i, 2]) * inverse)
        if not (abs(x) < _HALF and abs(y) < _HALF and abs(z) < _HALF):
            continue
        key = (np.int64(x) + _HALF) << 42 | (np.int64(y) + _HALF) << 21 | (np.int64(z) + _HALF)
        slot = np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)) & mask
        while table[slot] != key and table[slot] != -1:
            slot = (slot + 1) & mask
        if table[slot] == -1:
            table[slot] = key
            cells[slot] = count
            count += 1
        cell = cells[slot]
        for k in range(3):
            sums[cell, k] += points[i, k]
        sums[cell, 3] += 1.0
    return count


def statistical_inliers(points: Points, neighbours: int = 20, deviations: float = 2.0) -> NDArray[np.bool_]:
    """Return which points are not outliers: those whose mean distance to their nearest ones is not unusually large.

    The same rule as open3d's `remove_statistical_outlier`: a point is one of its own nearest; a point is kept when its
    mean is below the mean of all plus `deviations` standard deviations, and above zero.

    Args:
        points: (n, 3), finite.
        neighbours: Number of nearest points that count, the point itself among them.
        deviations: Standard deviations from which on a distance is too large.

    Returns:
        (n,) mask; all True for fewer than three points.
    """
    if len(points) < 3:
        return np.ones(len(points), bool)
    distances, _ = KDTree(points).query(points, k=min(neighbours, len(points)))
    means = np.asarray(distances, np.float64).mean(axis=1)
    counted = means[means > 0.0]
    if len(counted) < 2:
        return np.ones(len(points), bool)
    limit = counted.mean() + deviations * counted.std(ddof=1)
    return np.asarray((means > 0.0) & (means < limit))


def open3d_inliers(points: Points, neighbours: int = 20, deviations: float = 2.0) -> NDArray[np.bool_]:
    """Return `statistical_inliers` as open3d computes them.

    Args:
        points: (n, 3), finite.
        neighbours: Number of nearest points that count.
        deviations: Standard deviations from which on a distance is too large.

    Raises:
        OpenArmError: ENVIRONMENT, without open3d.
    """
    geometry, utility = _open3d()
    cloud = geometry.PointCloud(utility.Vector3dVector(points.astype(np.float64)))
    kept = np.zeros(len(points), bool)
    if len(points) < 3:
        return ~kept
    kept[np.asarray(cloud.remove_statistical_outlier(min(neighbours, len(points)), deviations)[1], np.int64)] = True
    return kept


def _open3d() -> tuple[Any, Any]:
    """Return the modules `geometry` and `utility` of open3d."""
    try:
        open3d = importlib.import_module("open3d")
    except ImportError as error:
        raise OpenArmError(
            Code.ENVIRONMENT,
            f"filter.outliers_by is open3d, which can't be imported ({error}); "
            "install it (pip install 'openarm-vision[cloud]'), or set filter.outliers_by to scipy",
        ) from error
    return open3d.geometry, open3d.utility


class CloudFilter:
    """The filters of a configuration.

    Args:
        config: Filters and their settings.

    Raises:
        OpenArmError: ENVIRONMENT, when open3d is asked for and missing.
    """

    def __init__(self, config: FilterConfig) -> None:
        self._config = config
        self._inliers = open3d_inliers if config.outliers_by == "open3d" else statistical_inliers
        if config.outliers and config.outliers_by == "open3d":
            _open3d()

    def depth(self, depth: DepthImage) -> DepthImage:
        """Apply the filters that work on the image."""
        if self._config.median:
            depth = median_depth(depth, self._config.median)
        return drop_flying(depth, self._config.flying) if self._config.flying > 0.0 else depth

    def points(self, points: Points) -> Points:
        """Apply the filters that work on points."""
        if self._config.voxel > 0.0:
            points = voxel_filter(points, self._config.voxel)
        if self._config.outliers:
            points = points[self._inliers(points, self._config.neighbours, self._config.deviations)]
        return points
