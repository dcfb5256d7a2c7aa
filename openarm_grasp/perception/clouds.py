# SPDX-License-Identifier: Apache-2.0
"""From labelled clouds to what verdicts on objects read. Base frame, m."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.types import Array, Floats
from openarm_grasp.perception.detections import NEXT_TO, Frame, Sighting
from openarm_grasp.perception.sightings import divided, in_box, joined, object_points, points_around
from openarm_world.shares import FREE, HIDDEN, SEEN, look, view_of

#: What hangs in a hand over the place of a thing is this near to it, seen from above, m.
_OVER = 0.025
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
#: What came next to an object has more than this share of its points: fewer are flying pixels.
_CAME = 0.1
#: So many points of what hangs in a hand may be of the edge of the hand, %.
_OF_HAND = 15.0
#: Fewer points are no cluster.
_LEAST_POINTS = 30


def shown_at(frame: Frame, points: Array) -> tuple[Detection | None, Array]:
    """Return the detection that most of what is seen at points (n, 3) belongs to, and its points; none where none."""
    if frame.cloud is None:
        return None, np.empty((0, 3))
    there = frame.cloud.labels[_away(frame.cloud.points, points) < _PART]
    number = int(np.bincount(there).argmax()) if len(there) else 0
    if not number:
        return None, np.empty((0, 3))
    return frame.detections[number - 1], frame.cloud.points[frame.cloud.labels == number].astype(np.float64)


def risen_points(frames: Sequence[Frame], sighting: Sighting, rise: float) -> Array:
    """Return the points (n, 3) of what the newest image shows over the place of a thing, higher than it stood.

    What is seen where something was before is left out: what stood around it may be higher, too, and what was taken for
    a part of it may have stayed. A prism is one body, and known down to its foot.

    Args:
        frames: Frames in the base frame.
        sighting: The thing as it stood.
        rise: Its upper end is at least this much higher, of a prism its lower end, m.
    """
    before, target = object_points(sighting.clouds[-1:]), sighting.target
    if not len(before):
        return before
    place, top, middle = KDTree(before[:, :2]), _top(before), before.mean(axis=0)
    frame = next((frame for frame in reversed(frames) if frame.cloud is not None), None)
    found = [np.empty((0, 3))]
    if frame is not None and frame.cloud is not None:
        for number in range(1, len(frame.detections) + 1):
            points = frame.cloud.points[frame.cloud.labels == number].astype(np.float64)
            if len(points) < _LEAST_POINTS:
                continue
            # of what hangs in a hand an end may be all that is seen; a few points that fly make it no neighbour
            beside = float(np.percentile(place.query(points[:, :2])[0], 2.0))
            low = float(np.percentile(points[:, 2], _OF_HAND if frame.cloud.measured else 0.0))
            risen = low - target.bottom if target.kind else _top(points) - top
            if risen >= rise and beside <= _OVER:
                found.append(points)
    clouds, points = sighting.clouds[-1:], np.concatenate(found)
    points = points[np.linalg.norm(points - middle, axis=1) < _REACH]
    own = np.empty((0, 3)) if target.kind else object_points(clouds)
    return points[_away(points, np.concatenate([own, points_around(clouds)])) > _STOOD]


def lifted(frames: Sequence[Frame], sighting: Sighting, risen: Array, T_now_before: Array, grip: Array) -> Sighting:
    """Return the thing as what has risen as one body: with what came along, and without what has stayed.

    An image does not distinguish things that touch from parts of one thing; a motion does (Katz and Brock,
    "Manipulating articulated objects with interactive perception", ICRA 2008). What the hand hides says nothing. What
    was measured as a prism is one body.

    Args:
        frames: Since the lift, in the base frame.
        sighting: The thing as it stood, and what was around it.
        risen: (n, 3) of `risen_points`.
        T_now_before: (4, 4) how the hand has moved since it took hold.
        grip: (3,) middle between the pads when it did.
    """
    cloud = next((frame.cloud for frame in reversed(frames) if frame.cloud is not None), None)
    if cloud is None or not len(cloud.points) or sighting.target.kind:
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


def _top(points: Array) -> float:
    """Height of the upper end of points (n, 3), m; a few that fly do not make it."""
    return float(np.percentile(points[:, 2], 98.0))


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


def came_next_to(now: Array, frame: Frame, before: Sighting) -> bool:
    """Whether something is seen next to an object that was not there before.

    Args:
        now: (n, 3) points of the object in the frame.
        frame: Taken after the place.
        before: The object and what was around it; what that image saw through was free.
    """
    if frame.cloud is None:
        return False
    others = frame.cloud.points[frame.cloud.labels > 0].astype(np.float64)
    away = _away(others, now)
    near = others[(away > 0.0) & (away < NEXT_TO)]
    old = before.clouds[0]
    came = look(near, np.eye(4), view_of(old.points, old.camera)) == FREE
    return bool(np.count_nonzero(came) > _CAME * len(now))
