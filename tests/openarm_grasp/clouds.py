# SPDX-License-Identifier: Apache-2.0
"""Clouds of shapes of convex parts, as a camera over the table sees them; base frame, m."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial import ConvexHull

from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from openarm_grasp.config import ApproachConfig, CloudConfig
from openarm_grasp.sampling.antipodal import Antipodal, Search
from openarm_grasp.sampling.hand_shape import HandShape
from openarm_grasp.sampling.surface import Surface, View, fuse

TABLE_Z = 0.40
#: Straight above the middle of the region, and where the overhead camera is.
ABOVE, SLANTED = np.array([0.27, -0.2, 1.10]), np.array([0.55, 0.0, 1.10])


@cache
def hand(robot: str = "openarm_v1", arm: str = "right") -> HandShape:
    """An open hand with its camera."""
    cameras = load_cameras().values() if robot == "openarm_v1" else ()
    return HandShape.of(RobotDescription.load(robot), arm, cameras)


def box(size: tuple[float, float, float], x: float = 0.27, y: float = -0.2, yaw: float = 0.0) -> Array:
    """Corners of a box on the table."""
    corners = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * size
    return se3.apply(se3.make(se3.rot_z(yaw), (x, y, TABLE_Z + 0.5 * size[2])), corners)


def ball(radius: float, x: float = 0.27, y: float = -0.2) -> Array:
    """Points of a sphere on the table."""
    u, v = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 32), np.linspace(0.0, np.pi, 17))
    unit = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)
    return radius * unit + (x, y, TABLE_Z + radius)


def seen(parts: list[Array], camera: Array = ABOVE, step: float = 0.0018) -> Array:
    """Points (n, 3) that a camera sees of convex parts, on rays `step` apart at the height of the table."""
    points = np.concatenate(parts)
    low, high = points[:, :2].min(axis=0) - 0.15, points[:, :2].max(axis=0) + 0.15
    x, y = np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step))
    aims = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, TABLE_Z)])
    along = (aims - camera) / np.linalg.norm(aims - camera, axis=1, keepdims=True)
    best = np.full(len(along), np.inf)
    for part in parts:
        shadow = camera + (part - camera) * ((TABLE_Z - camera[2]) / (part[:, 2:] - camera[2]))
        on = ((aims >= shadow.min(axis=0) - 1e-6) & (aims <= shadow.max(axis=0) + 1e-6)).all(axis=1)
        e = ConvexHull(part).equations
        rate, value = along[on] @ e[:, :3].T, e[:, :3] @ camera + e[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            at = -value / rate
        enter = np.where(rate < 0.0, at, -np.inf).max(axis=1)
        leave = np.where(rate > 0.0, at, np.inf).min(axis=1)
        best[on] = np.where((enter <= leave) & (enter > 0.0), np.minimum(best[on], enter), best[on])
    hit = np.isfinite(best)
    return camera + best[hit, None] * along[hit]


def surface_of(parts: list[Array], camera: Array = ABOVE, others: list[Array] | None = None) -> Surface:
    """The fused surface of one view."""
    around = seen(others, camera) if others else np.empty((0, 3))
    return fuse([View(camera, seen(parts, camera), around)], TABLE_Z)


def grasps(surface: Surface, shape: HandShape | None = None) -> tuple[Antipodal, ...]:
    """Ranked grasps of the right hand."""
    return Search(surface, shape or hand(), CloudConfig(), ApproachConfig()).best()
