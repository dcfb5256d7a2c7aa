# SPDX-License-Identifier: Apache-2.0
"""Clusters of several cameras that look at one table: which of them are the same thing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from openarm_common.types import Array
from openarm_perception.geometry.depth import Points
from openarm_perception.segmentation.clusters import Cluster

#: Surfaces nearer than this are the same one, m: noise and the error of two mounts.
SAME = 0.008
#: Two views of a thing share this of the smaller at least; what lies in a thing to the larger share is part of it.
_SHARED, _INSIDE = 0.2, 0.6
#: Points of a cluster that are compared.
_ASKED = 2000


@dataclass(frozen=True, eq=False)
class Thing:
    """A thing that one or more cameras see.

    Attributes:
        points: (n, 3) float32 of all of them, base frame, m.
        seen: View and `id` of its clusters.
    """

    points: Points
    seen: tuple[tuple[int, int], ...]


def merge_views(views: Sequence[Sequence[Cluster]], same: float = SAME) -> tuple[Thing, ...]:
    """Merge clusters that overlap in the base frame.

    A cluster of one view is the same as at most one of another: two things that the first camera sees apart stay apart,
    even if another sees them as one. Pieces that lie mostly in a thing become part of it.

    Args:
        views: Clusters of each camera, points in the base frame.
        same: Surfaces nearer than this are the same one, m.

    Returns:
        Things; those of the first view first.
    """
    things: list[Thing] = []
    for number, clusters in enumerate(views):
        if not clusters:
            continue
        shared = _shares(things, clusters, same)
        rows, columns = linear_sum_assignment(-shared) if things else ((), ())
        partner = {int(c): int(r) for r, c in zip(rows, columns, strict=True) if shared[r, c] >= _SHARED}
        for c, cluster in enumerate(clusters):
            best = partner.get(c)
            if best is None and shared.size:
                nearest = int(shared[:, c].argmax())
                best = nearest if _near(cluster.points, things[nearest].points, same) >= _INSIDE else None
            if best is None:
                things.append(Thing(cluster.points, ((number, cluster.id),)))
            else:
                one = things[best]
                joined = np.concatenate([one.points, cluster.points])
                things[best] = Thing(joined, (*one.seen, (number, cluster.id)))
    return tuple(things)


def _shares(things: Sequence[Thing], clusters: Sequence[Cluster], same: float) -> Array:
    """Return the share (things, clusters) of the smaller of each pair that lies on the other."""
    out = np.zeros((len(things), len(clusters)))
    for r, thing in enumerate(things):
        low, high = thing.points.min(axis=0) - same, thing.points.max(axis=0) + same
        for c, cluster in enumerate(clusters):
            if (cluster.points.max(axis=0) >= low).all() and (cluster.points.min(axis=0) <= high).all():
                out[r, c] = max(_near(thing.points, cluster.points, same), _near(cluster.points, thing.points, same))
    return out


def _near(points: Points, others: Points, same: float) -> float:
    """Return the share of points (n, 3) that have one of others (m, 3) within a distance, m."""
    asked = points[:: max(1, len(points) // _ASKED)]
    distance, _ = cKDTree(others[:: max(1, len(others) // (4 * _ASKED))]).query(asked, distance_upper_bound=same)
    return float(np.mean(np.isfinite(distance)))
