# SPDX-License-Identifier: Apache-2.0
"""Points of an object and of what is around it in a sighting, and the object regrouped or moved. Base frame, m."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.detection import Detection, distances_from
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.types import Array, Floats
from openarm_grasp.perception.detections import Sighting

#: Edge of a column of points, m.
COLUMN = 0.005
#: Points so far out of the box of a thing are its own, m.
_OUT = 0.004
#: What is this near to the edges of something, or to what stands there, says nothing of its surface, m; nor do fewer
#: columns.
RIM, _FEW = 0.012, 20
#: It is level where no more than this share of it is so much higher or lower, m.
_LEVEL, _UNEVEN = 0.008, 0.25


def object_points(clouds: Sequence[LabelledCloud]) -> Array:
    """Return the points (n, 3) of the object in clouds whose points labelled 1 are its."""
    mine = (cloud.points[cloud.labels == 1].astype(np.float64) for cloud in clouds)
    return np.concatenate([np.empty((0, 3)), *mine])


def first_points(sighting: Sighting) -> Array:
    """Return the points (n, 3) of the object in the oldest of its images: all are of its first camera.

    Pixels at the edge of a colour show what is behind it: of a prism the points in its box count.
    """
    points, target = object_points(sighting.clouds[:1]), sighting.target
    return points[in_box(points, target)] if target.kind and target.measured else points


def points_around(clouds: Sequence[LabelledCloud]) -> Array:
    """Points (n, 3) of what stands around an object in clouds whose points labelled 1 are its."""
    return np.concatenate([np.empty((0, 3)), *(cloud.points[cloud.labels > 1].astype(np.float64) for cloud in clouds)])


def in_box(points: Array | Floats, one: Detection) -> NDArray[np.bool_]:
    """Which of the points (n, 3) are in the box about a thing."""
    local = se3.apply(se3.inverse(one.T_base_object), points.astype(np.float64))
    return np.asarray((np.abs(local) <= 0.5 * one.size + _OUT).all(axis=1), dtype=np.bool_)


def tops(points: Array) -> Array:
    """Highest point (n, 3) of each column of points, at its middle."""
    cells = np.floor(points[:, :2] / COLUMN).astype(np.int64)
    order = np.lexsort((cells[:, 1], cells[:, 0]))
    cells = cells[order]
    first = np.flatnonzero(np.diff(cells, axis=0, prepend=cells[:1] - 1).any(axis=1))
    high = np.maximum.reduceat(points[order, 2], first)
    return np.column_stack([(cells[first] + 0.5) * COLUMN, high]).astype(np.float64)


def surface_of(one: Detection, found: Sighting) -> float:
    """Height at which things stand on something, or in it, m: where it is level within its rim, else its top.

    Args:
        one: It; of `found.others`.
        found: Observed objects; without points, its top.
    """
    points = points_around(found.clouds[-1:])
    points = tops(points[in_box(points, one)])
    local = (points - one.p_base) @ one.T_base_object[:3, :3]
    own = (np.abs(local[:, :2]) <= 0.5 * one.size[:2] - RIM).all(axis=1)
    for other in found.others:
        if other is not one and other.bottom >= one.bottom + _OUT:
            own &= distances_from(other, points[:, :2]) > RIM
    if np.count_nonzero(own) < _FEW:
        return one.top
    floor = float(np.median(points[own, 2]))
    return floor if np.mean(np.abs(points[own, 2] - floor) > _LEVEL) <= _UNEVEN else one.top


def joined(found: Sighting, parts: Sequence[Detection]) -> Sighting:
    """An object together with what was taken for others, and is a part of it.

    Args:
        found: The object and what is around it.
        parts: Parts, of `found.others`.
    """
    clouds: list[LabelledCloud] = []
    for cloud in found.clouds:
        part = np.any([in_box(cloud.points, one) for one in parts], axis=0) & (cloud.labels > 1)
        clouds.append(replace(cloud, labels=np.where(part, 1, cloud.labels).astype(np.uint32)))
    whole = (found.target, *parts)
    target = _about(found.target, object_points(clouds), whole)
    others = tuple(one for one in found.others if all(one is not part for part in parts))
    return replace(found, target=target, others=others, clouds=tuple(clouds))


def divided(found: Sighting, left: NDArray[np.bool_]) -> Sighting:
    """An object without what was taken for a part of it, and is another thing.

    Args:
        found: The object and what is around it.
        left: (n,) which of its points, as of `object_points`, are the other's.
    """
    clouds: list[LabelledCloud] = []
    begin = 0
    for cloud in found.clouds:
        mine = np.flatnonzero(cloud.labels == 1)
        labels = cloud.labels.copy()
        labels[mine[left[begin : begin + len(mine)]]] = 2
        begin += len(mine)
        if (labels == 1).any():  # what of it this one showed may all have been the other
            clouds.append(replace(cloud, labels=labels))
    points, whole = object_points(found.clouds), (found.target,)
    target, rest = (_about(found.target, part, whole) for part in (points[~left], points[left]))
    return replace(found, target=target, others=(*found.others, replace(rest, id="")), clouds=tuple(clouds))


def _about(like: Detection, points: Array, whole: Sequence[Detection]) -> Detection:
    """A detection of points (n, 3), turned as another one, that stands as deep as what it was seen as."""
    R = like.T_base_object[:3, :3]
    local = points @ R
    low, high = local.min(axis=0), local.max(axis=0)
    low[2] = min(one.bottom for one in whole)
    if len(whole) > 1:
        high[2] = max(one.top for one in whole)
    T = se3.make(R, R @ (0.5 * (low + high)))
    measured = all(one.measured for one in whole)
    return replace(like, T_base_object=T, size=high - low, kind="", round=False, measured=measured)


def standing_at(target: Detection, foot: Sequence[float] | Array, turn: float = 0.0) -> Detection:
    """The object as it would be observed at a footprint centre (3,), or (2,) as high as it stands.

    It is turned by `turn` about the vertical unless it is round.
    """
    p = np.array([*foot, target.bottom][:3]) + target.p_base - target.foot
    turn = 0.0 if target.round else turn
    return replace(target, T_base_object=se3.make(se3.rot_z(turn) @ target.T_base_object[:3, :3], p))


def seen_at(found: Sighting, foot: Sequence[float] | Array, turn: float = 0.0) -> Sighting:
    """The object with its points as it would be observed elsewhere; as `standing_at`."""
    there = standing_at(found.target, foot, turn)
    T = there.T_base_object @ se3.inverse(found.target.T_base_object)
    clouds: list[LabelledCloud] = []
    for cloud in found.clouds:
        points, mine = cloud.points.copy(), cloud.labels == 1
        points[mine] = se3.apply(T, points[mine].astype(np.float64))
        clouds.append(replace(cloud, points=points))
    return replace(found, target=there, clouds=tuple(clouds))
