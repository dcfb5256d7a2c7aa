# SPDX-License-Identifier: Apache-2.0
"""A cloud of voxels as a few upright boxes around it: what is in the hand, for the planner. Base frame, m."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from openarm_common import se3
from openarm_common.kernels import kernel
from openarm_common.types import Array
from openarm_common.walls import wall_yaw
from openarm_grasp.planning.candidates import Box

#: The top of what is grasped is this much lower for the planner, m: boxes about what is round reach beyond it, and
#: whether the palm has room there the sampler knows better.
EASED = 0.005
#: Cuts of a box are tried at so many places along each axis.
_CUTS = 8


class _Cut(NamedTuple):
    """Where a part is best cut, and the volume that it saves."""

    saved: float
    axis: int
    at: float


def slabs(
    label: str, points: Array, step: float, *, gap: float = 0.0, most: int = 8, saved: float = 0.06
) -> tuple[Box, ...]:
    """Put upright boxes around points, cut where that saves most volume.

    Args:
        label: Label of the object; it names the boxes.
        points: (n, 3) middles of voxels.
        step: Edge of a voxel.
        gap: The boxes end this far above the lowest voxel, so that what stands on a table is not in collision with it.
        most: Boxes.
        saved: Share of the volume of the one about everything that a further box must save.
    """
    R = se3.rot_z(wall_yaw(points[:, :2], step))
    parts = [points @ R]
    least = saved * _volume(parts[0], step)
    cuts = [_cut(parts[0], step)]
    while len(parts) < most:
        n = int(np.argmax([cut.saved for cut in cuts]))
        cut = cuts[n]
        if cut.saved <= least:
            break
        below = parts[n][:, cut.axis] < cut.at
        parts[n : n + 1] = [parts[n][below], parts[n][~below]]
        cuts[n : n + 1] = [_cut(part, step) for part in parts[n : n + 2]]
    floor = float(points[:, 2].min()) - 0.5 * step + gap
    boxes: list[Box] = []
    for n, part in enumerate(parts):
        low, high = part.min(axis=0) - 0.5 * step, part.max(axis=0) + 0.5 * step
        low[2] = min(max(low[2], floor), high[2] - step)
        name = f"target/{label}_{n}" if len(parts) > 1 else f"target/{label}"
        boxes.append(Box(name, se3.make(R, R @ (0.5 * (low + high))), high - low))
    return tuple(boxes)


def eased(box: Box, less: float = EASED) -> Box:
    """A box whose top is lower, m, by a quarter of its height at most."""
    less = min(less, 0.25 * float(box.size[2]))
    T = box.T_frame_box @ se3.make(p=(0.0, 0.0, -0.5 * less))
    return replace(box, T_frame_box=T, size=box.size - np.array([0.0, 0.0, less]))


def _volume(points: Array, step: float) -> float:
    return float(np.prod(np.ptp(points, axis=0) + step))


def _cut(points: Array, step: float) -> _Cut:
    """The best cut of a part; one that saves nothing where it is too small."""
    low, high = points.min(axis=0), points.max(axis=0)
    places = np.linspace(low, high, _CUTS + 2)[1:-1]
    lows, highs = _between_cuts(points, places)
    # below[k] and above[k] are the boxes on the two sides of place k; none where a side is empty
    below = np.maximum.accumulate(highs[:, :-1], axis=1) - np.minimum.accumulate(lows[:, :-1], axis=1) + step
    reverse = (slice(None), slice(None, 0, -1))
    above = np.maximum.accumulate(highs[reverse], axis=1) - np.minimum.accumulate(lows[reverse], axis=1) + step
    saved = _volume(points, step) - np.prod(below, axis=2) - np.prod(above[:, ::-1], axis=2)
    saved = np.where(np.isfinite(saved), saved, 0.0)
    axis, place = np.argwhere(saved == saved.max())[-1]
    if saved[axis, place] <= 0.0:
        return _Cut(0.0, 0, 0.0)
    return _Cut(float(saved[axis, place]), int(axis), float(places[place, axis]))


@kernel
def _between_cuts(points: Array, places: Array) -> tuple[Array, Array]:
    """Lowest and highest coordinates (3, n + 1, 3) of what lies between n places (n, 3) along each axis.

    Where nothing lies the lowest ones are infinite, and the highest ones minus infinity.
    """
    n = len(places)
    lows, highs = np.full((3, n + 1, 3), np.inf), np.full((3, n + 1, 3), -np.inf)
    for i in range(len(points)):
        for axis in range(3):
            k = 0
            while k < n and points[i, axis] >= places[k, axis]:
                k += 1
            for j in range(3):
                lows[axis, k, j] = min(lows[axis, k, j], points[i, j])
                highs[axis, k, j] = max(highs[axis, k, j], points[i, j])
    return lows, highs
