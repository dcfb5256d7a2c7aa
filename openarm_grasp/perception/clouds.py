# SPDX-License-Identifier: Apache-2.0
"""From labelled clouds to what verdicts on things of any shape read. Base frame, m."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from openarm_common import se3
from openarm_common.detection import Detection, gap
from openarm_common.types import Array, Floats
from openarm_grasp.evidence.shapes import Cluster
from openarm_grasp.perception.detections import SAME_PLACE, Frame, Sighting, apart
from openarm_grasp.perception.sightings import divided, in_box, joined, object_points, points_around
from openarm_world.shares import HIDDEN, SEEN, look, view_of

#: A place is in view where a point lies this near to it, seen from above, m.
_IN_VIEW = 0.025
#: What is seen this near to what stood there is that, m.
_STOOD = 0.015
#: Nothing that hangs in the hand reaches farther from where it stood, m.
_REACH = 0.35
#: What has risen with a thing is seen this near to where it is then, m; a part is seen so by more than this share.
_PART, _MOST = 0.008, 0.5
#: Cells of that edge that touch are nearer than this, cells.
_NEXT_CELL = 1.8
#: What stayed of a thing is another one where it was this share of it: of less, its neighbours may be seen there.
_LEFT = 0.15
#: Fewer points are no cluster.
_LEAST_POINTS = 30


def cluster_of(sighting: Sighting) -> Cluster:
    """Return what the newest image shows of the object.

    Raises:
        OpenArmError: NOTHING_DETECTED, when it has no points.
    """
    points = object_points(sighting.clouds[-1:])
    return Cluster.of(points, cut=not sighting.target.measured)


def nearest_to(frames: Sequence[Frame], p_base: Array) -> tuple[Detection | None, Array]:
    """Return the detection nearest to a place in the newest frame, and its points (n, 3); none without a cloud.

    Args:
        frames: In the base frame.
        p_base: (2,) or (3,) about the middle of it.
    """
    frame = next((frame for frame in reversed(frames) if frame.cloud is not None), None)
    if frame is None or frame.cloud is None or not frame.detections:
        return None, np.empty((0, 3))
    away = [float(np.linalg.norm((d.p_base - p_base)[:2])) for d in frame.detections]
    number = int(np.argmin(away))
    if away[number] >= SAME_PLACE:
        return None, np.empty((0, 3))
    points = frame.cloud.points[frame.cloud.labels == number + 1].astype(np.float64)
    return frame.detections[number], points


def clusters_of(frame: Frame) -> tuple[Cluster, ...]:
    """Return what an image shows of each thing of which it has points enough; nothing without a cloud."""
    cloud, found = frame.cloud, list[Cluster]()
    if cloud is None:
        return ()
    for number, detection in enumerate(frame.detections, start=1):
        points = cloud.points[cloud.labels == number].astype(np.float64)
        if len(points) >= _LEAST_POINTS:
            found.append(Cluster.of(points, cut=not detection.measured))
    return tuple(found)


def risen_points(frames: Sequence[Frame], sighting: Sighting, rise: float) -> Array:
    """Return the points (n, 3) of what the newest image shows over the place of a thing, higher than it stood.

    What is seen where something was before is left out: what stood around it may be higher, too, and what was taken for
    a part of it may have stayed.

    Args:
        frames: In the base frame.
        sighting: The thing as it stood.
        rise: Its upper end is at least this much higher, m.
    """
    before = cluster_of(sighting)
    place = KDTree(object_points(sighting.clouds[-1:])[:, :2])
    frame = next((frame for frame in reversed(frames) if frame.cloud is not None), None)
    found = [np.empty((0, 3))]
    if frame is not None and frame.cloud is not None:
        for number in range(1, len(frame.detections) + 1):
            points = frame.cloud.points[frame.cloud.labels == number].astype(np.float64)
            if len(points) < _LEAST_POINTS:
                continue
            # of what hangs in a hand an end may be all that is seen; a few points that fly make it no neighbour
            beside = float(np.percentile(place.query(points[:, :2])[0], 2.0))
            if Cluster.of(points).top - before.top >= rise and beside <= _IN_VIEW:
                found.append(points)
    clouds, points = sighting.clouds[-1:], np.concatenate(found)
    points = points[np.linalg.norm(points - before.centroid, axis=1) < _REACH]
    off, _ = KDTree(np.concatenate([object_points(clouds), points_around(clouds)])).query(points)
    return points[off > _STOOD]


def lifted(frames: Sequence[Frame], sighting: Sighting, risen: Array, T_now_before: Array, grip: Array) -> Sighting:
    """Return the thing as what has risen as one body: with what came along, and without what has stayed.

    An image does not distinguish things that touch from parts of one thing; a motion does (Katz and Brock,
    "Manipulating articulated objects with interactive perception", ICRA 2008). What the hand hides says nothing.

    Args:
        frames: Since the lift, in the base frame.
        sighting: The thing as it stood, and what was around it.
        risen: (n, 3) of `risen_points`.
        T_now_before: (4, 4) how the hand has moved since it took hold.
        grip: (3,) middle between the pads when it did.
    """
    cloud = next((frame.cloud for frame in reversed(frames) if frame.cloud is not None), None)
    if cloud is None or not len(cloud.points):
        return sighting
    standing = cloud.points[cloud.labels > 0]
    standing = standing[_away(standing, risen) > _PART]
    view = view_of(cloud.points, cloud.camera)

    def rose(points: Array) -> NDArray[np.int8]:
        return says(se3.apply(T_now_before, points), risen)

    def stays(points: Array) -> NDArray[np.int8]:
        return says(points, standing)

    def says(points: Array, seen: Array | Floats) -> NDArray[np.int8]:
        """Whether points (n, 3) are among those that are seen (1), seen through (-1), or neither (0)."""
        free = np.minimum(look(points, np.eye(4), view), HIDDEN)
        return np.where(_away(points, seen) < _PART, SEEN, free)

    around = points_around(sighting.clouds[-1:])
    parts = [one for one in sighting.others if _is_part(around[in_box(around, one)], rose, stays)]
    whole = joined(sighting, parts) if parts else sighting
    own = object_points(whole.clouds)
    up, down = rose(own) > 0, stays(own)
    left = ~up & (down > 0)
    gone = up | (down < 0)
    if np.count_nonzero(left) < max(_LEAST_POINTS, _LEFT * len(own)) or np.count_nonzero(gone) < _LEAST_POINTS:
        return whole
    known = left | gone  # what is hidden belongs to what is nearest to it
    left[~known] = left[known][KDTree(own[known]).query(own[~known])[1]]
    # and what was pushed a little is free at its border, too
    left[~left] = ~_in_one_piece(own[~left], grip)
    return divided(whole, left)


def _away(points: Array | Floats, others: Array | Floats) -> Array:
    """How far (n,) points (n, 3) are from the nearest of others (m, 3), m."""
    return np.full(len(points), np.inf) if not len(others) else np.asarray(KDTree(others).query(points)[0])


def _in_one_piece(points: Array, start: Array) -> NDArray[np.bool_]:
    """Which of the points (n, 3) are in one piece with that which is nearest to `start`."""
    cells, cell = np.unique(np.floor(points / _PART).astype(np.int64), axis=0, return_inverse=True)
    pairs = KDTree(cells).query_pairs(_NEXT_CELL, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    _, piece = connected_components(graph, directed=False)
    piece = piece[cell.ravel()]
    return np.asarray(piece == piece[np.linalg.norm(points - start, axis=1).argmin()])


def _is_part(
    points: Array, rose: Callable[[Array], NDArray[np.int8]], stays: Callable[[Array], NDArray[np.int8]]
) -> bool:
    """Whether most of the points (n, 3) of something that can be seen have risen, and do not lie where they lay."""
    if len(points) < _LEAST_POINTS:
        return False
    up, down = rose(points), stays(points)
    seen, there = np.count_nonzero(up), np.count_nonzero(up > 0)
    stayed = np.count_nonzero(down > 0)
    return bool(there >= _LEAST_POINTS // 2 and there > _MOST * seen and stayed < _MOST * len(points))


def came_next_to(now: Detection, before: Sequence[Detection], frames: Sequence[Frame], reach: float) -> bool:
    """Whether something is seen next to a thing that was not there before.

    Args:
        now: The thing, as a frame shows it.
        before: What was seen around before.
        frames: Of which one has it.
        reach: What is this near to it is next to it, m.
    """
    frame = next(frame for frame in reversed(frames) if any(d is now for d in frame.detections))
    near = (d for d in frame.detections if d is not now and gap(d, now) < reach)
    return any(all(apart(d, other) > SAME_PLACE for other in before) for d in near)
