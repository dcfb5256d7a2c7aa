# SPDX-License-Identifier: Apache-2.0
"""The end of an attempt judged: where the object goes, how it was put down, the way home. Base frame, m."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code
from openarm_grasp.evidence.evidence import Evidence, Grip, Verdict, judge_grip, judge_place
from openarm_grasp.evidence.observation import Frame, labels_in_view
from openarm_grasp.planning.place import check_position, free_spots, place_targets
from openarm_grasp.strategy import recipes
from openarm_grasp.strategy.effects import Frames, Outcome, Planned
from openarm_grasp.strategy.memory import Judgement, Memory, Surroundings
from openarm_grasp.strategy.states import Event


def offer_places(m: Memory, around: Surroundings, *, origin: bool = False) -> None:
    """Find the ways to put the object down: where it was asked for, on free spots, or where it came from."""
    s = m.need_sighting()
    if origin:
        spots = (s.target.p_base[:2],)
    elif m.request.place is not None:
        spots = (check_position(m.request.place, s.target, s.others, around.table.x, around.table.y),)
    else:
        spots = free_spots(m.arm, s.target, s.others, around.config)
    used = () if origin else m.used_places
    yaw = None if origin else m.request.place_yaw
    m.place_offered = place_targets(s.target, m.need_candidate(), spots, around.config, used, yaw=yaw)


# --- placing
def place(m: Memory, outcome: Outcome, t_ns: int, around: Surroundings) -> Judgement:
    """Planned, then carried, then let go."""
    hand = m.hand
    if outcome.code is Code.GRASP_LOST:
        hand.holding = False
        return m.fail(outcome.code, outcome.message)
    if not outcome.ok and hand.carried and outcome.done >= recipes.RELEASED_AFTER:
        # It was let go; only the way back failed.
        hand.holding, hand.released, hand.at_object = False, True, True
        return Event.DONE, outcome.message
    if not outcome.ok:
        return _put_back(m, outcome, around)
    if m.place_plan is None:
        m.place_plan = outcome.last(Planned)
        m.place_target = m.place_offered[m.place_plan.chosen]
        return Event.MORE, f"carrying to {m.place_target.id}"
    if not hand.carried:
        grip, reason = judge_grip(outcome.last(Evidence), around.config.held, was_held=True)
        if grip is not Grip.HELD:
            hand.holding = False
            return m.fail(Code.GRASP_LOST, f"lost on the way: {reason}")
        hand.carried = True
        return Event.MORE, reason
    hand.holding, hand.released = False, True
    return Event.DONE, "put back where it stood" if hand.putting_back else "put down and let go"


def _put_back(m: Memory, outcome: Outcome, around: Surroundings) -> Judgement:
    """The place cannot be reached: put the object back, or keep it when that cannot be done either."""
    if m.hand.putting_back or m.kept is not None:
        text = f"{outcome.message}; the {m.arm} hand still holds {m.label!r}: open it over a safe place"
        return m.fail(Code.PLACE_FAILED, text, final=True)
    m.fail(Code.PLACE_FAILED, f"{m.label!r} could not be placed ({outcome.code}): {outcome.message}")
    if m.place_plan is not None and m.place_target is not None:
        m.used_places = (*m.used_places, m.place_target)
    m.hand.putting_back, m.hand.carried, m.place_plan = True, False, None
    m.hand.try_again = outcome.code in (Code.EXECUTION_FAILED, Code.TIMEOUT)
    offer_places(m, around, origin=True)
    return Event.MORE, f"{outcome.message}; putting it back"


# --- going home
def reset(m: Memory, outcome: Outcome, t_ns: int, around: Surroundings) -> Judgement:
    """Home, the place checked by the camera; then done, another attempt, or the end."""
    hand = m.hand
    if not hand.homed:
        if not outcome.ok:
            return _no_way_home(m, outcome)
        hand.homed, hand.holding = True, False
        if hand.released and not hand.putting_back:
            return Event.MORE, "home; looking at the place"
    elif not outcome.ok:
        return m.fail(Code.PLACE_FAILED, f"put down, but not seen since: {outcome.message}", final=True)
    else:
        frames, tolerance = outcome.last(Frames).frames, around.config.place.tolerance
        hand.looks += 1
        if m.label not in labels_in_view(frames) and hand.looks < around.config.detect.attempts:
            return Event.MORE, f"{m.label!r} is not in view after the place; looking again"
        m.residual = _beside_the_place(m, frames)
        p_target = m.need_place_target().position
        verdict = judge_place(m.label, p_target, frames, tolerance, m.request.place_yaw, m.height)
        if verdict.ok:
            m.failure = None
            return Event.DONE, f"{verdict.reason}, placed by the {m.arm} arm"
        m.failure = verdict
    failure = m.failure or Verdict(Code.INTERNAL, "RESET without a failure")
    useless = failure.final or (hand.putting_back and not hand.try_again)
    again = not useless and m.attempt < around.config.limits.max_attempts
    return (Event.AGAIN if again else Event.END), failure.reason


def _beside_the_place(m: Memory, frames: Sequence[Frame]) -> tuple[NDArray[np.float64], float] | None:
    """Where the camera sees the placed object beside where the hand let it go, along the hand's opening axis."""
    target = m.need_place_target()
    found = (d for d in (frames[-1].detections if frames else ()) if d.label == m.label and d.measured)
    seen = [d.p_base - target.position for d in found]
    if not seen:
        return None
    axis = target.T_base_tcp[:2, 1] / np.linalg.norm(target.T_base_tcp[:2, 1])
    return axis, float(axis @ min(seen, key=lambda d: float(np.linalg.norm(d[:2])))[:2])


def _no_way_home(m: Memory, outcome: Outcome) -> Judgement:
    hand = m.hand
    hand.retreats += 1
    stuck = hand.holding and outcome.done == 0
    if hand.retreats < 2 and not stuck:
        hand.holding = hand.at_object = False
        return Event.MORE, f"{outcome.message}; trying another way home"
    before = m.failure or Verdict(outcome.code, "")
    keeps = f"; the {m.arm} hand still holds {m.label!r}: open it over a safe place" if stuck else ""
    return m.fail(before.code, f"{before.reason}; the arm could not go home: {outcome.message}{keeps}", final=True)
