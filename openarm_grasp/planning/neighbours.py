# SPDX-License-Identifier: Apache-2.0
"""What stands around an object, as boxes that a plan keeps clear of. Base frame, m.

In a heap boxes about whole things overlap, though the things do not. So what is no prism is as many boxes as its points
need, and no box reaches into what is to be lifted: at first they may touch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.types import Array
from openarm_grasp.config import GraspConfig
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.planning.candidates import Box, obstacle_boxes
from openarm_grasp.sampling.slabs import slabs

#: Edge of a column of points; points so far out of the box of a thing are its own, m.
_STEP, _OUT = 0.005, 0.004
#: A plan keeps so far from obstacles, and what is lifted touches none of them at first, m.
_APART = 0.004
#: Fewer points say nothing of a shape.
_LEAST_POINTS = 30


def neighbours(found: Sighting, held: Sequence[Box], config: GraspConfig) -> tuple[Box, ...]:
    """Boxes to keep clear of.

    Args:
        found: The object and what is around it.
        held: The object where it stands.
        config: Margins.
    """
    boxes = dict(zip(map(id, found.others), obstacle_boxes(found.others, config), strict=True))
    points = [cloud.points[cloud.labels > 1].astype(np.float64) for cloud in found.clouds]
    seen, parts = np.concatenate([np.empty((0, 3)), *points]), list[Box]()
    for one in found.others:
        whole = boxes[id(one)]
        own = _inside(seen, one) if not (one.kind and one.measured) else seen[:0]
        made = (whole,) if len(own) < _LEAST_POINTS else slabs(one.label, _columns(own, one.bottom), _STEP)
        parts += [replace(box, id=f"{whole.id}/{n}" if len(made) > 1 else whole.id) for n, box in enumerate(made)]
    for box in held:
        parts = [cut for part in parts if (cut := _beside(part, box)) is not None]
    return tuple(parts)


def _inside(points: Array, one: Detection) -> Array:
    """Points (n, 3) that are in the box about a thing."""
    local = se3.apply(se3.inverse(one.T_base_object), points)
    return points[(np.abs(local) <= 0.5 * one.size + _OUT).all(axis=1)]


def _columns(points: Array, floor: float) -> Array:
    """Middles of voxels (n, 3) from the highest point of each column down to a height."""
    cell, column = np.unique(np.floor(points[:, :2] / _STEP).astype(np.int64), axis=0, return_inverse=True)
    top = np.full(len(cell), floor)
    np.maximum.at(top, column.reshape(-1), points[:, 2])
    many = np.maximum(np.ceil((top - floor) / _STEP), 1.0).astype(np.int64)
    level = np.arange(int(many.sum())) - np.repeat(np.cumsum(many) - many, many)
    middles = [(np.repeat(cell, many, axis=0) + 0.5) * _STEP, floor + (level + 0.5) * _STEP]
    return np.column_stack(middles).astype(np.float64)


def _beside(part: Box, held: Box) -> Box | None:
    """A box without what reaches into another one, cut at the side where least is lost; None when nothing is left."""
    T = se3.inverse(part.T_frame_box) @ held.T_frame_box
    half, reach = 0.5 * part.size, 0.5 * np.abs(T[:3, :3]) @ held.size + _APART
    low, high = T[:3, 3] - reach, T[:3, 3] + reach
    # how much goes when all above `low`, or all below `high`, is cut off
    above, below = half - low, half + high
    if (np.concatenate([above, below]) <= 0.0).any():
        return part
    share = np.concatenate([above, below]) / np.tile(part.size, 2)
    best = int(share.argmin())
    axis, lost = best % 3, float(np.concatenate([above, below])[best])
    if share[best] >= 1.0 or part.size[axis] - lost < _STEP / 2.0:
        return None
    size, shift = part.size.copy(), np.zeros(3)
    size[axis] -= lost
    shift[axis] = -0.5 * lost if best < 3 else 0.5 * lost
    return replace(part, T_frame_box=part.T_frame_box @ se3.make(p=shift), size=size)
