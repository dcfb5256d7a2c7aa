# SPDX-License-Identifier: Apache-2.0
"""What the outcome of each state's recipe means: an event for the transition table, and the reason in a sentence.

A judge also writes down what was learned. `OpenArmError` raised by a judge ends the request with its code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.config import DetectConfig
from openarm_grasp.evidence.evidence import Evidence, Grip, Verdict, judge_grip, judge_lift, judge_sight
from openarm_grasp.evidence.judge_end import offer_places, place, reset
from openarm_grasp.evidence.judge_near import move_to_grasp, move_to_pregrasp
from openarm_grasp.evidence.observation import Detection, Sighting, find, labels_in_view, on_table
from openarm_grasp.planning.candidates import propose
from openarm_grasp.planning.options import not_placeable, options_of, planned
from openarm_grasp.planning.place import check_position, other_grasps
from openarm_grasp.planning.routing import arm_order, out_of_reach
from openarm_grasp.strategy.effects import Frames, Outcome, Planned, Reach
from openarm_grasp.strategy.memory import Judgement, Kept, Memory, Surroundings
from openarm_grasp.strategy.states import Event, State


# --- looking
def idle(m: Memory, outcome: Outcome, t_ns: int, around: Surroundings) -> Judgement:
    """The next frame has come, or not: DETECT looks in either case, and counts."""
    return Event.DONE, "the next frame has come" if outcome.ok else outcome.message


def detect(m: Memory, outcome: Outcome, t_ns: int, around: Surroundings) -> Judgement:
    """Frames without the object make the machine wait for the next; no frame at all ends the request."""
    if not outcome.ok:
        return m.fail(outcome.code, outcome.message, final=True)
    m.seen = outcome.last(Frames)
    seen = labels_in_view(m.seen.frames)
    if m.kept is not None:
        return Event.DONE, f"holding {m.label!r}; in view: {', '.join(seen) or 'nothing'}"
    if seen and (not m.request.label or m.request.label in seen):
        return Event.DONE, f"in view: {', '.join(seen)}"
    if not seen:
        text = f"nothing is in view of the camera (asked for {m.request.label or 'any object'!r})"
        return _missed_round(m, Code.NOTHING_DETECTED, text, around)
    return _missed_round(m, Code.UNKNOWN_OBJECT, f"no {m.request.label!r} in view; in view: {', '.join(seen)}", around)


def transform(m: Memory, outcome: Outcome, t_ns: int, around: Surroundings) -> Judgement:
    """One trusted object in the base frame, not older than allowed, and the ways to grasp it."""
    if not outcome.ok:
        if outcome.code is Code.STALE_DATA:
            return _missed_round(m, outcome.code, outcome.message, around)
        return m.fail(outcome.code, outcome.message, final=True)
    m.seen = outcome.last(Frames)
    if m.kept is not None:
        return _place_what_is_held(m, m.kept, t_ns, around)
    limits, table = around.config.detect, around.table
    try:
        sighting = find(m.seen.frames, m.request.label, limits, at=m.request.object_at, leave=m.request.leave)
        target = on_table(sighting.target, table.top_z)
    except OpenArmError as error:
        return _missed_round(m, error.code, error.message, around)
    if old := _too_old(sighting.t_ns, t_ns, limits):
        return _missed_round(m, Code.STALE_DATA, old, around)
    others = _standing(sighting.others, table.top_z)
    m.sighting = Sighting(target, others, sighting.t_ns, sighting.spread)
    if m.height is None or any(d.label == target.label for d in others):
        m.height = float(target.size[2])
    if m.request.place is not None:
        check_position(m.request.place, target, others, table.x, table.y)
    m.options = {}
    m.arms = arm_order(m.request.arm, float(target.p_base[1]), around.config.approach.overlap_half_width)
    _offer_grasps(m, around)
    x, y, z = target.p_base
    return Event.DONE, f"{target.label!r} stands at ({x:.3f}, {y:.3f}, {z:.3f}) m; {len(m.offered)} ways to grasp it"


def _too_old(seen_ns: int, t_ns: int, limits: DetectConfig) -> str:
    """What is said of a sight that is older than allowed; "" of any other."""
    age = (t_ns - seen_ns) * 1e-9
    text = f"the newest detection is {age:.2f} s old, expected at most {limits.max_age:g} s"
    return text if age > limits.max_age else ""


def _standing(found: Iterable[Detection], table_z: float) -> tuple[Detection, ...]:
    """What stands on the table; what is flat on it is in nobody's way."""
    return tuple(on_table(d, table_z) for d in found if d.top > table_z + 0.005)


