# SPDX-License-Identifier: Apache-2.0
"""Sides that a solid rests on, how often it comes to rest on each, and the upright box around it there. m, rad.

A solid rolls over the edges of its hull, from face to face, as long as its centre of mass sinks: K. Goldberg et al.,
"Part pose statistics: estimators and experiments", IEEE T-RA 15(5), 1999. The faces that end on one side give its
share by their solid angles about the centre of mass. Facets of what is round are no sides of their own: where the
centre has to rise by less than a little to leave a side, the side is joined to the one that it leaves to (minima of a
surface by persistence).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from openarm_common import se3
from openarm_common.objects.solid import Part, mass_centre
from openarm_common.types import Array, Ints

#: The centre of mass rises by so much at least before a solid leaves a side, m and share of its size; else it rolls.
_BARRIER, _BARRIER_SHARE = 0.0008, 0.01
#: Sides with a smaller share are left out, unless there is no other.
_LEAST_SHARE = 0.02
#: A solid on a side tips over when it leans by less, rad.
_LEAST_LEAN = math.radians(6.0)
#: Share of its area by which a rectangle may be larger than one that an image does not tell from it.
AS_SMALL = 0.03
#: Triangles whose planes differ by less are one face: cosine, m.
_SAME_NORMAL, _SAME_PLANE = math.cos(math.radians(0.3)), 1e-5


@dataclass(frozen=True, eq=False)
class Side:
    """A side that a solid rests on.

    Attributes:
        R: (3, 3) turn of the solid's frame that puts the side down, the shorter edge of its footprint along x.
        share: Share of random drops that end on it, 0 to 1.
        height: Height of the centre of mass above the table, m.
    """

    R: Array
    share: float
    height: float


def resting_sides(parts: Sequence[Part]) -> tuple[Side, ...]:
    """Return the sides of a solid of even density, the one that it most often comes to rest on first.

    Args:
        parts: Convex parts that make up the solid.
    """
    centre = mass_centre(parts)
    points = np.concatenate([part.vertices for part in parts]) - centre
    hull = ConvexHull(points)
    faces, of = _faces(hull)
    heights = np.array([-face.plane[3] for face in faces])
    next_, edges = _neighbours(hull, of, faces, points)
    ends = np.array([_end(k, next_) for k in range(len(faces))])
    ends = _joined(ends, heights, edges, max(_BARRIER, _BARRIER_SHARE * float(np.ptp(points, axis=0).max())))
    weights = np.zeros(len(faces))
    np.add.at(weights, of, [_solid_angle(points[simplex]) for simplex in hull.simplices])
    sides: list[tuple[float, float, int]] = []
    for end in np.unique(ends):
        mine = ends == end
        sides.append((float(weights[mine].sum() / weights.sum()), _lean(faces[end], points, hull, of), int(end)))
    best = max(sides)
    round_ones = {end for _, _, end in sides if np.count_nonzero(ends == end) > 8}
    kept = [s for s in sides if s[0] >= _LEAST_SHARE and (s[1] >= _LEAST_LEAN or s[2] in round_ones)] or [best]
    total = sum(share for share, _, _ in kept)
    kept.sort(key=lambda side: (-round(side[0], 6), side[2]))
    return tuple(
        Side(_down(faces[end].plane[:3], points), share / total, float(heights[end])) for share, _, end in kept
    )


@dataclass(frozen=True, eq=False)
class _Face:
    """A face of the hull: its plane (4,) about the centre of mass, and its triangles."""

    plane: Array
    simplices: list[int]


def _faces(hull: ConvexHull) -> tuple[list[_Face], Ints]:
    """Return triangles of one plane as one face, and the face of each triangle."""
    of = np.full(len(hull.simplices), -1, np.int64)
    faces: list[_Face] = []
    for first in range(len(hull.simplices)):
        if of[first] >= 0:
            continue
        plane, mine, todo = hull.equations[first], list[int](), [first]
        of[first] = len(faces)
        while todo:
            here = todo.pop()
            mine.append(here)
            for other in hull.neighbors[here]:
                near = hull.equations[other]
                same = near[:3] @ plane[:3] > _SAME_NORMAL and abs(near[3] - plane[3]) < _SAME_PLANE
                if of[other] < 0 and same:
                    of[other] = len(faces)
                    todo.append(int(other))
        # planes of slivers are off: that of the largest triangle counts
        best = max(mine, key=lambda k: _area(hull.points[hull.simplices[k]]))
        faces.append(_Face(hull.equations[best], mine))
    return faces, of


def _neighbours(
    hull: ConvexHull, of: Ints, faces: Sequence[_Face], points: Array
) -> tuple[list[int], list[tuple[float, int, int]]]:
    """Return the face that each face rolls to (itself: it rests), and the edges between faces with their heights."""
    rolls = [(0.0, k) for k in range(len(faces))]
    edges: list[tuple[float, int, int]] = []
    for here, simplex in enumerate(hull.simplices):
        for corner, other in enumerate(hull.neighbors[here]):
            a, b = int(of[here]), int(of[other])
            if a == b:
                continue
            p, q = points[np.delete(simplex, corner)]
            edges.append((_distance(p, q), a, b))
            normal = faces[a].plane[:3]
            foot = -faces[a].plane[3] * normal
            outward = np.cross(q - p, normal)
            outward /= max(float(np.linalg.norm(outward)), 1e-15)
            if outward @ (points[simplex[corner]] - p) > 0.0:
                outward = -outward
            over = float(outward @ (foot - p))
            if over > rolls[a][0] + 1e-9:
                rolls[a] = (over, b)
    return [to for _, to in rolls], edges


def _end(start: int, next_: Sequence[int]) -> int:
    """Return the face on which a solid that starts on a face comes to rest."""
    seen: set[int] = set()
    while next_[start] != start and start not in seen:
        seen.add(start)
        start = next_[start]
    return start


def _joined(ends: Ints, heights: Array, edges: Sequence[tuple[float, int, int]], barrier: float) -> Ints:
    """Return ends of faces after sides that are left by a rise of less than `barrier` have joined others."""
    parent = {int(end): int(end) for end in np.unique(ends)}

    def root(end: int) -> int:
        while parent[end] != end:
            end = parent[end]
        return end

    for height, a, b in sorted(edges):
        one, other = root(int(ends[a])), root(int(ends[b]))
        if one == other:
            continue
        high, low = (one, other) if heights[one] > heights[other] else (other, one)
        if height - heights[high] < barrier:
            parent[high] = low
    return np.array([root(int(end)) for end in ends])


def _lean(face: _Face, points: Array, hull: ConvexHull, of: Ints) -> float:
    """Return by how much a solid on a face must lean to tip over its nearest edge, rad; negative: it does."""
    corners = np.unique(hull.simplices[face.simplices])
    mine = of[face.simplices[0]]
    normal, height = face.plane[:3], -face.plane[3]
    least = math.inf
    for k in face.simplices:
        for corner, other in enumerate(hull.neighbors[k]):
            if of[other] == mine:
                continue
            p, q = points[np.delete(hull.simplices[k], corner)]
            outward = np.cross(q - p, normal)
            outward /= max(float(np.linalg.norm(outward)), 1e-15)
            if outward @ (points[corners].mean(axis=0) - p) > 0.0:
                outward = -outward
            least = min(least, float(outward @ (p - height * normal)))
    return math.atan2(least, max(height, 1e-9))


def _distance(p: Array, q: Array) -> float:
    """Return the distance of the origin from the segment p q, m."""
    along = q - p
    share = np.clip(-(p @ along) / max(float(along @ along), 1e-18), 0.0, 1.0)
    return float(np.linalg.norm(p + share * along))


def _area(corners: Array) -> float:
    return float(np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])))


def _solid_angle(corners: Array) -> float:
    """Return the solid angle of a triangle (3, 3) about the origin (A. van Oosterom, J. Strackee, 1983)."""
    a, b, c = corners
    x, y, z = (float(np.linalg.norm(v)) for v in corners)
    below = x * y * z + float(a @ b) * z + float(b @ c) * x + float(c @ a) * y
    return 2.0 * math.atan2(abs(float(a @ np.cross(b, c))), below)


def _down(normal: Array, points: Array) -> Array:
    """Return the turn that points a direction down and puts the shorter edge of the footprint along x."""
    z = -normal / np.linalg.norm(normal)
    x = np.cross((0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (1.0, 0.0, 0.0), z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return se3.rot_z(-least_box_yaw((points @ R.T)[:, :2]))[:3, :3] @ R


def least_box_yaw(points: Array) -> float:
    """Return the direction of the shorter edge of the smallest rectangle about points (n, 2), rad in (-pi/2, pi/2]."""
    angles, low, high = _rectangles(points)
    width, depth = (high - low).T
    best = int(np.argmin(np.round(width * depth, 12)))
    yaw = float(angles[best]) if width[best] <= depth[best] else float(angles[best]) + math.pi / 2.0
    return yaw if yaw <= math.pi / 2.0 else yaw - math.pi


def least_box_middles(points: Array, slack: float = AS_SMALL) -> Array:
    """Return the middles (k, 2) of the rectangles about points (n, 2) that are as small as the smallest, m.

    About a hammer or a pan there are several, centimetres apart, of which an image shows now one, now another. About
    points on a line there is none.

    Args:
        points: m.
        slack: Share by which the area of one may be larger.
    """
    if len(points) < 3 or np.linalg.matrix_rank(points - points[0], tol=1e-6) < 2:
        return np.empty((0, 2))
    angles, low, high = _rectangles(points)
    area = np.prod(high - low, axis=1)
    kept = area <= (1.0 + slack) * area.min()
    (x, y), c, s = 0.5 * (low + high)[kept].T, np.cos(angles[kept]), np.sin(angles[kept])
    return np.stack([c * x - s * y, s * x + c * y], axis=1)


def _rectangles(points: Array) -> tuple[Array, Array, Array]:
    """Return a rectangle about points (n, 2) along each edge of their hull: directions (k,), rad; corners (k, 2)."""
    corners = points[ConvexHull(points).vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    angles = np.unique(np.round(np.arctan2(edges[:, 1], edges[:, 0]) % (math.pi / 2.0), 9))
    c, s = np.cos(angles), np.sin(angles)
    along = np.stack([corners @ np.stack([c, s]), corners @ np.stack([-s, c])], axis=-1)
    return angles, along.min(axis=0), along.max(axis=0)
