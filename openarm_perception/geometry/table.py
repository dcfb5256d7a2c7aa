# SPDX-License-Identifier: Apache-2.0
"""How high the table really is: a plane through what a depth camera sees of it. Base frame, z up, m."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_perception.detection.localize import LocatedObject
from openarm_perception.geometry.depth import Deprojector, DepthImage, DepthLimits

#: Range around the expected height in which the table is searched, m.
SEARCH = 0.08
#: Points this near to the plane belong to it, m.
_BAND = 0.008
_BIN = 0.004
#: Fewest points of a table; more than the second are no more exact.
_MIN_POINTS, _POINTS = 2000, 40_000


@dataclass(frozen=True)
class TableMeasurement:
    """A measured table.

    Attributes:
        height: Of the plane in the middle of its points, m.
        std: Rms distance of the points from the plane, m.
        tilt: Of the plane against the horizontal, rad.
        points: How many were used.
    """

    height: float
    std: float
    tilt: float
    points: int


def measure_table(
    depth: DepthImage, intrinsics: Intrinsics, T_base_camera: Array, limits: DepthLimits, expected: float
) -> TableMeasurement:
    """Fit the largest level surface near the expected height; objects and robot on it do not matter.

    Args:
        depth: (h, w) uint16 millimetres or float32 metres.
        intrinsics: Of the camera.
        T_base_camera: (4, 4) optical frame in the base frame.
        limits: Depths that count.
        expected: Height of the table so far, m.

    Raises:
        OpenArmError: BAD_IMAGE, when depth and intrinsics do not fit; NOTHING_DETECTED, when there is no such surface.
    """
    cloud = Deprojector(limits).valid_points(depth, intrinsics)
    points = se3.apply(T_base_camera, cloud[:: max(1, len(cloud) // _POINTS)].astype(np.float64))
    near = points[np.abs(points[:, 2] - expected) <= SEARCH]
    edges = expected + np.arange(-SEARCH, SEARCH + _BIN, _BIN)
    count, _ = np.histogram(near[:, 2], edges)
    # a surface between two bins counts in both
    level = float(edges[int(np.argmax(count[:-1] + count[1:])) + 1])
    used = near[np.abs(near[:, 2] - level) <= 2.0 * _BAND]
    middle, normal, residual = np.zeros(3), np.array([0.0, 0.0, 1.0]), np.zeros(0)
    for _ in range(4):
        if len(used) < _MIN_POINTS:
            raise OpenArmError(
                Code.NOTHING_DETECTED,
                f"{len(used)} points of a level surface within {SEARCH:g} m of {expected:.3f} m, expected at least"
                f" {_MIN_POINTS}; does the camera see the table?",
            )
        middle = used.mean(axis=0)
        normal = np.linalg.svd(used - middle, full_matrices=False)[2][2]
        residual = (near - middle) @ normal
        kept = np.abs(residual) <= _BAND
        used, residual = near[kept], residual[kept]
    rms = float(np.sqrt(np.mean(residual**2)))
    return TableMeasurement(float(middle[2]), rms, math.acos(min(1.0, abs(float(normal[2])))), len(used))


def of_block(place: LocatedObject, block_height: float) -> TableMeasurement:
    """Return the table under a block of known height: its measured top less that height.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a height that no block has.
    """
    if not 0.005 <= block_height <= 0.5:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"block_height is {block_height:g} m; expected 0, or 0.005 .. 0.5")
    top = float(place.p_base[2]) + place.size[2] / 2.0
    return TableMeasurement(top - block_height, math.sqrt(float(place.covariance[2, 2])), 0.0, place.points)
