# SPDX-License-Identifier: Apache-2.0
"""A mesh as few convex hulls. m."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from openarm_common import se3
from openarm_common.types import Array

#: A further part must save this share of the volume of the hull about all of a mesh.
_SAVED = 0.004
#: Slabs that a mesh may be cut into, before neighbours are put together again.
_SLABS = 16
#: What has no volume is given this thickness, m.
_THIN = 1e-3


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
        corners = 0.5 * (low + high) + half * se3.BOX_CORNERS
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
