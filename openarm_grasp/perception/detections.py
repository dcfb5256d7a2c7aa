# SPDX-License-Identifier: Apache-2.0
"""Detections of objects, the geometry of their boxes, and the one object in them that can be trusted.

All poses are in the base frame. A detection is an upright box: its z axis is up, ``size[0]`` and ``size[1]`` are the
footprint edges along its x and y, ``size[2]`` its height. A box has no front: turned by 90° with swapped edges it is
the same box.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count, pairwise

import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.detection import Detection, distances_from
from openarm_common.errors import Code, OpenArmError
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.types import Array
from openarm_common.wanted import describe, select
from openarm_grasp.config import DetectConfig

#: (x, y), base frame, m.
Spot = tuple[float, float]
#: An object that is chosen by its position is no farther from it than this, m.
SAME_PLACE = 0.05
#: Things nearer to each other than this may be parts of one, m.
NEXT_TO = 0.03
#: Where the middle of an object is that is not asked for, what has its middle there, or has that in its box, or nearly,
#: is it or a part of it, m.
_PART = 0.01
#: What has its middle this near to a point of something is a piece of that, m.
_ON = 0.015
#: Clouds of so many frames are enough.
_CLOUDS = 3
#: Of an object that has not moved more than this share is seen where it was; of one that has by 5 mm, less.
_MOST = 0.95
#: What stands on another thing, or in it, begins so much higher than that, m.
_STACKED = 0.005
#: An object of no known shape that has fewer points has no cloud.
_LEAST_POINTS = 60
#: What has been out of view for so long, ns, has another id when it is seen again.
_FORGET_NS = 60_000_000_000


@dataclass(frozen=True)
class Frame:
    """All detections of one image; `t_ns` is the image stamp.

    `cloud` has the points of the image, labelled by detection, where they are known.
    """

    t_ns: int
    detections: tuple[Detection, ...]
    cloud: LabelledCloud | None = None


@dataclass(frozen=True)
class Sighting:
    """An object averaged over frames, and what else was in view.

    Attributes:
        target: The averaged detection.
        others: Every other object, newest sight of each.
        t_ns: Stamp of the newest frame.
        clouds: Clouds of the newest frames that show the target, with its points labelled 1, those of other
            detections 2, and all others 0.
    """

    target: Detection
    others: tuple[Detection, ...]
    t_ns: int
    clouds: tuple[LabelledCloud, ...] = ()

    @property
    def beside(self) -> tuple[Detection, ...]:
        """Others, without what the object stands on or what stands on it."""
        return tuple(d for d in self.others if not stacked(d, self.target))


class UntrustedError(OpenArmError):
    """An object that is in view, but cannot be trusted.

    Args:
        code: Why.
        message: Why, in a sentence.
        where: (3,) where it seems to be, base frame, m.
    """

    def __init__(self, code: Code, message: str, where: Array) -> None:
        super().__init__(code, message)
        self.where = where


class Ids:
    """Ids for detections of a detector that follows nothing: that of the nearest one of its label before."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[int, Detection]] = {}
        self._numbers = count()

    def given(self, frame: Frame) -> Frame:
        """Return a frame with an id for each detection; one that its detector has given stays."""
        self._known = {name: one for name, one in self._known.items() if abs(frame.t_ns - one[0]) <= _FORGET_NS}
        free, named = {name: known for name, (_, known) in self._known.items()}, list[Detection]()
        for d in frame.detections:
            alike = [name for name, known in free.items() if known.label == d.label and apart(d, known) <= NEXT_TO]
            name = d.id or min(alike, key=lambda name: apart(d, free[name]), default="") or f"~{next(self._numbers)}"
            free.pop(name, None)
            named.append(d if d.id else replace(d, id=name))
            if not d.id:
                self._known[name] = frame.t_ns, d
        return replace(frame, detections=tuple(named))


def in_base(frames: Sequence[Frame], lookup: Callable[[int], Array]) -> tuple[Frame, ...]:
    """Frames of detections in the base frame.

    Args:
        frames: Frames in some frame.
        lookup: T_base_frame (4, 4) of that frame at a stamp in ns.
    """
    moved: list[Frame] = []
    for frame in frames:
        T = lookup(frame.t_ns)
        found = (replace(d, T_base_object=T @ d.T_base_object) for d in frame.detections)
        moved.append(replace(frame, detections=tuple(found)))
    return tuple(moved)


