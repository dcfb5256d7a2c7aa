# SPDX-License-Identifier: Apache-2.0
"""Verdicts, and those on the hand: whether it holds an object, or has gone along a line, by what its joints say.

A command that was sent proves nothing. Two kinds of evidence that do not depend on each other are needed: the hand, and
the camera (`openarm_grasp.evidence.camera`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openarm_common.errors import Code
from openarm_common.robot.zeros import HandReach
from openarm_common.types import Array
from openarm_grasp.config import HeldConfig

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


class HandVerdict(Verdict):
    """What the joints say of a hand: that it holds the object, or has pushed it along."""


class CameraVerdict(Verdict):
    """What a camera says of the object and its place."""


def judge_grip(
    e: Evidence,
    config: HeldConfig,
    *,
    was_held: bool = False,
    apertures: tuple[float, float] | None = None,
    closed: float | None = None,
) -> HandVerdict:
    """Whether the hand holds the object: GRASP_MISSED, when it is empty or moves; HAND_COLLISION; GRASP_LOST.

    Args:
        e: State of the gripper's joint.
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
        return HandVerdict(
            Code.HAND_COLLISION, f"the hand is {off:.1f} mm from the grasp, expected at most {limit:.0f} mm"
        )
    if e.empty(config):
        return HandVerdict(empty, f"{gap}: the fingers are closed on nothing{outdated(e.gap, e.reach)}")
    if closed is not None:
        if abs(e.gap - closed) > config.slip:
            was, limit = f"{closed * 1e3:.1f} mm when the hand had closed", f"at most {config.slip * 1e3:.0f} mm"
            why = f"{gap}, {was}: the object has turned or slipped in the hand, expected a change of {limit}"
            return HandVerdict(Code.GRASP_LOST, why)
    elif e.gap > most + config.width_tolerance:
        return HandVerdict(Code.HAND_COLLISION, f"{gap} is wider than {width}: the fingers are not around it")
    elif e.gap < least - config.width_tolerance:
        return HandVerdict(empty, f"{gap} is narrower than {width}: something else is between the fingers")
    if abs(e.speed) >= config.max_speed:
        return HandVerdict(Code.GRASP_MISSED, f"{gap} changes by {abs(e.speed) * 1e3:.1f} mm/s, expected rest")
    if config.use_effort and abs(e.effort) <= config.min_effort:
        return HandVerdict(
            empty, f"{gap}, but the fingers press with {abs(e.effort):.1f} N, expected over {config.min_effort:g} N"
        )
    if config.use_finger_force and min(e.pads, default=0.0) < config.min_pad_force:
        felt = f"a finger pad feels {min(e.pads):.1f} N" if e.pads else "no sensor reports the force on the finger pads"
        return HandVerdict(
            empty, f"{gap}, but {felt}, expected {config.min_pad_force:g} N on each (held.use_finger_force)"
        )
    force = f", {abs(e.effort):.0f} N" if config.use_effort else ""
    return HandVerdict(Code.OK, f"{gap} for {e.expected * 1e3:.1f} mm{force}: held")


def outdated(gap: float, reach: HandReach | None) -> str:
    """Return what is said of a hand that closes farther than was learned of it; "" of any other."""
    if reach is None or gap >= 2.0 * reach.closed - _OUTDATED:
        return ""
    return f"; this hand goes from {reach}: were its fingers exchanged? {learn_command()} learns it again"


def learn_command(arm: str = "") -> str:
    """Return what to type to learn a hand, for messages; "": those of all arms."""
    return f"`openarm hardware learn-hand{f' --arm {arm}' if arm else ''}`"


def judge_path(start: Array, end: Array, line: Array, least: float) -> HandVerdict:
    """Whether a hand has gone along a line: EXECUTION_FAILED, when it has not gone far enough.

    Args:
        start: (3,) where the tool centre point was measured before, m.
        end: (3,) where it was measured afterwards, m.
        line: (3,) where it should have gone from there, m.
        least: Least distance along it, m.
    """
    along = float((end - start) @ line) / float(np.linalg.norm(line))
    text = f"the hand went {along * 1e3:.0f} mm along its line of {np.linalg.norm(line) * 1e3:.0f} mm"
    if along < least:
        return HandVerdict(Code.EXECUTION_FAILED, f"{text}, expected at least {least * 1e3:.0f} mm")
    return HandVerdict(Code.OK, text)


def judge_lift(gripper: HandVerdict, camera: CameraVerdict) -> Verdict:
    """A lift counts only when gripper and camera agree."""
    if not gripper.ok:
        return gripper
    return Verdict(camera.code, f"{gripper.reason}{'; ' if camera.ok else ', but '}{camera.reason}")