def _place_what_is_held(m: Memory, kept: Kept, t_ns: int, around: Surroundings) -> Judgement:
    newest = m.need_frames().frames[-1]
    if old := _too_old(newest.t_ns, t_ns, around.config.detect):
        return _missed_round(m, Code.STALE_DATA, old, around)
    others = _standing((d for d in newest.detections if d.label != kept.target.label), around.table.top_z)
    m.sighting, m.candidate = Sighting(kept.target, others, newest.t_ns, 0.0), kept.candidate
    m.height = float(kept.target.size[2])
    offer_places(m, around)
    return Event.SKIP, f"the {m.arm} hand holds {m.label!r}; {len(m.place_offered)} ways to place it"


def _missed_round(m: Memory, code: Code, reason: str, around: Surroundings) -> Judgement:
    """One more round of frames without a trusted object: wait for the next, or give up."""
    m.detect_rounds += 1
    final = m.detect_rounds >= around.config.detect.attempts
    if m.attempt > 1 and m.failure is not None:
        # What went wrong with the arm says more than the object that is missing since.
        before = m.failure
        return m.fail(before.code, f"{before.reason}; then {reason}" if final else before.reason, final=final)
    return m.fail(code, reason, final=final)


# --- planning
def plan(m: Memory, outcome: Outcome, t_ns: int, around: Surroundings) -> Judgement:
    """A plan of the grasp (and of the place, where one is asked for or nothing shall move); else the next arm."""
    if m.probed:
        return _no_plan(m, outcome, around)
    if not outcome.ok:
        if m.grasp_plan is None:
            m.options = planned(m.options, m.arm, m.offered, -1, outcome.refusals, ())
        return _next_arm(m, outcome, around)
    done = outcome.last(Planned)
    if m.grasp_plan is None:
        m.options = planned(m.options, m.arm, m.offered, done.chosen, done.refusals, done.limit_margins)
        m.grasp_plan, m.candidate = done, m.offered[done.chosen]
        chosen = f"grasp {m.candidate.id} with the {m.arm} arm"
        # Also without a wish for the place: no free spot is a reason not to lift.
        offer_places(m, around)
        if m.request.dry_run or m.request.place is not None:
            return Event.MORE, f"{chosen}; planning the place"
        return Event.DONE, chosen
    # This plan starts at the end of the lift and shows that the place can be reached; PLACE plans from where the arm
    # then is.
    m.place_target = m.place_offered[done.chosen]
    chosen = f"grasp {m.need_candidate().id} with the {m.arm} arm, place {m.place_target.id}"
    if m.request.dry_run:
        m.failure = None
        return Event.END, f"can be done: {chosen}"
    return Event.DONE, chosen


def _next_arm(m: Memory, outcome: Outcome, around: Surroundings) -> Judgement:
    reason = outcome.message
    if m.grasp_plan is not None:
        m.place_refused = True
        reason = f"it could grasp, but not place: {reason.removeprefix(f'{m.arm} arm: ')}"
        # Held by other faces or leaning otherwise, it may come to stand where it is wanted.
        target = m.need_sighting().target
        failed = m.need_candidate()
        others = other_grasps(m.offered, failed, outcome.code, target, m.request.place_yaw)
        dropped = [c for c in m.offered if c not in others]
        m.options = not_placeable(m.options, m.arm, dropped, failed, Verdict(outcome.code, reason))
        if others:
            m.offered, m.candidate, m.grasp_plan, m.place_target = others, None, None, None
            return Event.MORE, f"{reason}; trying another grasp"
    m.refusals[m.arm] = Verdict(outcome.code, reason)
    m.candidate = m.grasp_plan = m.place_target = None
    m.arms = m.arms[1:]
    if m.arms:
        _offer_grasps(m, around)
        return Event.MORE, f"{reason}; trying the {m.arm} arm"
    m.arm = ""
    if not m.place_refused and all(v.code is Code.UNREACHABLE for v in m.refusals.values()):
        m.probed = True
        return Event.MORE, "out of reach; asking how near the arms come"
    return _no_plan(m, outcome, around)


