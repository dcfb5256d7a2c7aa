# SPDX-License-Identifier: Apache-2.0
"""What each state does, as a recipe: effects in order, each started when the one before it has succeeded."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from openarm_grasp.planning.candidates import UP, Box, held_box, obstacle_boxes, shifted, target_box
from openarm_grasp.planning.routing import ARMS, arm_order
from openarm_grasp.strategy.effects import (
    Effects,
    Execute,
    GoHome,
    Measure,
    MoveGripper,
    MoveLinear,
    Observe,
    PlanGrasp,
    PlanPlace,
    ProbeReach,
    ToBase,
    Together,
    Wait,
)
from openarm_grasp.strategy.memory import Memory, Surroundings
from openarm_grasp.strategy.states import State

#: Frames that must not show the object in its old place after the lift: a detector may miss it in one.
_LIFT_FRAMES = 2
#: In the last recipe of PLACE, the object is free once this many effects are done (the way down, and opening).
RELEASED_AFTER = 2


def idle(m: Memory, around: Surroundings) -> Effects:
    """Wait for the next frame."""
    return (Observe(1),)


def detect(m: Memory, around: Surroundings) -> Effects:
    """Clear the camera's view, then look. A dry run moves nothing."""
    look = Observe(around.config.detect.frames)
    if m.kept is not None:
        # The hand that holds something stays where it is; it may be among the objects.
        others = tuple(arm for arm in ARMS if arm != m.kept.arm)
        return (look,) if m.detect_rounds > 0 else (GoHome(others), look)
    if m.request.dry_run or m.detect_rounds > 0 or m.plans_failed > 0:
        return (look,)
    return (GoHome(ARMS, back_off_below=around.table.top_z + 2.0 * around.config.approach.lift_height), look)


def transform(m: Memory, around: Surroundings) -> Effects:
    """Bring the frames to the base frame."""
    seen = m.need_frames()
    return (ToBase(seen.frames, seen.frame_id),)


def plan(m: Memory, around: Surroundings) -> Effects:
    """Plan the grasp with the next arm; where the place matters before the lift, plan it from the lift's end."""
    s, config = m.need_sighting(), around.config
    if m.probed:
        arms = arm_order(m.request.arm, float(s.target.p_base[1]), config.approach.overlap_half_width)
        return (ProbeReach(arms, m.offered[0].T_base_tcp),)
    obstacles = obstacle_boxes(s.others, config)
    if m.grasp_plan is None:
        return (PlanGrasp(m.arm, m.offered, obstacles, target_box(s.target, config)),)
    held, stood = held_box(s.target, m.need_candidate(), config), (target_box(s.target, config),)
    return (PlanPlace(m.arm, m.place_offered, obstacles, held, m.grasp_plan.retreat, stood),)


def move_to_pregrasp(m: Memory, around: Surroundings) -> Effects:
    """Open the hand on the way to the pre-grasp; then look from near, and go where the object was seen from there."""
    if m.hand.near == "look":
        return (Observe(around.config.near.frames, near=True),)
    if m.hand.near == "plan":
        s, config = m.need_sighting(), around.config
        return (PlanGrasp(m.arm, m.offered, obstacle_boxes(s.others, config), target_box(s.target, config)),)
    if m.hand.near == "go":
        return (Execute(m.arm, m.need_grasp_plan().transfer, "move to where it was seen from near"),)
    go = Execute(m.arm, m.need_grasp_plan().transfer, "move to the pre-grasp")
    return (Together((MoveGripper(m.arm, around.config.hand.opening, "open"), go)),)


def move_to_grasp(m: Memory, around: Surroundings) -> Effects:
    """See that the object still stands there; then the straight last part, and where the hand came to."""
    if not m.hand.looked:
        return (Observe(1),)
    c = m.need_candidate()
    go = Execute(m.arm, m.need_grasp_plan().approach, "move to the grasp")
    return (go, Measure(m.arm, c.width, c.T_base_tcp))


def close_gripper(m: Memory, around: Surroundings) -> Effects:
    """Pause, close until the fingers stop, let them settle, read them."""
    c, timing = m.need_candidate(), around.config.timing
    return (
        Wait(timing.pause_at_grasp),
        MoveGripper(m.arm, 0.0, "close", around.config.hand.close_effort),
        Wait(timing.after_close),
        Measure(m.arm, c.width, c.T_base_tcp, settle=timing.settle_limit),
    )


def lift(m: Memory, around: Surroundings) -> Effects:
    """Straight up, then ask hand and camera."""
    go = Execute(m.arm, m.need_grasp_plan().retreat, "lift", carrying=True)
    measure = Measure(m.arm, m.need_candidate().width, settle=around.config.timing.settle_limit)
    return (go, measure, Observe(_LIFT_FRAMES))


def place(m: Memory, around: Surroundings) -> Effects:
    """Plan from where the arm is; carry and look at the hand; put down, let go, leave."""
    s, c, config = m.need_sighting(), m.need_candidate(), around.config
    if m.place_plan is None:
        held, stood = held_box(s.target, c, config), (target_box(s.target, config),)
        return (PlanPlace(m.arm, m.place_offered, obstacle_boxes(s.others, config), held, gone=stood),)
    if not m.hand.carried:
        carry = Execute(m.arm, m.place_plan.transfer, "carry", carrying=True)
        return (carry, Measure(m.arm, c.width, settle=config.timing.settle_limit))
    return (
        Execute(m.arm, m.place_plan.approach, "put down", carrying=True),
        MoveGripper(m.arm, config.hand.opening, "release"),
        Wait(config.timing.after_release),
        Execute(m.arm, m.place_plan.retreat, "leave"),
    )


def reset(m: Memory, around: Surroundings) -> Effects:
    """Leave the object (putting it down first when it is held), go home with an open hand, and look at the place."""
    c, hand, config = m.need_candidate(), m.hand, around.config
    if hand.homed:
        return (Observe(config.detect.frames),)
    home = GoHome((m.arm,), () if hand.retreats else _obstacles_on_the_way_home(m, around))
    leave: Effects = (MoveGripper(m.arm, config.hand.opening, "open"), Wait(config.timing.after_release))
    if hand.released:
        target = m.need_place_target()
        back = MoveLinear(m.arm, shifted(target.T_base_tcp, target.retreat_offset), "leave")
        return (back, home) if hand.at_object else (home,)
    if not hand.at_object:
        return (*leave, home)
    back = MoveLinear(m.arm, shifted(c.T_base_tcp, c.approach_offset), "back off")
    if hand.holding:
        down = shifted(c.T_base_tcp, config.place.release_height * UP)
        return (MoveLinear(m.arm, down, "put back"), *leave, back, home)
    return (*leave, back, home)


def _obstacles_on_the_way_home(m: Memory, around: Surroundings) -> tuple[Box, ...]:
    s, config = m.need_sighting(), around.config
    others = obstacle_boxes(s.others, config)
    if not m.hand.released:
        # Where a lost object lies is not known.
        return others
    held = held_box(s.target, m.need_candidate(), config)
    return (*others, Box(f"placed/{m.label}", m.need_place_target().T_base_tcp @ held.T_frame_box, held.size))


Recipe = Callable[[Memory, Surroundings], Effects]
#: The recipe of each state.
RECIPES: Mapping[State, Recipe] = MappingProxyType(
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
