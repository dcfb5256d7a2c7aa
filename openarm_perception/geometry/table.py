# SPDX-License-Identifier: Apache-2.0
"""How high the table really is: a plane through what a depth camera sees of it. Base frame, z up, m."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from openarm_common import se3
from openarm_common.camera.depth_view import check_size, unit_scale
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_perception.detection.localize import LocatedObject
from openarm_perception.geometry.depth import DepthLimits, View

#: Range around the expected height in which the table is searched, m, and how much it may seem to be tilted, rad.
SEARCH, _STEEPEST = 0.2, math.radians(25.0)
#: Points this near to the plane belong to it, m.
_BAND = 0.008
#: A table is at least this share of the image, and this wide (standard deviation across its narrow side), m.
_SHARE, _WIDE = 0.1, 0.05
#: As many pixels are enough; planes through three points that are tried, and points that choose among them.
_PIXELS, _TRIES, _VOTERS = 40_000, 128, 1000


@dataclass(frozen=True)
class TableMeasurement:
    """A measured table.

    Attributes:
        height: Height of the plane in the middle of its points, m.
        std: Rms distance of the points from the plane, m.
        tilt: Tilt of the plane against the horizontal, rad.
        points: Number of points that were used.
        share: Share of all points that were seen.
    """

    height: float
    std: float
    tilt: float
    points: int
    share: float = 1.0


def measure_table(view: View, limits: DepthLimits, expected: float, pixels: int = _PIXELS) -> TableMeasurement:
    """Fit the largest surface near the expected height that may be level; objects and robot on it do not matter.

    Args:
        view: The frame.
        limits: Depths that count.
        expected: Height of the table so far, m.
        pixels: Number of pixels, spread over the image, that is enough.

    Raises:
        OpenArmError: BAD_IMAGE, when depth and intrinsics do not fit; NOTHING_DETECTED, when there is no such surface.
    """
    points, looked = _points(view, limits, pixels)
    near = points[np.abs(points[:, 2] - expected) <= SEARCH]
    middle, normal, used, narrow = _plane(near)
    if len(used) < _SHARE * looked or narrow < _WIDE:
        raise OpenArmError(
            Code.NOTHING_DETECTED,
            f"{len(used)} points of a level surface within {SEARCH:g} m of {expected:.3f} m, expected at least"
            f" {_SHARE * looked:.0f}, not in a strip; does the camera see the table?",
        )
    rms = float(np.sqrt(np.mean(((used - middle) @ normal) ** 2)))
    tilt = math.acos(min(1.0, abs(float(normal[2]))))
    return TableMeasurement(float(middle[2]), rms, tilt, len(used), len(used) / len(points))


def _points(view: View, limits: DepthLimits, pixels: int) -> tuple[Array, int]:
    """Return points (n, 3) of pixels on a grid, without the robot, base frame, m, and how many pixels that were."""
    check_size("depth image", view.depth.shape, view.intrinsics)
    step = math.ceil(math.sqrt(view.depth.size / pixels))
    z = view.depth[::step, ::step].astype(np.float64) * unit_scale(view.depth)
    with np.errstate(invalid="ignore"):
        seen = (z >= limits.near) & (z <= limits.far)
    if view.robot is not None:
        seen &= ~view.robot[::step, ::step]
    v, u = np.nonzero(seen)
    return se3.apply(view.T_base_camera, view.intrinsics.deproject(np.stack([u, v], axis=-1) * step, z[seen])), z.size


def _plane(points: Array) -> tuple[Array, Array, Array, float]:
    """Fit a plane through most points (n, 3): middle, unit normal, its points, their std across the narrow side, m."""
    middle, normal, used, narrow = np.zeros(3), np.array([0.0, 0.0, 1.0]), points[:0], 0.0
    if len(points) < 3:
        return middle, normal, used, narrow
    # the same three points for the same image: a measurement can be repeated
    a, b, c = points[np.random.default_rng(0).integers(0, len(points), (3, _TRIES))]
    across = np.cross(b - a, c - a)
    length = np.linalg.norm(across, axis=1)
    level = np.abs(across[:, 2]) > math.cos(_STEEPEST) * length
    if not level.any():
        return middle, normal, used, narrow
    a, normals = a[level], across[level] / length[level][:, None]
    voters = points[:: max(1, len(points) // _VOTERS)]
    votes = np.count_nonzero(np.abs(voters @ normals.T - np.sum(a * normals, axis=1)) <= 2.0 * _BAND, axis=0)
    middle, normal = a[int(np.argmax(votes))], normals[int(np.argmax(votes))]
    for band in (2.0, 1.0, 1.0, 1.0):
        used = points[np.abs((points - middle) @ normal) <= band * _BAND]
        if len(used) < 3:
            break
        middle = used.mean(axis=0)
        spread, axes = np.linalg.eigh(np.cov(used.T, bias=True))
        normal, narrow = axes[:, 0], math.sqrt(max(float(spread[1]), 0.0))
    return middle, normal, used, narrow


def of_block(place: LocatedObject, block_height: float) -> TableMeasurement:
    """Return the table under a block of known height: its measured top less that height.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a height that no block has.
    """
    if not 0.005 <= block_height <= 0.5:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"block_height is {block_height:g} m; expected 0, or 0.005 .. 0.5")
    top = float(place.p_base[2]) + place.size[2] / 2.0
    return TableMeasurement(top - block_height, math.sqrt(float(place.covariance[2, 2])), 0.0, place.points)