def picked(frame: Frame, detections: Sequence[Detection]) -> Frame:
    """Return a frame with some of its detections alone; the points of others belong to none."""
    if frame.cloud is None:
        return replace(frame, detections=tuple(detections))
    labels = np.zeros_like(frame.cloud.labels)
    for number, one in enumerate(detections, start=1):
        labels[frame.cloud.labels == frame.detections.index(one) + 1] = number
    return replace(frame, detections=tuple(detections), cloud=replace(frame.cloud, labels=labels))


def apart(a: Detection, b: Detection) -> float:
    """Horizontal distance of two objects, m."""
    return float(np.linalg.norm((a.p_base - b.p_base)[:2]))


def stacked(a: Detection, b: Detection) -> bool:
    """Whether one of two objects stands on the other, or in it."""
    lower, upper = sorted((a, b), key=lambda d: d.bottom)
    return upper.bottom - lower.bottom > _STACKED and not distances_from(lower, upper.p_base[None, :2]).any()


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
    T, size = se3.make(se3.rot_z(yaw), p), np.mean(sizes, axis=0)
    # what seems a prism in some frames alone is none
    kind = reference.kind if all(d.kind for d in track) else ""
    measured = all(d.measured for d in track)
    return replace(reference, score=score, T_base_object=T, size=size, round=around, kind=kind, measured=measured)


def in_view(frames: Sequence[Frame], label: str, selection: str = "") -> tuple[Detection, ...]:
    """What words fit in the newest frame, the first choice at the front.

    Raises:
        OpenArmError: NOTHING_DETECTED or UNKNOWN_OBJECT, when no frame shows any; STALE_DATA, when older ones do.
    """
    fault: OpenArmError | None = None
    for frame in reversed(frames):
        try:
            fitting = select(label, frame.detections, selection)
        except OpenArmError as error:
            fault = fault or error
            continue
        if fault is None:
            return fitting
        raise OpenArmError(Code.STALE_DATA, f"{label or 'the object'!r} was in view, but not in the newest frame")
    raise fault or OpenArmError(Code.NOTHING_DETECTED, "no frame of the camera")


def find(
    frames: Sequence[Frame],
    label: str,
    limits: DetectConfig,
    *,
    selection: str = "",
    at: Sequence[float] | None = None,
    exclude_near: Sequence[Spot] = (),
    exclude_parts: Sequence[Array] = (),
    same: Sighting | None = None,
) -> Sighting:
    """Choose an object, follow it by its id through all frames, and average it.

    Args:
        frames: Frames, at least one, oldest first; every detection has an id.
        label: Object to look for, in words; "" takes any. Of those that fit, the first is taken.
        limits: Limits of how much an object may seem to move.
        selection: Selection among those that fit, as `openarm_common.wanted.select`.
        at: (x, y) where it stands, m; None: anywhere.
        exclude_near: (x, y) of objects that are excluded, m.
        exclude_parts: (n, 2) points of others that are excluded, m.
        same: The object as it was seen or left before: it is looked for alone, whatever the words fit now.

    Raises:
        OpenArmError: NOTHING_DETECTED, when no frame holds anything, or the chosen one cannot be measured, unless it
            is a part of something of unknown shape whose points are known;
            INTRINSICS_MISMATCH or TABLE_MISMATCH, when what its camera sees is not to be trusted;
            UNKNOWN_OBJECT, naming what is in view; STALE_DATA, when the object was not in the newest frame and two
            thirds of all, or moved between them.
    """
    fitting = () if same else in_view(frames, label, selection)
    anchor = _same(frames, same) if same else _anchor(fitting, label, at, exclude_near, exclude_parts)
    sights = [_Sight(d, _labelled(frame, d)) for frame in frames for d in frame.detections if d.id == anchor.id]
    track, enough = [one for one in sights if one.shown.measured], 2 * len(frames)
    if 3 * len(track) < enough:  # a part of something of unknown shape is taken on its points
        parts = [one for one in sights if one.shown.measured or one.shown.in_part]
        track = parts if all(one.cloud is not None for one in parts) else track
    if not anchor.measured and not (anchor.in_part and track):
        raise _not_measured(anchor)
    prism = all(one.shown.kind for one in track) or any(one.cloud is None for one in track)
    # the box around what is no prism changes with the noise, the middle of its points hardly does
    spots = np.array([one.shown.p_base if prism else one.middle for one in track])
    if not prism:  # in some frame a part of it may be missing
        alike = np.linalg.norm(spots - np.median(spots, axis=0), axis=1) <= limits.shape_agrees_within
        if 3 * np.count_nonzero(alike) >= 2 * len(track):
            track, spots = [track[k] for k in np.flatnonzero(alike)], spots[alike]
    limit = limits.agree_within if prism else 2.0 * limits.shape_agrees_within
    step = max((float(np.linalg.norm(a - b)) for a, b in pairwise(spots)), default=0.0)
    # A detector may miss a thing in one frame; in most of them it must be in its place.
    if 3 * len(track) >= enough and step <= limit:
        return _sighting(frames, track)
    newest = next((one for one in reversed(track) if one.cloud is not None), None)
    if newest is not None and newest.cloud is not None and _stays(frames, newest.cloud):
        return _sighting(frames[-1:], [newest])
    if 3 * len(track) >= enough:
        text = f"moved {step * 1e3:.1f} mm between two frames, expected at most {limit * 1e3:.1f} mm; is it at rest?"
    elif 3 * len(sights) >= enough:
        raise _not_measured(anchor)
    else:
        text = f"is in view in {len(track)} of {len(frames)} frames only, expected in two thirds of them"
    raise UntrustedError(Code.STALE_DATA, f"{anchor.label!r} at {_text(anchor.p_base)} {text}", anchor.p_base)


