# SPDX-License-Identifier: Apache-2.0
"""Convex hulls: a mesh as few of them, and the capsule about each that the fast collision layer asks first. m."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from openarm_common.types import Array

#: A further part must save this share of the volume of the hull about all of a mesh.
_SAVED = 0.004
#: Slabs that a mesh may be cut into, before neighbours are put together again.
_SLABS = 16
#: What has no volume is given this thickness, m.
_THIN = 1e-3
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


def convex_parts(vertices: Array, triangles: NDArray[np.int64]) -> list[Array]:
    """Corners (n, 3) of convex hulls that together hold a mesh.

    The mesh is cut across its longest side where parts save most of the volume that the hull about all of it has
    too much. Each point inside a closed mesh is in the hull of its slab, since every line through it in the plane of
    the cut meets the mesh on both sides.

    Args:
        vertices: (n, 3) m.
        triangles: (m, 3) indices.
    """
    used = vertices[np.unique(triangles)]
    axis = int(np.argmax(np.ptp(used, axis=0)))
    planes = _planes(used[:, axis])
    edges = np.unique(
        np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])), axis=0
    )
    a, b = vertices[edges[:, 0]], vertices[edges[:, 1]]
    cuts = [_crossings(a, b, axis, at) for at in planes]
    whole = hull_of(used)
    least = _SAVED * whole[1]
    # the best partition of the first k slabs, for each k
    best: list[tuple[float, list[Array]]] = [(0.0, [])]
    for k in range(1, _SLABS + 1):
        choices: list[tuple[float, list[Array]]] = []
        for j in range(k):
            inside = used[(used[:, axis] >= planes[j]) & (used[:, axis] <= planes[k])]
            points = np.concatenate([inside, cuts[j], cuts[k]])
            if not len(points):
                choices.append(best[j])
                continue
            corners, volume = whole if k - j == _SLABS else hull_of(points)
            choices.append((best[j][0] + volume + least, [*best[j][1], corners]))
        best.append(min(choices, key=lambda choice: choice[0]))
    return best[-1][1]


def _planes(along: Array) -> Array:
    """Where a mesh may be cut: spread evenly, each moved to where most vertices near to it are, as at a shoulder."""
    even = np.linspace(along.min(), along.max(), _SLABS + 1)
    places, counts = np.unique(along.round(6), return_counts=True)
    nearest = np.searchsorted(0.5 * (even[1:] + even[:-1]), places)
    for k in range(1, _SLABS):
        mine = nearest == k
        if mine.any():
            even[k] = places[mine][int(np.argmax(counts[mine]))]
    return even


def hull_of(points: Array) -> tuple[Array, float]:
    """Corners (n, 3) and volume of the convex hull; points without a volume get a thin box about them."""
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        low, high = points.min(axis=0), points.max(axis=0)
        half = 0.5 * np.maximum(high - low, _THIN)
        corners = 0.5 * (low + high) + half * (2.0 * np.indices((2, 2, 2)).reshape(3, -1).T - 1.0)
        return corners, float(np.prod(2.0 * half))
    return points[hull.vertices], float(hull.volume)


def _crossings(a: Array, b: Array, axis: int, at: float) -> Array:
    """Where edges from `a` to `b` (n, 3) cross a plane."""
    below, above = a[:, axis] - at, b[:, axis] - at
    crossing = below * above < 0.0
    share = (below[crossing] / (below[crossing] - above[crossing]))[:, None]
    points = a[crossing] + share * (b[crossing] - a[crossing])
    points[:, axis] = at
    return points


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
