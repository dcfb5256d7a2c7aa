# SPDX-License-Identifier: Apache-2.0
"""Which clusters are parts of one thing: the neck of a bottle, the handle of a mug, both handles of scissors.

Convexity cuts things at their notches. Whether two pieces that touch are one thing or two is not in a depth image; what
is known of things in front of a hand is that they have a size, and few parts: more pieces than that are a heap, and
stay pieces. What was joined wrongly shows when it is lifted: a part of it stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from openarm_common.types import Array, Ints

if TYPE_CHECKING:
    from openarm_perception.segmentation.clusters import Cluster

#: Pieces touch where points of them are this near to each other, m, so many of them; two boxes need to be nearer.
_TOUCH, _POINTS, _BOXES = 0.008, 4, 0.004
#: Or where the one lies over the other: so much of it is within the other's outline, seen from above.
_OVER, _ASKED = 0.3, 200
#: Or where the one begins in the image where the other ends, so many pixels on, and no more than this is hidden between
#: them, m: the head of a hammer hides the end of its handle.
_NEXT, _HIDDEN = 3, 0.02
#: A thing has no more parts than this.
_PARTS = 3
#: What is joined is no larger than this, m: things that a hand grasps are long or wide, not both.
_LONG, _WIDE = 0.38, 0.20
#: And has one body: of its parts no two are wider than this, m.
_BODY = 0.095


def joined(
    clusters: Sequence[Cluster],
    label: NDArray[np.uint16],
    pieces: Sequence[int] = (),
    carried: NDArray[np.bool_] | None = None,
) -> Ints:
    """Return the group (n,) of each cluster: the index of its first one.

    Args:
        clusters: Clusters of one image.
        label: (h, w) their numbers 1, 2, … at each pixel, 0: none.
        pieces: Number of pieces of each so far; none: of one.
        carried: (n, n) which carry each other: these are no parts of one thing; None: none do.
    """
    root = np.arange(len(clusters))
    clouds = [one.points.astype(np.float64) for one in clusters]
    next_to = _next_to(label, len(clusters))
    pairs: list[tuple[float, int, int]] = []
    for i, a in enumerate(clusters):
        for j, b in enumerate(clusters[:i]):
            if carried is not None and carried[i, j]:
                continue
            gap, unknown = _gap(clouds[i], clouds[j]), "unknown" in (a.shape.kind, b.shape.kind)
            if unknown and next_to[i, j] and _nearest(clouds[i][:, :2], clouds[j][:, :2], _HIDDEN) <= _HIDDEN:
                gap = min(gap, _TOUCH)
            if gap <= (_TOUCH if unknown else _BOXES):
                pairs.append((gap, i, j))
    body = [_extent(cloud)[1] > _BODY for cloud in clouds]
    heap = _heaps(pieces or (1,) * len(clusters), [(i, j) for _, i, j in pairs])
    for _, i, j in sorted(pairs):
        if heap[i]:
            continue
        one, other = root[i], root[j]
        both = np.flatnonzero((root == one) | (root == other))
        if one != other and sum(body[k] for k in both) < 2 and _fits(np.concatenate([clouds[k] for k in both])):
            root[both] = min(one, other)
    return root


def _heaps(pieces: Sequence[int], touching: Sequence[tuple[int, int]]) -> NDArray[np.bool_]:
    """Return which of the clusters (n,) hang together with more pieces than a thing has parts."""
    ends, count = np.array(touching, np.int64).reshape(-1, 2), len(pieces)
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return np.bincount(label, weights=pieces, minlength=1)[label] > _PARTS


def _next_to(label: NDArray[np.uint16], count: int) -> NDArray[np.bool_]:
    """Return which of the things (n, n) begin in the image where others end."""
    meet = np.zeros((count + 1, count + 1), np.int64)
    for k in range(1, _NEXT + 1):
        for one, other in ((label[k:], label[:-k]), (label[:, k:], label[:, :-k])):
            differ = (one != other) & (one > 0) & (other > 0)
            np.add.at(meet, (one[differ], other[differ]), 1)
    return (meet + meet.T)[1:, 1:] >= _POINTS


def _gap(a: Array, b: Array) -> float:
    """Return how far apart two clouds (n, 3) are, m; 0 where the one lies over the other."""
    (few, many) = (a, b) if len(a) < len(b) else (b, a)
    nearest = _nearest(few, many, _TOUCH)
    if nearest <= _TOUCH:
        return nearest
    near = few[_within(few, many, _TOUCH)]
    hull = cv2.convexHull((many[:, :2] * 1e3).astype(np.float32))
    asked = near[:: max(1, len(near) // _ASKED)]
    within = [cv2.pointPolygonTest(hull, (1e3 * float(x), 1e3 * float(y)), False) >= 0.0 for x, y, _ in asked]
    return 0.0 if len(near) and np.mean(within) * len(near) >= _OVER * len(few) else np.inf


def _within(few: Array, many: Array, margin: float) -> NDArray[np.bool_]:
    """Return which of few (n, 2 or 3) are over the rectangle about many, and a margin, m."""
    low, high = many[:, :2].min(axis=0) - margin, many[:, :2].max(axis=0) + margin
    return ((few[:, :2] >= low) & (few[:, :2] <= high)).all(axis=1)


def _nearest(few: Array, many: Array, most: float) -> float:
    """Return how far `_POINTS` of few (n, 2 or 3) are from many at most, m; inf where that is much more than `most`."""
    near = few[_within(few, many, most)]
    if len(near) < _POINTS:
        return np.inf
    away, _ = KDTree(many).query(near, distance_upper_bound=2.0 * most)
    return float(np.partition(away, _POINTS - 1)[_POINTS - 1])


def _fits(points: Array) -> bool:
    """Return whether points (n, 3) may be those of one thing, by their extent seen from above."""
    length, width = _extent(points)
    return length <= _LONG and width <= _WIDE


def _extent(points: Array) -> tuple[float, float]:
    """Return length and width of points (n, 3) seen from above, m."""
    _, size, _ = cv2.minAreaRect((points[:, :2] * 1e3).astype(np.float32))
    return 1e-3 * max(size), 1e-3 * min(size)
