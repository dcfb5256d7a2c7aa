# SPDX-License-Identifier: Apache-2.0
"""From labelled clouds to what verdicts on things of any shape read. Base frame, m."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from openarm_common import se3
from openarm_common.detection import Detection, gap
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.types import Array
from openarm_grasp.evidence.shapes import Cluster, ClusterFrame
from openarm_grasp.perception.detections import (
    NEXT_TO,
    SAME_PLACE,
    Frame,
    Sighting,
    apart,
    in_box,
    object_points,
    points_around,
)

#: A place is in view where a point lies this near to it, seen from above, m.
_IN_VIEW = 0.025
#: What is seen this near to what stood there is that, and what is seen this near to its middle may be, m.
_STOOD, _STANDS = 0.015, 0.025
#: What has risen with a thing is seen this near to where it is then, m; a part is seen so by more than this share.
_PART, _MOST = 0.008, 0.5
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


def cluster_frames(frames: Sequence[Frame], place: Array) -> tuple[ClusterFrame, ...]:
    """Return the clusters of frames; those without a cloud are left out.

    Args:
        frames: In the base frame.
        place: (2,) or (3,) the place that is asked about.
    """
    return tuple(_clusters(frame, frame.cloud, place) for frame in frames if frame.cloud is not None)


def risen_points(frames: Sequence[Frame], sighting: Sighting, rise: float) -> Array:
    """Return the points (n, 3) of what the newest image shows over the place of a thing, higher than it stood.

    What stood around it, and may be higher, too, is left out.

    Args:
        frames: In the base frame.
        sighting: The thing as it stood.
        rise: Its upper end is at least this much higher, m.
    """
    before = cluster_of(sighting)
    frame = next((frame for frame in reversed(frames) if frame.cloud is not None), None)
    found = [np.empty((0, 3))]
    if frame is not None and frame.cloud is not None:
        for number in range(1, len(frame.detections) + 1):
            points = frame.cloud.points[frame.cloud.labels == number].astype(np.float64)
            if len(points) < _LEAST_POINTS:
                continue
            now = Cluster.of(points)
            away = float(np.linalg.norm(now.centroid[:2] - before.centroid[:2]))
            if now.top - before.top >= rise and away <= 0.5 * (now.extent + before.extent):
                found.append(points)
    points, around = np.concatenate(found), points_around(sighting.clouds[-1:])
    if not len(points) or not len(around):
        return points
    off, _ = KDTree(around).query(points)
    return points[off > _STOOD]


def came_along(frames: Sequence[Frame], sighting: Sighting, risen: Array, T_now_before: Array) -> tuple[Detection, ...]:
    """Return what lay next to a thing and has risen with it as one body: it is a part of it.

    An image does not distinguish things that touch from parts of one thing; a motion does (Katz and Brock,
    "Manipulating articulated objects with interactive perception", ICRA 2008).

    Args:
        frames: Since the lift, in the base frame.
        sighting: The thing as it stood, and what was around it.
        risen: (n, 3) of `risen_points`.
        T_now_before: (4, 4) how the hand has moved since it took hold.
    """
    around = points_around(sighting.clouds[-1:])
    clouds = [frame.cloud.points[frame.cloud.labels > 0] for frame in frames[-1:] if frame.cloud is not None]
    if not len(risen) or not clouds:
        return ()
    up, now, found = KDTree(risen), KDTree(clouds[0]), list[Detection]()
    for one in (one for one in sighting.others if gap(one, sighting.target) < NEXT_TO):
        points = around[in_box(around, one)]
        if len(points) < _LEAST_POINTS:
            continue
        rose = float(np.mean(up.query(se3.apply(T_now_before, points))[0] < _PART))
        stays = float(np.mean(now.query(points)[0] < _PART))
        if rose > _MOST and stays < 1.0 - _MOST:
            found.append(one)
    return tuple(found)


def stands(other: Detection, frames: Sequence[Frame]) -> bool:
    """Whether something still stands about where something stood; taken for so, where no cloud says it."""
    clouds = [frame.cloud for frame in frames if frame.cloud is not None]
    points = [cloud.points[cloud.labels > 0] for cloud in clouds]
    near = (np.linalg.norm(each[:, :2] - other.p_base[:2], axis=1) < _STANDS for each in points)
    return not clouds or any(bool(one.any()) for one in near)


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


def _clusters(frame: Frame, cloud: LabelledCloud, place: Array) -> ClusterFrame:
    found: list[Cluster] = []
    for number, detection in enumerate(frame.detections, start=1):
        points = cloud.points[cloud.labels == number].astype(np.float64)
        if len(points) >= _LEAST_POINTS:
            found.append(Cluster.of(points, cut=not detection.measured))
    near = np.linalg.norm(cloud.points[:, :2] - np.asarray(place[:2], np.float32), axis=1) < _IN_VIEW
    return ClusterFrame(frame.t_ns, tuple(found), bool(near.any()))
