# SPDX-License-Identifier: Apache-2.0
"""What stands around an object, as boxes that a plan keeps clear of. Base frame, m.

In a heap boxes about whole things overlap, though the things do not. So what is no prism is as many boxes as its points
need, and no box reaches into what is to be lifted: at first they may touch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from openarm_common import se3
from openarm_common.detection import gap
from openarm_common.types import Array
from openarm_grasp.config import GraspConfig
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.perception.sightings import COLUMN, RIM, in_box, object_points, points_around, surface_of, tops
from openarm_grasp.planning.candidates import UP, Box, PlaceTarget, obstacle_boxes
from openarm_grasp.sampling.slabs import slabs

#: Share of its hull that something without inward corners covers, seen from above.
_FULL = 0.8
#: What stands this near to an object may keep a hand from it, m.
_CLOSE = 0.04
#: A plan keeps so far from obstacles, and what is lifted touches none of them at first, m.
_APART = 0.005
#: Boxes about a thing, and the share of its volume that a further one must save.
_MOST, _SAVED = 20, 0.02
#: Boxes about points are this much smaller on each side: a plan keeps clear of them, and a grasp was found among the
#: points themselves, m.
_NEARER = 0.003
#: What reaches over an object by no more than this slides off it when it is lifted, m.
_OVER = 0.015
#: What is level within its rim, and so much lower there, is hollow, m.
_HOLLOW = 0.01
#: What is put down on something is this near to the top of a box about that, m, which is taken so much lower.
_FACE, _LOWER = 0.012, 0.002
#: Fewer points say nothing of a shape.
_LEAST_POINTS = 30


def crowded(found: Sighting) -> bool:
    """Whether something stands so close to an object that it may keep a hand from it."""
    return any(gap(found.target, one) < _CLOSE for one in found.beside)


def cornered(found: Sighting) -> bool:
    """Whether an object has corners that reach inwards, seen from above: it may be several things that touch."""
    if found.target.kind or not found.clouds:
        return False
    cells = tops(object_points(found.clouds))
    try:
        hull = ConvexHull(cells[:, :2]).volume
    except QhullError:
        return False  # all on one line
    return len(cells) * COLUMN**2 < _FULL * hull


def neighbours(found: Sighting, held: Sequence[Box], config: GraspConfig) -> tuple[Box, ...]:
    """Boxes to keep clear of.

    Args:
        found: The object and what is around it.
        held: The object where it stands.
        config: Margins.
    """
    boxes = dict(zip(map(id, found.others), obstacle_boxes(found.others, config), strict=True))
    seen, parts = points_around(found.clouds), list[Box]()
    for one in found.others:
        whole = boxes[id(one)]
        own = seen[in_box(seen, one)] if not (one.kind and one.measured) else seen[:0]
        if (deep := one.top - surface_of(one, found)) >= _HOLLOW:
            made = _walled(whole, deep + config.approach.obstacle_margin)
        elif len(own) < _LEAST_POINTS:
            made = (whole,)
        else:
            made = slabs(one.label, columns(own, one.bottom), COLUMN, most=_MOST, saved=_SAVED)
            made = tuple(replace(box, size=np.maximum(box.size - 2.0 * _NEARER, COLUMN)) for box in made)
        parts += [replace(box, id=f"{whole.id}/{n}" if len(made) > 1 else whole.id) for n, box in enumerate(made)]
    for box in held:
        parts = [cut for part in parts if (cut := _beside(part, box)) is not None]
    for box in held:
        parts = [cut for part in parts if (cut := _not_over(part, box, config.approach.lift_height)) is not None]
    return tuple(parts)


def _walled(whole: Box, deep: float) -> tuple[Box, ...]:
    """A box that is hollow from above, to a depth, as its bottom and four walls."""
    (x, y, z), wall = whole.size, RIM + _APART
    sizes = [(x, y, z - deep), *[(wall, y, deep)] * 2, *[(x, wall, deep)] * 2]
    shifts = [(0.0, 0.0, -0.5 * deep)]
    shifts += [(sign * 0.5 * (x - wall), 0.0, 0.5 * (z - deep)) for sign in (1.0, -1.0)]
    shifts += [(0.0, sign * 0.5 * (y - wall), 0.5 * (z - deep)) for sign in (1.0, -1.0)]
    return tuple(
        replace(whole, T_frame_box=whole.T_frame_box @ se3.make(p=shift), size=np.array(size))
        for shift, size in zip(shifts, sizes, strict=True)
    )


def under(parts: Sequence[Box], places: Sequence[PlaceTarget]) -> tuple[Box, ...]:
    """Boxes to keep clear of, lowered where something is to be put down on them."""
    spots, found = np.unique([place.position for place in places], axis=0), list[Box]()
    for part in parts:
        off = np.abs((spots - part.T_frame_box[:3, 3]) @ part.T_frame_box[:3, :3]) - 0.5 * part.size
        on = (off[:, :2] <= _CLOSE).all(axis=1) & (np.abs(off[:, 2]) <= _FACE)
        lost = min(_LOWER - float(off[on, 2].min(initial=_LOWER)), float(part.size[2]) - 1e-3)
        found.append(_cut(part, 2, lost, top=True) if lost > 0.0 else part)
    return tuple(found)


def standing_boxes(label: str, points: Array, floor: float, table_gap: float) -> tuple[Box, ...]:
    """Boxes about what reaches from its highest points (n, 3) down to a height, and a gap above that, m."""
    return slabs(label, columns(points, floor), COLUMN, gap=table_gap)


def columns(points: Array, floor: float) -> Array:
    """Middles of voxels (n, 3) from the highest point of each column down to a height."""
    high = tops(points)
    many = np.maximum(np.ceil((high[:, 2] - floor) / COLUMN), 1.0).astype(np.int64)
    level = np.arange(int(many.sum())) - np.repeat(np.cumsum(many) - many, many)
    return np.column_stack([np.repeat(high[:, :2], many, axis=0), floor + (level + 0.5) * COLUMN]).astype(np.float64)


def _beside(part: Box, held: Box) -> Box | None:
    """A box without what reaches into another one, cut at the side where least is lost; None when nothing is left."""
    above, below = _overlap(part, held)
    if (np.concatenate([above, below]) <= 0.0).any():
        return part
    share = np.concatenate([above, below]) / np.tile(part.size, 2)
    best = int(share.argmin())
    lost = float(np.concatenate([above, below])[best])
    if share[best] >= 1.0 or part.size[best % 3] - lost < COLUMN / 2.0:
        return None
    return _cut(part, best % 3, lost, top=best < 3)


def _not_over(part: Box, held: Box, lift: float) -> Box | None:
    """A box without what reaches a little over one that is lifted; as it is where that is more than a little."""
    up = se3.make(p=(0.0, 0.0, 0.5 * lift))
    above, below = _overlap(part, replace(held, T_frame_box=held.T_frame_box @ up, size=held.size + lift * UP))
    if (np.concatenate([above, below]) <= 0.0).any():
        return part
    lost = np.concatenate([above[:2], below[:2]])
    best = int(lost.argmin())
    if lost[best] > _OVER + _APART:
        return part
    axis = best % 2
    return _cut(part, axis, float(lost[best]), top=best < 2) if part.size[axis] - lost[best] >= COLUMN / 2.0 else None


def _overlap(part: Box, held: Box) -> tuple[Array, Array]:
    """What of a box two cuts along each of its axes take, m: above the low end of another box, and below its high end.

    0 or less: they are apart.
    """
    T = se3.inverse(part.T_frame_box) @ held.T_frame_box
    half, reach = 0.5 * part.size, 0.5 * np.abs(T[:3, :3]) @ held.size + _APART
    return half - (T[:3, 3] - reach), half + (T[:3, 3] + reach)


def _cut(part: Box, axis: int, lost: float, *, top: bool) -> Box:
    """A box without so much of its top, or its bottom, along an axis."""
    size, shift = part.size.copy(), np.zeros(3)
    size[axis] -= lost
    shift[axis] = -0.5 * lost if top else 0.5 * lost
    return replace(part, T_frame_box=part.T_frame_box @ se3.make(p=shift), size=size)