def _no_plan(m: Memory, outcome: Outcome, around: Surroundings) -> Judgement:
    m.plans_failed += 1
    final = m.plans_failed >= around.config.limits.plan_attempts
    codes = {v.code for v in m.refusals.values()}
    reason = "; ".join(f"{arm} arm: {v.reason.removeprefix(f'{arm} arm: ')}" for arm, v in m.refusals.items())
    if m.probed:
        distances = outcome.last(Reach).distances if outcome.ok else {}
        x, y, z = m.need_sighting().target.p_base
        reason = f"{out_of_reach(f'{m.label!r} at ({x:.3f}, {y:.3f}, {z:.3f}) m', distances)} ({reason})"
    return m.fail(codes.pop() if len(codes) == 1 else Code.NO_PLAN, reason, final=final)


def _offer_grasps(m: Memory, around: Surroundings) -> None:
    m.arm = m.arms[0]
    s, shoulder = m.need_sighting(), around.shoulders.get(m.arm, (0.0, 0.0))
    m.offered = propose(s.target, around.config, shoulder_xy=shoulder, used=m.used, others=s.others)
    m.options |= options_of(m.arm, m.offered, s.target, around.config.approach)


# --- grasping
def close_gripper(m: Memory, outcome: Outcome, t_ns: int, around: Surroundings) -> Judgement:
    """Gap, effort and rest say whether something of the right width is between the fingers."""
    if not outcome.ok:
        return m.fail(outcome.code, outcome.message)
    grip, reason = judge_grip(outcome.last(Evidence), around.config.held)
    if grip is not Grip.HELD:
        return m.fail(grip.code, reason)
    m.hand.holding = True
    return Event.DONE, reason


def lift(m: Memory, outcome: Outcome, t_ns: int, around: Surroundings) -> Judgement:
    """Held by the hand and gone from its place for the camera: two kinds of evidence."""
    if not outcome.ok:
        m.hand.holding = m.hand.holding and outcome.code is not Code.GRASP_LOST
        return m.fail(outcome.code, outcome.message)
    held = around.config.held
    grip = judge_grip(outcome.last(Evidence), held, was_held=True)
    frames = outcome.last(Frames).frames
    s, radius = m.need_sighting(), around.config.detect.match_radius
    sight = judge_sight(s.target, frames, held, match_radius=radius, others=s.others)
    verdict = judge_lift(grip, sight)
    if not verdict.ok:
        m.hand.holding = grip[0] is Grip.HELD
        return m.fail(verdict.code, verdict.reason)
    if m.request.phase == "pick":
        m.failure = None
        return Event.SKIP, f"{verdict.reason}; the {m.arm} hand keeps it"
    m.hand.at_object = False
    return Event.DONE, verdict.reason


# --- trying again
def start_over(m: Memory, came_from: State) -> None:
    """Look again; after a physical attempt with the next number, the failed grasp marked, the object's name kept."""
    if came_from is State.RESET:
        at = m.request.object_at and tuple(m.need_sighting().target.p_base[:2].tolist())
        phase = "all" if m.kept else m.request.phase
        m.request = replace(m.request, label=m.label, phase=phase, object_at=at)
        m.used = m.used | {m.candidate.id} if m.candidate else m.used
        m.attempt += 1
        m.detect_rounds = m.plans_failed = 0
    m.forget_sight()


Judge = Callable[[Memory, Outcome, int, Surroundings], Judgement]
#: The judge of each state.
JUDGES: Mapping[State, Judge] = MappingProxyType(
    {
        State.IDLE: idle,
        State.DETECT: detect,
        State.TRANSFORM: transform,
        State.PLAN: plan,
        State.MOVE_TO_PREGRASP: move_to_pregrasp,
        State.MOVE_TO_GRASP: move_to_grasp,
        State.CLOSE_GRIPPER: close_gripper,
        State.LIFT: lift,
        State.PLACE: place,
        State.RESET: reset,
    }
)
