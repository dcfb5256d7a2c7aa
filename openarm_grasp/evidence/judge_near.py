# SPDX-License-Identifier: Apache-2.0
"""The pre-grasp judged: the way there, the second look from there, the correction that it asks for, and the way down.

The camera over the table says roughly where the object is; the camera on the hand, a hand's breadth away, says it
better. Whatever keeps the second look from helping, the grasp goes on with what is known. Base frame, m.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.evidence.evidence import Evidence, judge_still
from openarm_grasp.evidence.observation import Detection, Frame, apart, find, on_table
from openarm_grasp.planning.candidates import GraspCandidate, propose
from openarm_grasp.strategy.effects import Frames, Outcome, Planned
from openarm_grasp.strategy.memory import Judgement, Memory, Surroundings
from openarm_grasp.strategy.states import Event


def move_to_pregrasp(m: Memory, outcome: Outcome, t_ns: int, around: Surroundings) -> Judgement:
    """The arm came to the pre-grasp with an open hand, or not; then the second look."""
    hand, near = m.hand, around.config.near
    if hand.near == "look":
        return _seen_from_near(m, outcome, around)
    if hand.near == "plan":
        return _corrected_plan(m, outcome)
    if not outcome.ok:
        return m.fail(outcome.code, outcome.message)
    if hand.near == "" and near.enabled and m.arm == near.arm:
        hand.near = "look"
        return Event.MORE, f"the open hand is before the object; looking with the {near.camera} camera"
    return Event.DONE, "the open hand is before the object"


def move_to_grasp(m: Memory, outcome: Outcome, t_ns: int, around: Surroundings) -> Judgement:
    """A last look, because the camera on the hand is not everywhere and time has passed; then the straight way down.

    A hand that stops short has met the object.
    """
    if not m.hand.looked:
        if not outcome.ok:
            return m.fail(outcome.code, outcome.message)
        m.hand.looked = True
        target = m.need_sighting().target
        still, reason = judge_still(target, outcome.last(Frames).frames, around.config.held)
        if not still and m.moved_from is not None and apart(target, m.moved_from) < around.config.detect.agree_within:
            still, reason = True, f"{reason}; so it seemed before, and it had not: the hand hides a part of it"
        m.moved_from = target
        return (Event.MORE, reason) if still else m.fail(Code.GRASP_MISSED, reason)
    m.hand.at_object = True
    if not outcome.ok:
        return m.fail(outcome.code, outcome.message)
    error, limit = outcome.last(Evidence).tcp_error, around.config.held.max_tcp_error
    if error > limit:
        text = f"the hand stopped {error * 1e3:.1f} mm from the grasp, expected at most {limit * 1e3:.0f} mm"
        return m.fail(Code.HAND_COLLISION, text)
    return Event.DONE, f"the hand is at the grasp, off by {error * 1e3:.1f} mm"


def _seen_from_near(m: Memory, outcome: Outcome, around: Surroundings) -> Judgement:
    if not outcome.ok:
        return Event.DONE, f"no second look: {outcome.message}"
    before, config = m.need_sighting(), around.config
    frames = [_near(frame, before.target, config.near.largest) for frame in outcome.last(Frames).frames]
    try:
        target = on_table(find(frames, m.label, config.detect).target, around.table.top_z)
        candidate = _same_way(m.need_candidate(), propose(target, config))
    except OpenArmError as error:
        return Event.DONE, f"the second look does not help: {error.message}"
    dx, dy, _ = target.p_base - before.target.p_base
    size = float(np.hypot(dx, dy))
    text = f"the {config.near.camera} camera sees it {size * 1e3:.1f} mm off ({dx * 1e3:+.1f}, {dy * 1e3:+.1f})"
    if size < config.near.least:
        return Event.DONE, text
    m.sighting = replace(before, target=target)
    m.offered, m.hand.near = (candidate,), "plan"
    return Event.MORE, f"{text}; correcting"


def _near(frame: Frame, target: Detection, largest: float) -> Frame:
    """The detections of a frame that may be the object."""
    kept = (d for d in frame.detections if d.label == target.label and apart(d, target) <= largest)
    return Frame(frame.t_ns, tuple(kept))


def _same_way(chosen: GraspCandidate, offered: tuple[GraspCandidate, ...]) -> GraspCandidate:
    """The candidate whose hand stands most like the chosen one's: a box seen anew may have its edges swapped."""
    return min(offered, key=lambda c: se3.angle_between(c.T_base_tcp[:3, :3], chosen.T_base_tcp[:3, :3]))


def _corrected_plan(m: Memory, outcome: Outcome) -> Judgement:
    if not outcome.ok:
        return Event.DONE, f"the correction cannot be planned, going on without: {outcome.message}"
    m.grasp_plan, m.candidate, m.hand.near = outcome.last(Planned), m.offered[0], "go"
    return Event.MORE, f"correcting to {m.candidate.id}"