@dataclass(frozen=True)
class _Sight:
    """An object in a frame, with its points labelled 1, where they are known."""

    shown: Detection
    cloud: LabelledCloud | None

    @property
    def middle(self) -> Array:
        """(3,) mean of its points."""
        points = self.cloud.points[self.cloud.labels == 1] if self.cloud is not None else np.empty((0, 3))
        return np.asarray(points.mean(axis=0, dtype=np.float64), dtype=np.float64)


def _sighting(frames: Sequence[Frame], track: Sequence[_Sight]) -> Sighting:
    """The mean of sights of one object, and the newest sight of everything else in view."""
    target, others = average([one.shown for one in track]), dict[str, Detection]()
    for d in (d for frame in reversed(frames) for d in frame.detections):
        if _whole(d) != _whole(target):
            others.setdefault(d.id, d)
    clouds = tuple(one.cloud for one in track if one.cloud is not None)
    return Sighting(target, tuple(others.values()), frames[-1].t_ns, clouds[-_CLOUDS:])


def _whole(d: Detection) -> str:
    """Id of the object of which a detection may be a piece."""
    return d.id.partition(".")[0]


def _stays(frames: Sequence[Frame], cloud: LabelledCloud) -> bool:
    """Whether what a frame shows of an object is there in two thirds of all, be it as a part of others.

    Things that touch are one in some frames and several in others, and none of them has moved.
    """
    from openarm_world.shares import explain, view_of  # a client of the grasp node needs the types of this module alone

    mine = cloud.points[cloud.labels == 1].astype(np.float64)
    views = (view_of(frame.cloud.points, frame.cloud.camera) for frame in frames if frame.cloud is not None)
    return 3 * sum(explain(mine, np.eye(4), view).seen >= _MOST for view in views) >= 2 * len(frames)


def _labelled(frame: Frame, detection: Detection) -> LabelledCloud | None:
    """The points of a frame, 1: of a detection, 2: of another, 0: of none; None where it has too few."""
    if frame.cloud is None:
        return None
    mine = frame.cloud.labels == frame.detections.index(detection) + 1
    if np.count_nonzero(mine) < (1 if detection.kind else _LEAST_POINTS):
        return None
    labels = np.where(mine, 1, np.where(frame.cloud.labels > 0, 2, 0))
    return replace(frame.cloud, labels=labels.astype(np.uint32))


def _same(frames: Sequence[Frame], before: Sighting) -> Detection:
    """The detection of an object that was seen before; when it was lost, the nearest like it that was not there."""
    target, newest, known = before.target, frames[-1].detections, {d.id for d in before.others}
    alike = [d for d in newest if d.label == target.label and d.id not in known]
    if not alike:
        text = f"{target.label!r} that was at {_text(target.p_base)} is not in view; in view: {describe(newest)}"
        raise OpenArmError(Code.UNKNOWN_OBJECT, text)
    return min(alike, key=lambda d: (d.id != target.id, not d.measured, apart(d, target)))


