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
from openarm_grasp.evidence.camera import AS_HIGH, judge_moved, judge_same, stays
from openarm_grasp.evidence.verdicts import CameraVerdict
from openarm_grasp.perception.clouds import came_next_to, shown_at
from openarm_grasp.perception.detections import NEXT_TO, Frame
from openarm_grasp.perception.sightings import first_points, in_box, points_around
from openarm_grasp.planning.candidates import PlaceTarget
from openarm_grasp.planning.place import placing_error, symmetry
from openarm_grasp.requests.states import State
from openarm_grasp.requests.task import Grasp, Placed
from openarm_grasp.robot.skills import reraise_stop

if TYPE_CHECKING:
    from openarm_grasp.strategies.run import Run

#: Share of the tolerance of a place in which the middle must be seen: it may be millimetres elsewhere.
_SEEN_WITHIN = 0.75
#: What may be a part must be so near to where the hand has moved it, m: of the rest nothing is known, and that of which
#: it is a part, or which a hand took with it, has turned with it otherwise.
_PART_WITHIN = 0.006
#: Largest turn of a placed object from the yaw that was asked for, rad.
_TURN_WITHIN = float(np.radians(15.0))


async def verify(run: Run, grasp: Grasp, placed: Placed, frames: Sequence[Frame]) -> CameraVerdict:
    """Judge by the camera, from home, whether the object is at its place.

    Args:
        run: The request.
        grasp: Hold of the hand on the object.
        placed: Place where the hand has put it.
        frames: Frames taken as the arm came home; others are taken when they do not show it.

    Raises:
        OpenArmError: PLACE_FAILED, when no frame comes.
    """
    config, robot = run.config, run.robot
    for _ in range(config.detect.attempts):
        if any(d.label == run.label for frame in frames for d in frame.detections):
            break
        run.enter(State.RESET, f"{run.label!r} is not in view after the place; observing again")
        try:
            frames = await robot.observe(config.detect.frames)
        except OpenArmError as error:
            reraise_stop(error)
            raise OpenArmError(Code.PLACE_FAILED, f"put down, but not seen since: {error.message}") from error
    if (error := placing_error(run.label, placed.target, frames[-1]) if frames else None) is not None:
        run.task.session.drift.add(run.arm, *error)
    shown = [frame for frame in frames if any(d.label == run.label for d in frame.detections)]
    return _judge(run, grasp, placed.target, shown or frames)


def _judge(run: Run, grasp: Grasp, target: PlaceTarget, frames: Sequence[Frame]) -> CameraVerdict:
    """Judge by the points of what was put down.

    Of a prism the newest image counts; of anything else one that shows it at its place is enough: of a thin thing
    another may show a part. Of what had turned in the hand nothing is said: a part that is out of view may make up for
    a shift.
    """
    if grasp.turned:
        return _unproven("it had turned or slipped in the hand: nothing shows that it is where it should be")
    newest = CameraVerdict(Code.STALE_DATA, "no camera frame after the place")
    for age, frame in enumerate(reversed(frames[-1:] if grasp.sighting.target.kind else frames)):
        verdict = _seen(frame, run, grasp, target)
        if verdict.ok:
            return _gone_with_it(grasp, frames) or verdict
        newest = verdict if age == 0 else newest
    return newest


def _unproven(text: str, *, final: bool = False) -> CameraVerdict:
    return CameraVerdict(Code.PLACE_FAILED, text, final=final)


def _gone_with_it(grasp: Grasp, frames: Sequence[Frame]) -> CameraVerdict | None:
    """Return why the middle of what is seen is not known after all; None where nothing has gone with it."""
    if grasp.sighting.target.kind:
        return None
    around = points_around(grasp.sighting.clouds[:1])
    left = (d for d in grasp.adjacent if not stays(around[in_box(around, d)], frames))
    torn = next(left, None)
    if torn is None and not grasp.merged:
        return None
    d, what = (torn, "is a part of it") if torn is not None else (grasp.merged[0], "may be another thing")
    x, y = d.p_base[:2]
    text = f"what lay next to it at ({x:.3f}, {y:.3f}) m has gone with it: it {what}, and its middle is not known"
    return _unproven(text, final=True)


def _seen(frame: Frame, run: Run, grasp: Grasp, target: PlaceTarget) -> CameraVerdict:
    """Judge by one image: it rests as it did, where the hand has moved it, and its middle is at its target.

    What was seen in part, or is no prism and stood next to others, may be more than was seen, or several things: it
    must be where the hand has moved it. Where no place was asked for, such is where it is seen.
    """
    request, place, before = run.request, target.position, grasp.sighting.target
    one = bool(before.kind) or all(gap(d, before) >= NEXT_TO for d in grasp.sighting.beside)
    in_part, tolerance = not (before.measured and one), _SEEN_WITHIN * run.config.place.tolerance
    points, T_motion = first_points(grasp.sighting), grasp.motion_to(target)
    T, moved = judge_moved(points, T_motion, frame, _PART_WITHIN if in_part else tolerance, in_part=in_part)
    if not moved.ok:
        return moved
    now, seen = shown_at(frame, se3.apply(T, points))
    if not in_part:
        same = _same(run, grasp, T, T @ se3.inverse(T_motion), seen)
        if not same.ok:
            return same
    if before.kind and (now is None or now.label != before.label):
        return _unproven(f"what is seen there is {'nothing' if now is None else repr(now.label)}, not {before.label!r}")
    if before.kind:  # its middle is known, whatever is seen of it
        middles = se3.apply(T, before.p_base)[None, :2]
    elif now is None or not now.measured:
        return _unproven("the border of the image or another thing hides a part of it: its middle is not known")
    elif came_next_to(seen, frame, grasp.sighting):
        text = "what is seen next to it was not there before: it may be a part of it, and its middle is not known"
        return _unproven(text)
    elif in_part and request.place is None and not (request.place_on or request.place_choices):
        run.place_target = replace(target, position=np.array([*now.p_base[:2], place[2]]))
        return moved
    else:
        middles = np.concatenate([now.p_base[None, :2], least_box_middles(seen[:, :2])])
    off = float(np.linalg.norm(middles - place[:2], axis=1).min())
    text = f"its middle is seen {off * 1e3:.0f} mm from its target"
    if off > tolerance:
        return _unproven(f"{text}, expected at most {tolerance * 1e3:.0f} mm")
    return CameraVerdict(Code.OK, text)


def _same(run: Run, grasp: Grasp, T_motion: Array, T_off: Array, seen: Array) -> CameraVerdict:
    """Judge whether what was seen whole looks as it did, and is turned as it was asked for.

    Args:
        run: The request.
        grasp: Hold of the hand on the object.
        T_motion: (4, 4) how it has moved.
        T_off: (4, 4) how it is off from where the hand has moved it.
        seen: (n, 3) points that are seen of it.
    """
    before = grasp.sighting.target
    if before.kind and run.size is not None and abs(high := float(before.size[2] - run.size[2])) > AS_HIGH:
        how = f"{abs(high) * 1e3:.0f} mm {'higher' if high > 0.0 else 'lower'} than it was at first"
        return _unproven(f"the object does not rest as it did: it was {how}", final=True)
    turned = abs(float(np.arctan2(T_off[1, 0], T_off[0, 0])))
    sided = not before.round and symmetry(before) == np.pi
    if run.request.place_yaw is not None and sided and turned > _TURN_WITHIN:
        off, limit = np.degrees((turned, _TURN_WITHIN))
        return _unproven(f"it is turned {off:.0f}° from what was asked, expected at most {limit:.0f}°")
    return judge_same(seen, T_motion, grasp.sighting.clouds[0])
