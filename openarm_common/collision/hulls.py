# SPDX-License-Identifier: Apache-2.0
"""Convex hulls, and the capsule about each that the fast collision layer asks first. m."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from openarm_common.types import Array

#: Directions that a capsule is tried in, and that its overhang is measured in.
_TRIED, _MEASURED = 24, 1000
#: Added to the radius of a capsule, so that rounding leaves no corner outside, m.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex hull with a capsule about it.

    Attributes:
        T: (4, 4) pose of the capsule in the frame of the hull; its axis is z.
        corners: (n, 3) of the hull, in the frame of the capsule.
        radius: Of the capsule, m.
        half: Half the length of its axis, m.
        overhang: How far the capsule reaches beyond the hull, m: measured in 1000 directions.
    """

    T: Array
    corners: Array
    radius: float
    half: float
    overhang: float

    @classmethod
    def of(cls, points: Array) -> Hull:
        """Put the smallest capsule found about points (n, 3).

        Capsules are tried about the principal axes, the axes of the frame and directions spread over a sphere. About
        each, the radius is that of a circle about the points as seen along it (Badoiu and Clarkson, "Smaller core-sets
        for balls", 2003), or a little larger where that makes the capsule shorter.
        """
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        principal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
        tried = [_capsule(points - middle, u) for u in (*principal, *np.eye(3), *directions(_TRIED))]
        _, R, centre, radius, half = min(tried, key=lambda capsule: capsule[0])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, middle + centre
        corners = (points - T[:3, 3]) @ R
        seen = directions(_MEASURED)
        # of convex bodies one in the other, the distance is that of their tangent planes where it is greatest
        gaps = radius + half * np.abs(seen[:, 2]) - (seen @ corners.T).max(axis=1)
        return cls(T, corners, radius, half, float(gaps.max()))


@lru_cache(maxsize=4)
def directions(count: int) -> Array:
    """Unit vectors (n, 3) spread evenly over a sphere."""
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1.0 - 2.0 * k / count), np.pi * (1.0 + 5.0**0.5) * k
    return np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)


def _capsule(points: Array, u: Array) -> tuple[float, Array, Array, float, float]:
    """Volume, rotation (3, 3) with z along `u`, centre (3,), radius and half length of a capsule about points."""
    u = u / np.linalg.norm(u)
    x = np.cross(u, np.eye(3)[int(np.argmin(np.abs(u)))])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(u, x), u], axis=1)
    local = points @ R
    flat, along = local[:, :2], local[:, 2]
    centre = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    for k in range(40):
        away = flat - centre
        centre = centre + away[int(np.argmax(np.einsum("ij,ij->i", away, away)))] / (k + 2.0)
    off = np.linalg.norm(flat - centre, axis=1)
    found = []
    for factor in (1.0, 1.03, 1.08, 1.15, 1.3):
        r = float(off.max()) * factor + 1e-6
        room = np.sqrt(np.maximum(r * r - off * off, 0.0))
        low, high = float((along + room).min()), float((along - room).max())
        low, high = (low, high) if low < high else (0.5 * (low + high),) * 2
        half, middle = 0.5 * (high - low), R @ np.array([*centre, 0.5 * (low + high)])
        found.append((np.pi * r * r * (2.0 * half + 4.0 / 3.0 * r), R, middle, r + _ROUNDING, half))
    return min(found, key=lambda capsule: capsule[0])