def _anchor(
    fitting: Sequence[Detection],
    label: str,
    at: Sequence[float] | None,
    exclude_near: Sequence[Spot],
    exclude_parts: Sequence[Array],
) -> Detection:
    """The detection of the object that is asked for."""
    name = label or "the object"
    stay = _excluded(fitting, exclude_near)
    stay |= [any(_of_it(d, points) for points in exclude_parts) for d in fitting]
    chosen = [d for d, stays in zip(fitting, stay, strict=True) if not stays]
    if not chosen:
        raise OpenArmError(
            Code.UNKNOWN_OBJECT, f"no {name!r} in view besides {len(fitting)} that must stay where they are"
        )
    if at is not None:
        near = [d for d in chosen if distance_to(d, at) <= SAME_PLACE]
        if not near:
            there = ", ".join(_text(d.p_base) for d in chosen)
            limit = f"within {SAME_PLACE * 1e3:.0f} mm of ({at[0]:.3f}, {at[1]:.3f}) m"
            raise OpenArmError(Code.UNKNOWN_OBJECT, f"no {name!r} {limit}; it is seen at {there}")
        chosen = [min(near, key=lambda d: distance_to(d, at))]
    return next((d for d in chosen if d.measured), chosen[0])


def _excluded(fitting: Sequence[Detection], exclude_near: Sequence[Spot]) -> NDArray[np.bool_]:
    """Which detections stay where they are (bool).

    Of each position: what is nearest to it and within `SAME_PLACE`; all that is nearer than half of that, and, unless
    something has its middle there, all that has it in its box, as these may be parts of one object. What else stands
    close by is another object.
    """
    stay = np.zeros(len(fitting), dtype=np.bool_)
    if not fitting or not exclude_near:
        return stay
    positions = np.array(exclude_near, dtype=np.float64)
    away = np.array([[distance_to(d, p) for p in exclude_near] for d in fitting])
    nearest = away.argmin(axis=0)
    stay[nearest[away.min(axis=0) <= SAME_PLACE]] = True
    in_box = np.array([distances_from(d, positions) <= _PART for d in fitting]) & (away.min(axis=0) > _PART)
    return stay | ((away <= SAME_PLACE / 2.0) | in_box).any(axis=1)


def _of_it(d: Detection, points: Array) -> bool:
    """Whether a detection is a thing of which points (n, 2) are known, has it in its box, or is a piece of it."""
    return bool(
        np.linalg.norm(points - d.p_base[:2], axis=1).min() <= _ON or np.median(distances_from(d, points)) <= _PART
    )


def _not_measured(d: Detection) -> UntrustedError:
    why = _WHY.get(d.code, "cannot be measured: something hides its outline, or the border of the image cuts it")
    return UntrustedError(d.code, f"{d.label!r} is in view at about {_text(d.p_base)}, but {why}", d.p_base)


#: Why nothing that a camera sees is a target; its detector knows the figures.
_WHY = {
    Code.INTRINSICS_MISMATCH: "its camera_info does not fit its calibration or what it sees, so that nothing it sees"
    " is a target; /diagnostics of its detector has the figures",
    Code.TABLE_MISMATCH: "the table is not seen where it is expected, so that nothing is a target; measure it with"
    " `openarm calibrate table`; /diagnostics of the detector has the figures",
}


def on_table(d: Detection, table_z: float, *, reach: float = 0.01) -> Detection:
    """Let a box that stands on the table end there: its top is measured, its bottom is usually hidden.

    Args:
        d: The box.
        table_z: Height of the table top, base frame, m.
        reach: A bottom so much higher than the table is believed (the object stands on something else), m.

    Raises:
        OpenArmError: STALE_DATA, when the box is flatter than 5 mm: there is nothing to grasp.
    """
    if d.bottom - table_z > reach:
        return d
    height = d.top - table_z
    if height < 0.005:
        raise OpenArmError(
            Code.STALE_DATA,
            f"{d.label!r} is measured {height * 1e3:.0f} mm above the table at {table_z:.3f} m, expected at least 5 mm;"
            " is the camera calibrated?",
        )
    T = d.T_base_object.copy()
    T[2, 3] = table_z + height / 2.0
    return replace(d, T_base_object=T, size=np.array([d.size[0], d.size[1], height]))


def distance_to(d: Detection, p: Sequence[float] | Array) -> float:
    """Horizontal distance of an object from (2,) or (3,), m."""
    return float(np.hypot(d.p_base[0] - p[0], d.p_base[1] - p[1]))


def _text(p: Array) -> str:
    return "(" + ", ".join(f"{v:.3f}" for v in p) + ") m"
