# SPDX-License-Identifier: Apache-2.0
"""Convex hulls as the kernels take them: corners, and the edges that join them. m."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from openarm_common.types import Array, Ints


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex hull about the middle of the box that holds it.

    Attributes:
        centre: (3,) middle of that box, in the frame of the points.
        corners: (n, 3) from there.
        triangles: (m, 3) faces, turned outwards.
        rings: Corners that edges lead to, of each corner.
        planes: (m, 4) that touch it along its faces: outward normal, and minus its distance from the centre.
    """

    centre: Array
    corners: Array
    triangles: Ints
    rings: Sequence[Ints]
    planes: Array

    @classmethod
    def of(cls, points: Array) -> Hull:
        """Take the hull of points (n, 3).

        Raises:
            QhullError: when they span no volume.
        """
        found = ConvexHull(points)
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        corners, row = points[found.vertices] - centre, np.full(len(points), -1)
        row[found.vertices] = np.arange(len(corners))
        triangles, normals = row[found.simplices].astype(np.int64), found.equations[:, :3]
        a, b, c = (corners[triangles[:, k]] for k in range(3))
        inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), normals) < 0.0
        triangles[inwards] = triangles[inwards][:, ::-1]
        edges = np.unique(np.concatenate([triangles[:, [i, j]] for i in range(3) for j in range(3) if i != j]), axis=0)
        rings = np.split(edges[:, 1], np.searchsorted(edges[:, 0], np.arange(1, len(corners))))
        planes = np.column_stack([normals, -(normals @ corners.T).max(axis=1)])
        return cls(centre, corners, triangles, rings, planes)

    @property
    def half(self) -> Array:
        """(3,) half edges of the box."""
        return self.corners.max(axis=0)

    def beyond(self, points: Array, distance: float) -> NDArray[np.bool_]:
        """Whether points (n, 3) from the centre are further than a distance from the hull, by one of its faces."""
        return (points @ self.planes[:, :3].T + self.planes[:, 3]).max(axis=1) > distance


def joined_corners(hulls: Sequence[Hull | None]) -> tuple[Array, Ints, Ints, Ints]:
    """Put hulls one after the other; None is a shape without corners.

    Returns:
        Corners (v, 3) of all, some corner of each shape (s,), where the neighbours of each corner begin (v + 1,), and
        the neighbours.
    """
    counts = [0 if hull is None else len(hull.corners) for hull in hulls]
    starts = np.cumsum([0, *counts])
    found = [(hull, int(start)) for hull, start in zip(hulls, starts, strict=False) if hull is not None]
    sizes = [len(ring) for hull, _ in found for ring in hull.rings]
    return (
        np.concatenate([np.empty((0, 3)), *(hull.corners for hull, _ in found)]),
        np.where(np.array(counts, np.int64) > 0, starts[:-1], 0).astype(np.int64),
        np.cumsum([0, *sizes]).astype(np.int64),
        np.concatenate([np.empty(0, np.int64), *(ring + start for hull, start in found for ring in hull.rings)]),
    )
