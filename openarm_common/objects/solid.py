# SPDX-License-Identifier: Apache-2.0
"""Convex parts and what follows from them: volume, centre of mass, lines through them. m, in one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from openarm_common import se3
from openarm_common.types import Array, Ints

#: Less is flat: m3.
_FLAT = 1e-10


@dataclass(frozen=True, eq=False)
class Part:
    """A convex polyhedron.

    Attributes:
        vertices: (n, 3) corners, m.
        triangles: (m, 3) indices of corners, counter-clockwise from outside.
    """

    vertices: Array
    triangles: Ints

    @cached_property
    def _moments(self) -> tuple[float, Array]:
        return moments(self.vertices, self.triangles)

    @property
    def volume(self) -> float:
        """Of the part, m3."""
        return self._moments[0]

    @property
    def centre(self) -> Array:
        """Centre of the volume (3,), m."""
        return self._moments[1]

    @cached_property
    def planes(self) -> Array:
        """Faces (k, 4): outward unit normal and offset, n·p + d <= 0 inside; those in one plane once."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        found = np.c_[normal, -np.einsum("ij,ij->i", normal, a)]
        return found[np.unique(np.round(found, 6), axis=0, return_index=True)[1]]

    def moved(self, T: Array) -> Part:
        """Return the part in another frame, by T (4, 4)."""
        return Part(se3.apply(T, self.vertices), self.triangles)


def moments(vertices: Array, triangles: Ints) -> tuple[float, Array]:
    """Volume (m3) and its centre (3,) of a closed mesh that is turned outwards; negative when inwards.

    Args:
        vertices: (n, 3) m.
        triangles: (m, 3) indices.
    """
    middle = vertices.mean(axis=0)
    a, b, c = (vertices[triangles[:, k]] - middle for k in range(3))
    sixfold = np.einsum("ij,ij->i", a, np.cross(b, c))
    volume = float(sixfold.sum()) / 6.0
    if volume == 0.0:
        return 0.0, middle
    return volume, middle + (sixfold[:, None] * (a + b + c)).sum(axis=0) / (24.0 * volume)


def hull_part(points: Array) -> Part | None:
    """Return the convex hull of points (n, 3), m; None where it is flat."""
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    if hull.volume < _FLAT:
        return None
    index = np.full(len(points), -1, np.int64)
    index[hull.vertices] = np.arange(len(hull.vertices))
    triangles = index[hull.simplices]
    vertices = np.ascontiguousarray(points[hull.vertices], np.float64)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    triangles[inward] = triangles[inward][:, ::-1]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return Part(vertices, np.ascontiguousarray(triangles[area > 1e-12], np.int64))


def mass_centre(parts: Sequence[Part]) -> Array:
    """Return the centre of mass (3,) of parts of even density, m; where parts overlap, it counts twice."""
    volumes = np.array([part.volume for part in parts])
    return volumes @ np.array([part.centre for part in parts]) / volumes.sum()


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where parallel lines are inside a part.

    Attributes:
        ends: (n, 2) from and to, m along the direction; from > to: not at all.
        normals: (n, 2, 3) outward, of the faces there.
    """

    ends: Array
    normals: Array


def crossings(part: Part, points: Array, direction: Array) -> Crossings:
    """Return where lines cross a part.

    Args:
        part: Part, in the frame of the lines.
        points: (n, 3) of the lines, m.
        direction: (3,) unit, of all lines.
    """
    normal, offset = part.planes[:, :3], part.planes[:, 3]
    rate = normal @ direction
    left = -(points @ normal.T + offset)  # (n, planes) room before each plane
    parallel = np.abs(rate) < 1e-12
    with np.errstate(divide="ignore", invalid="ignore"):
        at = left / rate
    low = np.where((rate < 0.0) & ~parallel, at, -np.inf)
    high = np.where((rate > 0.0) & ~parallel, at, np.inf)
    outside = (left[:, parallel] < 0.0).any(axis=1)
    first, last = low.argmax(axis=1), high.argmin(axis=1)
    row = np.arange(len(points))
    ends = np.stack([low[row, first], high[row, last]], axis=1)
    ends[outside] = np.inf, -np.inf
    return Crossings(ends, np.stack([normal[first], normal[last]], axis=1))
