# SPDX-License-Identifier: Apache-2.0
"""See, from home, whether an object is at the place where a hand has put it. Base frame, m."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from openarm_common import se3
from openarm_common.detection import gap
from openarm_common.errors import Code, OpenArmError
from openarm_common.objects.resting import least_box_middles
from openarm_common.types import Array
from openarm_grasp.evidence import verdicts
from openarm_grasp.evidence.shapes import Cluster, is_more, judge_moved, judge_rests
from openarm_grasp.evidence.verdicts import CameraVerdict
from openarm_grasp.perception.clouds import came_next_to, cluster_frames, cluster_of, nearest_to, stands
from openarm_grasp.perception.detections import NEXT_TO, Frame
from openarm_grasp.perception.sightings import object_points
from openarm_grasp.planning.candidates import UP, PlaceTarget
from openarm_grasp.planning.place import placing_error
from openarm_grasp.requests.states import State
from openarm_grasp.requests.task import Grasp, Placed
from openarm_grasp.robot.skills import reraise_stop

if TYPE_CHECKING:
    from openarm_grasp.strategies.run import Run

#: Share of the tolerance of a place in which the middle of any shape must be seen: it may be millimetres elsewhere.
_SEEN_WITHIN = 0.75
#: Share of what counts as moved within which what may be a part must be where the hand has moved it to: of the rest
#: nothing is known, and that of which it is a part, or which a hand took with it, has turned with it otherwise.
_PART_WITHIN = 0.5


async def verify(run: Run, grasp: Grasp, placed: Placed) -> CameraVerdict:
    """Judge by the camera, from home, whether the object is at its place.

    Raises:
        OpenArmError: PLACE_FAILED, when no frame comes.
    """
    config, robot, text = run.config, run.robot, "home; observing the place"
    frames: tuple[Frame, ...] = ()
    for _ in range(config.detect.attempts):
        run.enter(State.RESET, text)
        try:
            frames = (await robot.observe(config.detect.frames)).frames
        except OpenArmError as error:
            reraise_stop(error)
            raise OpenArmError(Code.PLACE_FAILED, f"put down, but not seen since: {error.message}") from error
        if any(d.label == run.label for frame in frames for d in frame.detections):
            break
        text = f"{run.label!r} is not in view after the place; observing again"
    if grasp.of_cloud:
        return _judge_shape(run, grasp, placed, frames)
    error = placing_error(run.label, placed.target, frames[-1]) if frames else None
    if error is not None:
        run.task.session.drift.add(run.arm, *error)
    p_target, yaw = placed.target.position, run.request.place_yaw
    height, footprint = (None, None) if run.size is None else (float(run.size[2]), run.size[:2])
    tolerance = config.place.tolerance
    return verdicts.judge_place(run.label, p_target, frames, tolerance, yaw, height, footprint)


def _judge_shape(run: Run, grasp: Grasp, placed: Placed, frames: Sequence[Frame]) -> CameraVerdict:
    """Judge what is no box by its points, and by the middle of what is seen now.

    One image that shows it at its place is enough: of a thin thing another may show a part. What stood next to others,
    and is larger in any image now, was seen in part. Of what had turned in the hand nothing is said: a part that is out
    of view may make up for a shift.
    """
    if grasp.turned:
        return _unproven("it had turned or slipped in the hand: nothing shows that it is where it should be")
    before, target = cluster_of(grasp.sighting), placed.target
    T_base_now = grasp.motion_to(target)
    known, nearest = object_points(grasp.sighting.clouds[-1:]), (nearest_to((one,), target.position) for one in frames)
    more = _was_next_to_others(grasp) and any(
        is_more(seen, known, T_base_now, run.config.held.moved) for _, seen in nearest
    )
    judge = _seen_in_part if before.cut or more else _seen_whole
    newest = CameraVerdict(Code.STALE_DATA, "no camera frame after the place")
    for age, frame in enumerate(reversed(frames)):
        verdict = judge(frame, run, grasp, target, before, T_base_now)
        if verdict.ok:
            return _gone_with_it(grasp, frames) or verdict
        newest = verdict if age == 0 else newest
    return newest


def _was_next_to_others(grasp: Grasp) -> bool:
    return any(gap(d, grasp.sighting.target) < NEXT_TO for d in grasp.sighting.beside)


def _unproven(text: str, *, final: bool = False) -> CameraVerdict:
    return CameraVerdict(Code.PLACE_FAILED, text, final=final)


def _gone_with_it(grasp: Grasp, frames: Sequence[Frame]) -> CameraVerdict | None:
    """Return why the middle of what is seen is not known after all; None where nothing has gone with it."""
    torn = next((d for d in grasp.adjacent if not stands(d, frames)), None)
    if torn is None and not grasp.merged:
        return None
    d, what = (torn, "is a part of it") if torn is not None else (grasp.merged[0], "may be another thing")
    x, y = d.p_base[:2]
    text = f"what lay next to it at ({x:.3f}, {y:.3f}) m has gone with it: it {what}, and its middle is not known"
    return _unproven(text, final=True)


def _judge_known(run: Run, grasp: Grasp, T_base_now: Array, points: Array) -> CameraVerdict:
    """Judge whether what was seen of it before is seen (n, 3) where the hand has moved it."""
    known, tolerance = object_points(grasp.sighting.clouds[-1:]), _PART_WITHIN * run.config.held.moved
    return judge_moved(known, T_base_now, points, tolerance)


def _seen_whole(
    frame: Frame, run: Run, grasp: Grasp, target: PlaceTarget, before: Cluster, T_base_now: Array
) -> CameraVerdict:
    """Judge by one image what was seen whole before: it rests at its place as it rested."""
    config, place = run.config, target.position
    tolerance = _SEEN_WITHIN * config.place.tolerance
    # next to others it may have been several things, or have lain on one: such come apart, or fall
    leaned = _was_next_to_others(grasp)
    rise = (place - grasp.sighting.target.foot) * UP
    moved = replace(before, centroid=before.centroid + rise, top=before.top + float(rise[2]))
    rested = judge_rests(moved, place, cluster_frames((frame,), place), tolerance, leaned=leaned)
    if not rested.ok:
        return rested
    # next to what was left behind the middle of both may be where that of one thing and the other should be
    now, points = nearest_to((frame,), place)
    expected = se3.apply(T_base_now, before.centroid)[:2]
    if now is not None and not leaned and float(np.linalg.norm(points[:, :2].mean(axis=0) - expected)) <= tolerance:
        return rested
    return _judge_known(run, grasp, T_base_now, points)


def _seen_in_part(
    frame: Frame, run: Run, grasp: Grasp, target: PlaceTarget, before: Cluster, T_base_now: Array
) -> CameraVerdict:
    """Judge by one image what was seen in part before; where no place was asked for, it is where it is seen."""
    config, request, place = run.config, run.request, target.position
    now, points = nearest_to((frame,), se3.apply(T_base_now, before.centroid))
    seen = _judge_known(run, grasp, T_base_now, points)
    if not seen.ok:
        return seen
    if now is None or not now.measured:
        return _unproven("the border of the image or another thing hides a part of it: its middle is not known")
    if came_next_to(now, grasp.sighting.others, (frame,), NEXT_TO):
        text = "what is seen next to it was not there before: it may be a part of it, and its middle is not known"
        return _unproven(text)
    if request.place is None and not (request.place_on or request.place_choices):
        run.place_target = replace(target, position=np.array([*now.p_base[:2], place[2]]))
        return seen
    middles = np.concatenate([now.p_base[None, :2], least_box_middles(points[:, :2])])
    off, tolerance = float(np.linalg.norm(middles - place[:2], axis=1).min()), _SEEN_WITHIN * config.place.tolerance
    if off > tolerance:
        text = f"its middle is seen {off * 1e3:.0f} mm from its target, expected at most {tolerance * 1e3:.0f} mm"
        return _unproven(text)
    return seen
