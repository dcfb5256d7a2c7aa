# SPDX-License-Identifier: Apache-2.0
"""Pieces of objects: solids of revolution, shells, tubes along a path, prisms; each with its convex parts.

Lengths in m, z up. A piece is closed and turned outwards; pieces of one object may reach into each other.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from openarm_common import se3
from openarm_common.objects.solid import hull_part, moments
from openarm_common.types import Array, Ints

Rgb = tuple[float, float, float]
Profile = Sequence[tuple[float, float]]

#: Facets around what is round, and of shells, whose every facet is a convex part.
_AROUND, _STAVES = 24, 16
#: Stretches of a piece become one part where their hull has no more than this share too much.
_HOLLOW = 0.01


@dataclass(frozen=True, eq=False)
class Piece:
    """A closed piece.

    Attributes:
        vertices: (n, 3) m.
        triangles: (m, 3) indices.
        parts: Points (k, 3) of each convex part.
        color: Red, green, blue, 0 to 1.
        bands: Colours of a label from bottom to top; empty: plain.
    """

    vertices: Array
    triangles: Ints
    parts: tuple[Array, ...]
    color: Rgb
    bands: tuple[Rgb, ...] = ()

    def moved(self, R: Array | None = None, p: ArrayLike = (0.0, 0.0, 0.0)) -> Piece:
        """Return the piece turned by R (3, 3), then moved by p (3,), m."""
        T = se3.make(R, p)
        parts = tuple(se3.apply(T, part) for part in self.parts)
        return Piece(se3.apply(T, self.vertices), self.triangles, parts, self.color, self.bands)

    def bent(self, move: Callable[[Array], Array]) -> Piece:
        """Return the piece with its points (n, 3) moved by a smooth function that keeps its parts convex."""
        parts = tuple(move(part) for part in self.parts)
        return Piece(move(self.vertices), self.triangles, parts, self.color, self.bands)

    def labelled(self, *bands: Rgb) -> Piece:
        """Return the piece with a label of colours from bottom to top."""
        return Piece(self.vertices, self.triangles, self.parts, self.color, bands)


def hull(points: ArrayLike, color: Rgb) -> Piece:
    """Return the convex hull of points (n, 3)."""
    part = hull_part(np.asarray(points, np.float64))
    if part is None:
        raise ValueError("points of a hull are flat")
    return Piece(part.vertices, part.triangles, (part.vertices,), color)


def box(size: Sequence[float], color: Rgb, p: ArrayLike = (0.0, 0.0, 0.0), bevel: float = 0.0) -> Piece:
    """Return a box of edges (3,) about p, its edges cut by `bevel`, m."""
    half = 0.5 * np.array(size)
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    if bevel:
        corners = [signs * (half - bevel * (np.arange(3) != k)) for k in range(3)]
        return hull(np.concatenate(corners) + np.asarray(p), color)
    return hull(signs * half + np.asarray(p), color)


def ellipsoid(half: Sequence[float], color: Rgb, p: ArrayLike = (0.0, 0.0, 0.0), rows: int = 10) -> Piece:
    """Return an ellipsoid of half axes (3,) about p."""
    turn = np.linspace(-math.pi / 2.0, math.pi / 2.0, rows + 1)
    piece = lathe([(math.cos(t), math.sin(t)) for t in turn], color)
    return piece.bent(lambda points: points * np.array(half) + np.asarray(p))


def lathe(profile: Profile, color: Rgb, around: int = _AROUND) -> Piece:
    """Return a solid of revolution about z; `profile` is (radius, z) from bottom to top."""
    rings = [_ring(max(radius, 0.0), z, around) for radius, z in profile]
    return _skinned(rings, color)


def shell(outer: Profile, inner: Profile, color: Rgb, staves: int = _STAVES) -> Piece:
    """Return what is hollow and open at the top: a floor, and a wall between two profiles.

    Args:
        outer: (radius, z) from the bottom to the rim.
        inner: The same of the inside, with as many rows; the first is the floor. A first radius of outer and inner at
            one height makes a tube, without a floor.
        color: Colour of all.
        staves: Convex parts of a row of the wall.
    """
    floor = inner[0][1] > outer[0][1] + 1e-6
    outside = [_ring(r, z, 2 * staves) for r, z in outer]
    inside = [_ring(r, z, 2 * staves) for r, z in inner]
    parts: list[Array] = []
    for k in range(len(outer) - 1):
        for first in range(0, 2 * staves, 2):
            turn = [(first + j) % (2 * staves) for j in range(3)]
            # the inside is a chord: the part is convex, and a little thicker in its middle
            ends = [turn[0], turn[2]]
            rows = (outside[k][turn], outside[k + 1][turn], inside[k][ends], inside[k + 1][ends])
            parts.append(np.concatenate(rows))
    if floor:
        parts.append(np.concatenate([outside[0], inside[0] * (1.0, 1.0, 0.0) + (0.0, 0.0, inner[0][1])]))
    rings = [*outside, *inside[::-1]]
    faces = [_band(k, k + 1, 2 * staves) for k in range(len(rings) - 1)]
    vertices = np.concatenate(rings)
    if floor:
        caps, middles = _caps(rings, 2 * staves)
        return Piece(np.concatenate([vertices, middles]), np.concatenate([*faces, *caps]), tuple(parts), color)
    faces.append(_band(len(rings) - 1, 0, 2 * staves))
    return Piece(vertices, np.concatenate(faces), tuple(parts), color)


def tube(
    path: ArrayLike,
    radii: ArrayLike,
    color: Rgb,
    *,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    closed: bool = False,
    around: int = 12,
) -> Piece:
    """Return a tube along a path.

    Args:
        path: (n, 3) m.
        radii: (n,), or (n, 2) along `up` and across it; or one for all.
        color: Colour of all.
        up: A direction that is never that of the path.
        closed: The last point is joined to the first.
        around: Facets.
    """
    points = np.asarray(path, np.float64)
    n = len(points)
    sizes = np.asarray(radii, np.float64)
    sizes = np.broadcast_to(sizes.reshape(-1, 1) if sizes.ndim < 2 else sizes, (n, 2))
    ahead = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0) if closed else np.gradient(points, axis=0)
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    across = np.cross(ahead, np.asarray(up, np.float64))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upward = np.cross(across, ahead)
    turn = np.arange(around) * (math.tau / around)
    rings = [
        points[k] + sizes[k, 0] * np.cos(turn)[:, None] * upward[k] + sizes[k, 1] * np.sin(turn)[:, None] * -across[k]
        for k in range(n)
    ]
    return _skinned(rings, color, closed=closed)


def prism(outlines: Sequence[ArrayLike], low: float, high: float, color: Rgb) -> list[Piece]:
    """Return upright prisms of convex outlines (n, 2), each a piece, from one height to another, m."""
    pieces: list[Piece] = []
    for outline in outlines:
        flat = np.asarray(outline, np.float64)
        pieces.append(hull(np.concatenate([np.c_[flat, np.full(len(flat), z)] for z in (low, high)]), color))
    return pieces


def arc(radius: float, start: float, end: float, count: int, centre: Sequence[float] = (0.0, 0.0)) -> Array:
    """Return points (count, 2) of an arc from one angle to another, rad."""
    turn = np.linspace(start, end, count)
    return radius * np.stack([np.cos(turn), np.sin(turn)], axis=1) + np.asarray(centre)


def _ring(radius: float, z: float, around: int) -> Array:
    turn = np.arange(around) * (math.tau / around)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(around, z)], axis=1)


def _skinned(rings: Sequence[Array], color: Rgb, *, closed: bool = False) -> Piece:
    """Return the piece through rings of as many points, capped unless closed.

    Neighbours that are convex together are one part.
    """
    around, n = len(rings[0]), len(rings)
    faces = [_band(k, (k + 1) % n, around) for k in range(n if closed else n - 1)]
    vertices = np.concatenate(rings)
    if not closed:
        caps, middles = _caps(rings, around)
        faces += caps
        vertices = np.concatenate([vertices, middles])
    triangles = np.concatenate(faces)
    if moments(vertices, triangles)[0] < 0.0:
        triangles = triangles[:, ::-1]
    order = [*range(n), 0] if closed else list(range(n))
    return Piece(vertices, triangles, tuple(_stretches([rings[k] for k in order])), color)


def _stretches(rings: Sequence[Array]) -> list[Array]:
    """Return points of convex parts: rings in a row, as long as their hull has little more than they fill."""

    def filled(some: Sequence[Array]) -> float:
        part = hull_part(np.concatenate(some))
        return part.volume if part is not None else 0.0

    parts: list[list[Array]] = []
    volume = 0.0
    for ring, following in itertools.pairwise(rings):
        own = filled([ring, following])
        if parts and filled([*parts[-1], following]) <= (1.0 + _HOLLOW) * (volume + own):
            parts[-1].append(following)
            volume += own
        else:
            parts.append([ring, following])
            volume = own
    return [np.concatenate(part) for part in parts]


def _band(low: int, high: int, around: int) -> Ints:
    """Return the triangles between two rings that are numbered in a row."""
    k = np.arange(around)
    a, b = low * around + k, low * around + (k + 1) % around
    c, d = high * around + k, high * around + (k + 1) % around
    return np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])


def _caps(rings: Sequence[Array], around: int) -> tuple[list[Ints], Array]:
    """Return the triangles that close the first and the last ring, and the middles (2, 3) that they have."""
    k, n = np.arange(around), len(rings)
    first, last = n * around, n * around + 1
    low = np.stack([np.full(around, first), (k + 1) % around, k], axis=1)
    top = (n - 1) * around
    high = np.stack([np.full(around, last), top + k, top + (k + 1) % around], axis=1)
    return [low, high], np.stack([rings[0].mean(axis=0), rings[-1].mean(axis=0)])
