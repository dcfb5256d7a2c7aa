# SPDX-License-Identifier: Apache-2.0
"""Detections of objects, and the geometry of their boxes.

All poses are in the base frame. A detection is an upright box: its z axis is up, ``size[0]`` and ``size[1]`` are the
footprint edges along its x and y, ``size[2]`` its height. A box has no front: turned by 90° with swapped edges it is
the same box.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.types import Array

#: An object that is chosen by its position is no farther from it than this, m.
SAME_PLACE = 0.05


@dataclass(frozen=True)
class Frame:
    """All detections of one image; `t_ns` is the image stamp."""

    t_ns: int
    detections: tuple[Detection, ...]


@dataclass(frozen=True)
class Sighting:
    """An object averaged over frames, and what else was in view.

    Attributes:
        target: The averaged detection.
        others: Every other object, newest sight of each.
        t_ns: Stamp of the newest frame.
    """

    target: Detection
    others: tuple[Detection, ...]
    t_ns: int


def in_base(frames: Sequence[Frame], lookup: Callable[[int], Array]) -> tuple[Frame, ...]:
    """Frames of detections in the base frame.

    Args:
        frames: In some frame.
        lookup: T_base_frame (4, 4) of that frame at a stamp in ns.
    """
    moved: list[Frame] = []
    for frame in frames:
        T = lookup(frame.t_ns)
        found = (replace(d, T_base_object=T @ d.T_base_object) for d in frame.detections)
        moved.append(Frame(frame.t_ns, tuple(found)))
    return tuple(moved)


def labels_in_view(frames: Sequence[Frame]) -> list[str]:
    """Labels seen in any of the frames, sorted."""
    return sorted({d.label for frame in frames for d in frame.detections})


def apart(a: Detection, b: Detection) -> float:
    """Horizontal distance of two objects, m."""
    return float(np.linalg.norm((a.p_base - b.p_base)[:2]))


def sticks_out(seen: Detection, stood: Detection) -> float:
    """How far what is seen reaches out of the footprint of an object as it stood, m; 0 when it lies within.

    The middles of its edges are looked at: the corners of a box around something round are no part of it.
    """
    half = seen.size[:2] / 2.0
    middles = np.array([[half[0], 0.0], [-half[0], 0.0], [0.0, half[1]], [0.0, -half[1]]])
    points = middles @ seen.T_base_object[:2, :2].T + seen.p_base[:2]
    local = (points - stood.p_base[:2]) @ stood.T_base_object[:2, :2]
    beyond = np.maximum(np.abs(local) - stood.size[:2] / 2.0, 0.0)
    return float(np.linalg.norm(beyond, axis=1).max())


def average(track: Sequence[Detection]) -> Detection:
    """Mean of sights of one box, whichever of its four equal descriptions each frame chose."""
    reference = track[-1]
    yaws: list[float] = []
    sizes: list[Array] = []
    for d in track:
        quarter_turns = round((d.yaw - reference.yaw) / (np.pi / 2.0))
        yaws.append(d.yaw - quarter_turns * np.pi / 2.0 - reference.yaw)
        sizes.append(d.size[[1, 0, 2]] if quarter_turns % 2 else d.size)
    # Round objects have no yaw of their own: their frames disagree by up to 45°, and any value is right.
    yaw = reference.yaw + float(np.mean(yaws))
    p = np.mean([d.p_base for d in track], axis=0)
    score = float(np.mean([d.score for d in track]))
    around = 2 * sum(d.round for d in track) > len(track)
    return Detection(reference.label, score, se3.make(se3.rot_z(yaw), p), np.mean(sizes, axis=0), around)
