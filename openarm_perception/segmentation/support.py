# SPDX-License-Identifier: Apache-2.0
"""The plane that things stand on, found in an organised cloud, and how noisy depth is.

The plane through most of the image is found by hypotheses of one point with its normal (Schnabel, Wahl, Klein 2007,
Efficient RANSAC for point-cloud shape detection), and fitted by least squares to its points, again and again with the
noise measured at them. Noise grows with the square of the depth, as it does for stereo and structured light
(Khoshelham, Elberink 2012); its factor is that of the points on the plane, so a warped image counts as a noisy one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_perception.geometry.depth import Points
from openarm_perception.geometry.levels import outside
from openarm_perception.segmentation.kernels import local_normals

#: Noise at 1 m, m, that is assumed first, and the range within which it is measured: from industrial structured light
#: to the first consumer sensors.
FIRST_NOISE, LEAST_NOISE, _MOST_NOISE = 0.003, 0.0004, 0.008
#: Points on a grid of the image that are looked at, hypotheses, and points that choose among them.
_SAMPLES, _TRIES, _VOTERS = 20_000, 256, 2000
#: A support has this share of the points that were measured at least.
_SHARE = 0.1
#: A surface that things stand on is within this of level, where the direction up is known, rad.
_STEEPEST = math.radians(25.0)
#: A table is this near to where it is known to be, m, and as level as that, rad.
_OFF, _TILT = 0.012, math.radians(2.0)
#: Normals of points on the plane are within this of its own, rad.
_NORMAL = math.radians(25.0)

#: A plane that is seen this near to where the image ends goes on there, under what is no higher, m.
_ROUND, _LOW = 0.03, 0.25


@dataclass(frozen=True, eq=False)
class Support:
    """A plane that things stand on.

    Attributes:
        normal: (3,) unit vector towards the side of the camera.
        offset: m; `points @ normal + offset` are heights over the plane.
        noise: Standard deviation of a depth at 1 m, m; it grows with the square of the depth.
        hull: (k, 2) outline of what is seen of the plane, m, in the axes below.
        axes: (3, 2) directions in the plane, which with the normal are a right-handed frame.
        share: Share of the measured points that lie on it.
    """

    normal: Array
    offset: float
    noise: float
    hull: Array
    axes: Array
    share: float

    def heights(self, points: Points) -> Points:
        """Return the heights of points (..., 3) over the plane, m; NaN of NaN."""
        return points @ self.normal.astype(np.float32) + np.float32(self.offset)

    def share_over(self, points: Array, intrinsics: Intrinsics) -> float:
        """Return which share of points (n, 3) lies over what is seen of the plane, 0 to 1.

        What stands so near to the border of the image that its foot is not in it counts, too, where the plane is seen
        at that border.
        """
        if not len(points):
            return 0.0
        height, size = points @ self.normal + self.offset, np.array([intrinsics.width, intrinsics.height])
        feet = points - height[:, None] * self.normal
        known = (points[:, 2] > 0.0) & (feet[:, 2] > 0.0)
        begin, end = (_pixels(np.where(known[:, None], p, 1.0), intrinsics) for p in (points, feet))
        step = end - begin
        with np.errstate(divide="ignore", invalid="ignore"):
            # the way to the foot leaves the image here, where it does
            leaves = np.where(step > 0.0, (size - 1.0 - begin) / step, np.where(step < 0.0, -begin / step, np.inf))
        share = np.clip(leaves.min(axis=1), 0.0, 1.0)
        border = begin + share[:, None] * step
        rays = np.column_stack(
            [(border - (intrinsics.cx, intrinsics.cy)) / (intrinsics.fx, intrinsics.fy), np.ones(len(points))]
        )
        facing = rays @ self.normal
        there = rays * np.where(facing < -1e-9, -self.offset / np.minimum(facing, -1e-9), np.inf)[:, None]
        cut = known & (share < 1.0) & (height <= _LOW) & np.isfinite(there).all(axis=1)
        goes_on = self.outside(np.where(cut[:, None], there, 0.0)) <= _ROUND
        return float(np.mean((self.outside(points) <= 0.0) | (cut & goes_on)))

    def outside(self, points: Array) -> Array:
        """Return how far points (n, 3) are beyond the outline of what is seen of the plane, m (n,); negative inside."""
        return outside(self.hull, points @ self.axes)


def find_support(points: Points, up: Array | None = None) -> Support:
    """Find the plane that things stand on: the one with most pixels, level where `up` is known.

    Args:
        points: (h, w, 3) organised, optical frame, m; NaN where nothing was measured.
        up: (3,) direction in that frame; None: the plane may have any.

    Raises:
        OpenArmError: NOTHING_DETECTED, when no plane has a tenth of the points.
    """
    step = max(1, math.ceil(math.sqrt(points.shape[0] * points.shape[1] / _SAMPLES)))
    reach = max(2, step)
    normals = local_normals(points, step, reach, np.float32(FIRST_NOISE)).reshape(-1, 3).astype(np.float64)
    seen = points[::step, ::step].reshape(-1, 3).astype(np.float64)
    measured = int(np.count_nonzero(np.isfinite(seen[:, 2])))
    known = np.isfinite(normals[:, 0])
    candidates, directions = seen[known], normals[known]
    if up is not None:
        level = directions @ up > math.cos(_STEEPEST)
        candidates, directions = candidates[level], directions[level]
    refusal = OpenArmError(
        Code.NOTHING_DETECTED,
        f"no plane has {_SHARE:.0%} of the {measured} points that were looked at; expected a table, a floor or the"
        " bottom of a box in view" + ("" if up is None else ", level by the pose of the camera"),
    )
    if len(candidates) < max(_SHARE * measured, 12):
        raise refusal
    middle, normal = _vote(candidates, directions)
    noise, used = FIRST_NOISE, candidates[:0]
    for band in (4.0, 3.0, 3.0, 3.0, 3.0):
        # noise acts along the ray; across a slanted plane it is less
        facing = np.abs(candidates @ normal) / np.maximum(np.linalg.norm(candidates, axis=1), 1e-6)
        sigma = noise * candidates[:, 2] ** 2 * facing + 1e-4
        off = (candidates - middle) @ normal
        on = (np.abs(off) <= band * sigma) & (directions @ normal > math.cos(_NORMAL))
        used = candidates[on]
        if len(used) < max(_SHARE * measured, 12):
            raise refusal
        weight = 1.0 / sigma[on] ** 2
        middle = np.average(used, axis=0, weights=weight)
        normal = np.linalg.eigh(np.cov((used - middle).T, aweights=weight))[1][:, 0]
        normal = -normal if normal @ middle > 0.0 else normal
        off = np.abs((used - middle) @ normal) / (used[:, 2] ** 2 * facing[on])
        # a standard deviation of what is left within the band; 1.55 makes up for its tails
        noise = float(np.clip(1.55 * np.median(off), LEAST_NOISE, _MOST_NOISE))
    axes = _axes(normal)
    hull = cv2.convexHull((used @ axes).astype(np.float32))[:, 0].astype(np.float64)
    return Support(normal, -float(normal @ middle), noise, hull, axes, len(used) / max(measured, 1))


def support_at(points: Points, T_base_camera: Array, height: float) -> Support:
    """Return the plane next to a known height: that of the surface which is seen there, else the level one.

    Args:
        points: (h, w, 3) organised, optical frame, m; NaN where nothing was measured.
        T_base_camera: (4, 4) optical frame in the base frame, whose z points up.
        height: Height of the plane in the base frame, m.
    """
    normal = T_base_camera[2, :3].astype(np.float64)
    offset = float(T_base_camera[2, 3]) - height
    step = max(1, math.ceil(math.sqrt(points.shape[0] * points.shape[1] / _SAMPLES)))
    seen = points[::step, ::step].reshape(-1, 3).astype(np.float64)
    seen = seen[np.isfinite(seen[:, 2])]
    scale = np.maximum(seen[:, 2] ** 2 * np.abs(seen @ normal) / np.maximum(np.linalg.norm(seen, axis=1), 1e-6), 1e-6)
    noise, near = FIRST_NOISE, seen[:0]
    for band in (_OFF, 3.0, 3.0):
        off = seen @ normal + offset
        on = np.abs(off) <= (band if band == _OFF else band * np.maximum(noise * scale, 1e-3))
        near = seen[on]
        if len(near) < max(_SHARE * len(seen), 12):
            break
        # about the median: what stands on it is on one side
        off = off[on] - np.median(off[on])
        noise = float(np.clip(1.4826 * np.median(np.abs(off) / scale[on]), LEAST_NOISE, _MOST_NOISE))
        middle = near.mean(axis=0)
        tilted = np.linalg.eigh(np.cov((near - middle).T))[1][:, 0]
        tilted *= np.sign(tilted @ normal)
        if tilted @ normal > math.cos(_TILT):
            normal, offset = tilted, -float(tilted @ middle)
    axes = _axes(normal)
    flat = seen @ axes
    hull = cv2.convexHull(flat.astype(np.float32))[:, 0].astype(np.float64) if len(flat) >= 3 else np.zeros((3, 2))
    return Support(normal, offset, noise, hull, axes, len(near) / max(len(seen), 1))


def _axes(normal: Array) -> Array:
    """Return two directions (3, 2) that are a right-handed frame with a normal."""
    axes = np.linalg.svd(normal[None])[2][1:].T
    return axes if np.linalg.det(np.column_stack([axes, normal])) > 0.0 else axes[:, ::-1].copy()


def _vote(points: Array, normals: Array) -> tuple[Array, Array]:
    """Return point and normal of the hypothesis that most points agree with."""
    # the same hypotheses for the same image: a segmentation can be repeated
    random = np.random.default_rng(0)
    tried = random.integers(0, len(points), _TRIES)
    voters = random.integers(0, len(points), _VOTERS)
    p, n = points[voters], normals[voters]
    band = 3.0 * FIRST_NOISE * p[:, 2] ** 2 + 0.002
    off = np.abs(p @ normals[tried].T - np.sum(points[tried] * normals[tried], axis=1))
    agree = (off <= band[:, None]) & (n @ normals[tried].T > math.cos(_NORMAL))
    best = int(np.argmax(np.count_nonzero(agree, axis=0)))
    return points[tried[best]], normals[tried[best]]


def _pixels(points: Array, intrinsics: Intrinsics) -> Array:
    """Return the pixels (n, 2) that points (n, 3) before the camera are seen at."""
    focal, centre = (intrinsics.fx, intrinsics.fy), (intrinsics.cx, intrinsics.cy)
    return np.asarray(points[:, :2] / np.maximum(points[:, 2:], 1e-6) * focal + centre)
