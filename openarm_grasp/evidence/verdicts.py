# SPDX-License-Identifier: Apache-2.0
"""Whether an object is held, has risen, and stands where it should: from the gripper's joint and the camera.

A command that was sent proves nothing. Two independent kinds of evidence are needed for a lift: the gripper (gap,
effort, rest) and the camera (the object has left its place, or is seen higher).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from openarm_common.detection import Detection
from openarm_common.errors import Code
from openarm_common.robot.zeros import HandReach
from openarm_common.types import Array
from openarm_grasp.config import HeldConfig
from openarm_grasp.perception.detections import Frame, apart, sticks_out

#: Largest turn of a placed object from the yaw that was asked for, rad.
YAW_TOLERANCE = float(np.radians(15.0))
#: An object that is placed is as high as before; one that differs by more lies on its side, m.
UPRIGHT_WITHIN = 0.006
#: One whose footprint has grown by more in every frame leans (by 15° at the latest), m.
FOOTPRINT_WITHIN = 0.010
#: What is farther from an object is another one, or the hand hides it, m.
_ELSEWHERE = 0.10
#: Edges of a footprint that differ by less are taken for equal, m; those of what is round are, too.
SQUARE_WITHIN = 0.006
#: Fingers that close farther than was learned, by a gap of more than this, are others, m.
_OUTDATED = 0.0015


@dataclass(frozen=True)
class Evidence:
    """What the gripper's joint says at rest.

    Attributes:
        gap: Distance between the fingers, m (twice the position of one finger).
        expected: Width of the object between them, m.
        effort: Force of the finger actuator, N, any sign.
        speed: Speed of the gap, m/s, any sign.
        tcp_error: Distance of the TCP from the planned grasp, m.
        pads: Force on each finger pad, N; empty without a sensor.
        reach: Reach of this hand, where it was learned.
    """

    gap: float
    expected: float
    effort: float
    speed: float
    tcp_error: float = 0.0
    pads: tuple[float, ...] = ()
    reach: HandReach | None = None

    def empty(self, config: HeldConfig) -> bool:
        """Whether this is what the hand reads closed on nothing: its gap and, where they were learned, its force."""
        if self.reach is None:
            return self.gap <= config.closed_below
        firmer = config.use_effort and abs(self.effort) > self.reach.effort + config.min_effort
        return self.gap <= 2.0 * self.reach.closed + config.closed_below and not firmer


@dataclass(frozen=True)
class Verdict:
    """A judgement with its reason in a sentence; after a `final` one another try would not help."""

    code: Code
    reason: str
    final: bool = False

    @property
    def ok(self) -> bool:
        """Whether what was hoped for is so."""
        return self.code is Code.OK


class GripperVerdict(Verdict):
    """What the gripper says of the object in the hand."""


class CameraVerdict(Verdict):
    """What a camera says of the object and its place."""


def judge_grip(
    e: Evidence,
    config: HeldConfig,
    *,
    was_held: bool = False,
    apertures: tuple[float, float] | None = None,
    closed: float | None = None,
) -> GripperVerdict:
    """Whether the hand holds the object: GRASP_MISSED, when it is empty or moves; HAND_COLLISION; GRASP_LOST.

    Args:
        e: What the gripper says.
        config: Thresholds.
        was_held: The object was held before: an empty hand has lost it.
        apertures: Least and greatest gap around what is no box, m; None: the object is `e.expected` wide. Either within
            `width_tolerance`.
        closed: Gap after the hand had closed, m. It is the reference in place of the width then: a gap that has changed
            by more than `slip` since says that the object has turned or slipped. None: it was not measured.
    """
    empty = Code.GRASP_LOST if was_held else Code.GRASP_MISSED
    gap, width = f"gap {e.gap * 1e3:.1f} mm", f"the object's {e.expected * 1e3:.1f} mm"
    least, most = apertures or (e.expected, e.expected)
    if apertures is not None:
        width = f"the {least * 1e3:.1f} to {most * 1e3:.1f} mm that its surface has there"
    if e.tcp_error > config.max_tcp_error:
        off, limit = e.tcp_error * 1e3, config.max_tcp_error * 1e3
        return GripperVerdict(
            Code.HAND_COLLISION, f"the hand is {off:.1f} mm from the grasp, expected at most {limit:.0f} mm"
        )
    if e.empty(config):
        return GripperVerdict(empty, f"{gap}: the fingers are closed on nothing{outdated(e.gap, e.reach)}")
    if closed is not None:
        if abs(e.gap - closed) > config.slip:
            was, limit = f"{closed * 1e3:.1f} mm when the hand had closed", f"at most {config.slip * 1e3:.0f} mm"
            why = f"{gap}, {was}: the object has turned or slipped in the hand, expected a change of {limit}"
            return GripperVerdict(Code.GRASP_LOST, why)
    elif e.gap > most + config.width_tolerance:
        return GripperVerdict(Code.HAND_COLLISION, f"{gap} is wider than {width}: the fingers are not around it")
    elif e.gap < least - config.width_tolerance:
        return GripperVerdict(empty, f"{gap} is narrower than {width}: something else is between the fingers")
    if abs(e.speed) >= config.max_speed:
        return GripperVerdict(Code.GRASP_MISSED, f"{gap} changes by {abs(e.speed) * 1e3:.1f} mm/s, expected rest")
    if config.use_effort and abs(e.effort) <= config.min_effort:
        return GripperVerdict(
            empty, f"{gap}, but the fingers press with {abs(e.effort):.1f} N, expected over {config.min_effort:g} N"
        )
    if config.use_finger_force and min(e.pads, default=0.0) < config.min_pad_force:
        felt = f"a finger pad feels {min(e.pads):.1f} N" if e.pads else "no sensor reports the force on the finger pads"
        return GripperVerdict(
            empty, f"{gap}, but {felt}, expected {config.min_pad_force:g} N on each (held.use_finger_force)"
        )
    force = f", {abs(e.effort):.0f} N" if config.use_effort else ""
    return GripperVerdict(Code.OK, f"{gap} for {e.expected * 1e3:.1f} mm{force}: held")


def outdated(gap: float, reach: HandReach | None) -> str:
    """Return what is said of a hand that closes farther than was learned of it; "" of any other."""
    if reach is None or gap >= 2.0 * reach.closed - _OUTDATED:
        return ""
    return f"; this hand goes from {reach}: were its fingers exchanged? {learn_command()} learns it again"


def learn_command(arm: str = "") -> str:
    """Return what to type to learn a hand, for messages; "": those of all arms."""
    return f"`openarm hardware learn-hand{f' --arm {arm}' if arm else ''}`"


def judge_sight(
    before: Detection,
    frames: Sequence[Frame],
    config: HeldConfig,
    *,
    match_radius: float,
    others: Sequence[Detection] = (),
    lift: float = 0.0,
) -> CameraVerdict:
    """Whether the object has left its place, and risen with the hand.

    GRASP_MISSED, when it is still there or held elsewhere; GRASP_LOST, when it has slipped in the hand; STALE_DATA. The
    detector takes what is held for a part of the hand, as long as it is where the hand took hold of it; what is seen
    below that has slipped by at least so much.

    Args:
        before: The object as it was before the grasp.
        frames: Taken after the lift, straight up; a detector may miss what it still sees in the next.
        config: Thresholds.
        match_radius: Horizontal distance that counts as the old place, m.
        others: What else stood there; those like the object are not taken for it.
        lift: How far the hand has risen, m.
    """
    if not frames:
        return CameraVerdict(Code.STALE_DATA, "no camera frame after the lift")
    twins = [d for d in others if d.label == before.label]
    same = [
        d
        for frame in frames
        for d in frame.detections
        if d.label == before.label and all(apart(d, twin) > match_radius for twin in twins)
    ]
    if not same:
        return CameraVerdict(Code.OK, f"{before.label!r} has gone from its place")
    # The top counts: a detector may take the visible part of a lifted object for a box that reaches down to the table.
    highest = max(same, key=lambda d: d.top)
    risen = highest.top - before.top
    if risen >= config.rise:
        text = f"{before.label!r} is seen {risen * 1e3:.0f} mm higher"
        slipped = before.bottom + lift - highest.top
        if slipped > config.slip_along:
            limit = f"expected at most {config.slip_along * 1e3:.0f} mm"
            return CameraVerdict(
                Code.GRASP_LOST,
                f"{text}, the hand {lift * 1e3:.0f} mm: it has slipped by at least {slipped * 1e3:.0f} mm, {limit}",
            )
        off = sticks_out(highest, before) if highest.measured else 0.0  # a part of it, or of the arm, proves nothing
        if off > config.askew:
            limit = f"expected at most {config.askew * 1e3:.0f} mm"
            return CameraVerdict(
                Code.GRASP_MISSED, f"{text}, {off * 1e3:.0f} mm out of where the hand should hold it, {limit}"
            )
        return CameraVerdict(Code.OK, text)
    distance = min(apart(d, before) for d in same)
    if distance <= match_radius:
        return CameraVerdict(
            Code.GRASP_MISSED, f"{before.label!r} still stands at its place ({distance * 1e3:.0f} mm from it)"
        )
    return CameraVerdict(Code.OK, f"{before.label!r} has left its place ({distance * 1e3:.0f} mm)")


def judge_still(before: Detection, frames: Sequence[Frame], config: HeldConfig) -> tuple[bool, str]:
    """Whether the object still stands where it was seen, as far as the hand above it lets the camera see.

    Args:
        before: The object as it was seen before.
        frames: Taken since; the newest counts.
        config: Thresholds.
    """
    near = (d for d in frames[-1].detections if d.label == before.label) if frames else ()
    nearest = min(near, key=lambda d: apart(d, before), default=None)
    if nearest is None or apart(nearest, before) > _ELSEWHERE:
        return True, "the hand hides the object"
    if max(nearest.size[:2]) > max(before.size[:2]) + config.moved:
        return True, "the hand is in front of the object: what is seen is larger than it"
    off, limit = sticks_out(nearest, before) * 1e3, config.moved * 1e3
    if off > limit:
        return False, f"{before.label!r} has moved: it reaches {off:.0f} mm out of where it stood, expected {limit:.0f}"
    return True, f"{before.label!r} still stands there"


def judge_lift(gripper: GripperVerdict, camera: CameraVerdict) -> Verdict:
    """A lift counts only when gripper and camera agree."""
    if not gripper.ok:
        return gripper
    return Verdict(camera.code, f"{gripper.reason}{'; ' if camera.ok else ', but '}{camera.reason}")


def judge_place(
    label: str,
    p_target: Array,
    frames: Sequence[Frame],
    tolerance: float,
    yaw: float | None = None,
    height: float | None = None,
    footprint: Array | None = None,
) -> CameraVerdict:
    """Whether the camera sees the object at the place target after the arm has left, as it stood before.

    What has turned onto a face of the same size looks as before: that no camera sees.

    Args:
        label: Label of the object.
        p_target: (3,) where its footprint centre should stand, base frame, m; z is that of the table.
        frames: Taken after the arm has left; the newest that shows the object counts.
        tolerance: Largest horizontal distance, m.
        yaw: Yaw of its x axis, where one was asked for, rad; what looks square or round is not judged by it.
        height: Height of the object as it stood, m: one of another height lies on its side. None: it is not judged.
        footprint: (2,) edges of the object as it stood, m: one that leans shows larger ones. None: they are not judged.
    """
    if not frames:
        return CameraVerdict(Code.STALE_DATA, "no camera frame after the place")
    nearest = next((d for frame in reversed(frames) if (d := _nearest(label, p_target, frame)) is not None), None)
    if nearest is None:
        return CameraVerdict(Code.PLACE_FAILED, f"{label!r} is not in view after the place")
    distance = float(np.linalg.norm((nearest.p_base - p_target)[:2]))
    text = f"{label!r} stands {distance * 1e3:.0f} mm from its target"
    if distance > tolerance:
        return CameraVerdict(Code.PLACE_FAILED, f"{text}, expected at most {tolerance * 1e3:.0f} mm")
    top = nearest.top - float(p_target[2])
    if height is not None and abs(top - height) > UPRIGHT_WITHIN:
        was = f"it is {top * 1e3:.0f} mm high there and was {height * 1e3:.0f} mm"
        return CameraVerdict(Code.PLACE_FAILED, f"{label!r} has fallen over: {was}", final=True)
    if footprint is not None:
        sights = [_nearest(label, p_target, frame) for frame in frames]
        larger = [_larger(d, footprint) for d in sights if d is not None and d.measured]
        if larger and min(larger) > FOOTPRINT_WITHIN:
            leans = f"seen from above it is {min(larger) * 1e3:.0f} mm larger than it was"
            return CameraVerdict(Code.PLACE_FAILED, f"{label!r} does not stand upright: {leans}", final=True)
    if yaw is not None and abs(float(nearest.size[0] - nearest.size[1])) > SQUARE_WITHIN:
        off = abs((nearest.yaw - yaw + np.pi / 2.0) % np.pi - np.pi / 2.0)
        text += f", turned {np.degrees(off):.0f}° from what was asked"
        if off > YAW_TOLERANCE:
            return CameraVerdict(Code.PLACE_FAILED, f"{text}, expected at most {np.degrees(YAW_TOLERANCE):.0f}°")
    return CameraVerdict(Code.OK, text)


def _nearest(label: str, p: Array, frame: Frame) -> Detection | None:
    """The object of a frame that is nearest to a point."""
    same = (d for d in frame.detections if d.label == label)
    return min(same, key=lambda d: float(np.linalg.norm((d.p_base - p)[:2])), default=None)


def _larger(d: Detection, footprint: Array) -> float:
    """By how much an edge of what is seen is longer than that of a footprint, m, whichever is the longer one."""
    return float((np.sort(d.size[:2]) - np.sort(footprint)).max())
