# SPDX-License-Identifier: Apache-2.0
"""The state machine against a scripted world with a clock of its own: no ROS, no sleeping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.scene import Table
from openarm_grasp import effects as fx
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence import Evidence
from openarm_grasp.machine import GraspMachine
from openarm_grasp.memory import Surroundings
from openarm_grasp.observation import Detection, Frame
from openarm_grasp.states import State

Fault = Callable[[fx.Effect], OpenArmError | None]


def box(label: str, x: float, y: float, size: float = 0.05, z: float = 0.4) -> Detection:
    return Detection(label, 0.9, se3.make(p=(x, y, z + size / 2.0)), np.array([size, size, size]))


class World:
    """Carries recipes out on a table in the head: objects, one hand, a clock, and faults by name."""

    def __init__(self, *objects: Detection, **config: object) -> None:
        self.objects = {d.label: d for d in objects}
        self.t_ns = 1_000_000_000
        self.gap = 0.0
        self.held: str | None = None
        self.faults: list[Fault] = []
        self.log: list[tuple[float, fx.Effect]] = []
        self.states: list[State] = []
        self.slips = 0  # closes that get nothing
        self.tcp_error = 0.0
        self.place_error = 0.0
        self.frame_age = 0.0
        self.machine = GraspMachine(
            Surroundings(
                GraspConfig.model_validate({"near": {"enabled": False}, **config}),
                Table(),
                {"left": (0.0, 0.15), "right": (0.0, -0.15)},
            )
        )
        self._target = np.zeros(3)
        self._label = ""

    # --- running
    def grasp(self, label: str = "red", **kwargs) -> fx.GraspOutcome:
        recipe = self.machine.step(fx.GraspRequest(label, **kwargs), self.t_ns)
        self.states = [self.machine.state]
        for _ in range(400):
            if not recipe:
                outcome = self.machine.outcome
                assert outcome is not None
                assert self.machine.state is State.IDLE
                return outcome
            recipe = self.machine.step(self.perform(recipe), self.t_ns)
            self.states.append(self.machine.state)
        raise AssertionError("the grasp did not end")

    def perform(self, recipe: fx.Effects) -> fx.Outcome:
        results = []
        for done, effect in enumerate(recipe):
            for part in effect.effects if isinstance(effect, fx.Together) else (effect,):
                self.log.append((self.t_ns * 1e-9, part))
                for fault in self.faults:
                    error = fault(part)
                    if error is not None:
                        return fx.Outcome(error.code, error.message, tuple(results), done)
                result = self.carry_out(part)
                if result is not None:
                    results.append(result)
        return fx.Outcome(results=tuple(results), done=len(recipe))

    def carry_out(self, effect: fx.Effect) -> fx.Result | None:
        match effect:
            case fx.Wait():
                self.pass_time(effect.duration)
            case fx.Observe():
                return self.frames(effect.frames)
            case fx.ToBase():
                return fx.Frames(effect.frames, "base")
            case fx.PlanGrasp():
                self._label = effect.target.id.removeprefix("target/")
                return fx.Planned(0, "transfer", "approach", "lift")
            case fx.PlanPlace():
                self._target = effect.targets[0].position
                return fx.Planned(0, "carry", "put down", "leave")
            case fx.ProbeReach():
                return fx.Reach(dict.fromkeys(effect.arms, 0.2))
            case fx.Execute():
                self.pass_time(1.0)
                if effect.trajectory == "lift" and self.held:
                    self.objects.pop(self.held)
            case fx.GoHome() | fx.MoveLinear():
                self.pass_time(1.0)
            case fx.MoveGripper():
                self.pass_time(0.6)
                self.move_gripper(effect.position)
            case fx.Measure():
                effort = -30.0 if self.held else 0.0
                error = self.tcp_error if effect.T_base_tcp is not None else 0.0
                return Evidence(self.gap, effect.expected, effort, 0.0, error)
            case _:
                raise AssertionError(effect)
        return None

    def move_gripper(self, position: float) -> None:
        if position > 0.0:
            if self.held:
                x, y, _ = self._target
                self.objects[self.held] = box(self.held, x + self.place_error, y)
            self.held, self.gap = None, 2.0 * position
        elif self.slips or self._label not in self.objects:
            self.slips, self.gap = max(0, self.slips - 1), 0.0
        else:
            self.held, self.gap = self._label, float(self.objects[self._label].size[0])

    def frames(self, count: int) -> fx.Frames:
        seen = tuple(self.objects.values())
        found = []
        for _ in range(count):
            self.pass_time(0.1)
            found.append(Frame(self.t_ns - round(self.frame_age * 1e9), seen))
        return fx.Frames(tuple(found), "base")

    def pass_time(self, seconds: float) -> None:
        self.t_ns += round(seconds * 1e9)

    # --- what happened
    def done(self, kind: type) -> list:
        return [effect for _, effect in self.log if isinstance(effect, kind)]

    def times(self, chosen: Callable[[fx.Effect], bool]) -> list[float]:
        return [t for t, effect in self.log if chosen(effect)]


def fail_on(chosen: Callable[[fx.Effect], bool], code: Code, times: int = 10**6) -> Fault:
    left = [times]

    def fault(effect: fx.Effect) -> OpenArmError | None:
        if left[0] > 0 and chosen(effect):
            left[0] -= 1
            return OpenArmError(code, f"{type(effect).__name__} failed on purpose")
        return None

    return fault


def is_execute(trajectory: str) -> Callable[[fx.Effect], bool]:
    return lambda effect: isinstance(effect, fx.Execute) and effect.trajectory == trajectory


def is_gripper(opening: bool) -> Callable[[fx.Effect], bool]:
    return lambda effect: isinstance(effect, fx.MoveGripper) and (effect.position > 0.0) == opening


@pytest.fixture
def world() -> World:
    return World(box("red", 0.26, -0.2), box("blue", 0.26, 0.2))


# --- success
def test_b06_b57_a_grasp_goes_through_all_states_in_order(world):
    outcome = world.grasp()
    assert outcome.success, outcome.message
    assert (outcome.arm, outcome.attempts, outcome.label) == ("right", 1, "red")
    order = [s for i, s in enumerate(world.states) if i == 0 or s is not world.states[i - 1]]
    assert order == [*list(State)[1:], State.IDLE]
    assert np.linalg.norm(world.objects["red"].p_base[:2] - outcome.place_position[:2]) < 1e-9
    assert outcome.duration == pytest.approx((world.t_ns - 1_000_000_000) * 1e-9)


def test_b51_the_hand_opens_on_the_way_to_the_pregrasp(world):
    machine_step, seen = world.machine.step, []
    world.machine.step = lambda event, t: seen.append(machine_step(event, t)) or seen[-1]
    world.grasp()
    together = next(e for recipe in seen for e in recipe if isinstance(e, fx.Together))
    assert [type(e) for e in together.effects] == [fx.MoveGripper, fx.Execute]
    assert together.effects[0].position == 0.044
    assert together.effects[1].trajectory == "transfer"


def test_b52_b53_b54_pause_close_wait_lift(world):
    world.grasp()
    (close,) = world.times(is_gripper(False))
    (arrive,) = world.times(is_execute("approach"))
    (lift,) = world.times(is_execute("lift"))
    assert close - (arrive + 1.0) == pytest.approx(0.5)  # the motion takes 1 s
    assert lift - (close + 0.6) == pytest.approx(0.2)  # the fingers take 0.6 s


def test_b54_timing_is_a_parameter():
    world = World(box("red", 0.26, -0.2), timing={"pause_at_grasp": 1.5, "after_close": 0.7})
    world.grasp()
    assert [e.duration for e in world.done(fx.Wait)][:2] == [1.5, 0.7]


def test_b71_the_hand_opens_only_before_the_grasp_and_at_the_place(world):
    world.grasp()
    gripper = [(e.what, e.position) for e in world.done(fx.MoveGripper)]
    assert gripper == [("open", 0.044), ("close", 0.0), ("release", 0.044)]


def test_b01_a_moved_object_is_grasped_where_it_is():
    for x, y in ((0.2, -0.1), (0.3, -0.35), (0.22, 0.31)):
        world = World(box("red", x, y))
        assert world.grasp().success
        (plan,) = world.done(fx.PlanGrasp)
        assert plan.candidates[0].T_base_tcp[:2, 3] == pytest.approx((x, y))


def test_b70_twenty_cycles_unattended(world):
    for _ in range(20):
        assert world.grasp().success
        assert world.machine.state is State.IDLE
    homes = [e.arms for e in world.done(fx.GoHome)]
    assert homes.count(("right",)) == 20


def test_a_place_that_is_asked_for_is_used(world):
    outcome = world.grasp(place=(0.3, -0.35, 0.0))
    assert outcome.success
    assert outcome.place_position == pytest.approx((0.3, -0.35, 0.4))


def test_without_a_label_the_retry_keeps_to_the_same_object():
    world = World(box("red", 0.26, -0.2), replace(box("blue", 0.26, 0.2), score=0.95))
    world.slips = 1
    outcome = world.grasp("")
    assert (outcome.label, outcome.attempts) == ("blue", 2)


def test_others_are_obstacles_and_the_target_may_be_touched(world):
    world.grasp()
    plan = world.done(fx.PlanGrasp)[0]
    assert [b.id for b in plan.obstacles] == ["detected/blue_0"]
    assert plan.target.id == "target/red"


def test_dry_run_plans_both_and_moves_nothing(world):
    outcome = world.grasp(dry_run=True)
    assert outcome.success
    assert outcome.attempts == 0
    assert "can be done" in outcome.message
    assert not world.done(fx.Execute) + world.done(fx.MoveGripper) + world.done(fx.GoHome) + world.done(fx.MoveLinear)
    (place,) = world.done(fx.PlanPlace)
    assert place.after == "lift"


# --- seeing
def test_b58_an_unknown_object_is_refused_with_what_is_in_view(world):
    outcome = world.grasp("mug")
    assert outcome.code is Code.UNKNOWN_OBJECT
    assert outcome.message == "no 'mug' in view; in view: blue, red"
    assert world.states.count(State.DETECT) == 3
    assert State.TRANSFORM not in world.states


def test_an_empty_table_is_named():
    assert World().grasp().code is Code.NOTHING_DETECTED


def test_b58_an_object_that_comes_into_view_is_waited_for():
    world = World(box("blue", 0.26, 0.2))

    def arrive(effect):
        if world.machine.state is State.IDLE:
            world.objects["red"] = box("red", 0.26, -0.2)

    world.faults.append(arrive)
    assert world.grasp().success


def test_p33_a_stale_detection_is_not_acted_on(world):
    world.frame_age = 0.6
    outcome = world.grasp()
    assert outcome.code is Code.STALE_DATA
    assert "0.60 s old" in outcome.message
    assert not world.done(fx.PlanGrasp)


def test_no_frames_end_the_grasp_at_once(world):
    world.faults.append(fail_on(lambda e: isinstance(e, fx.Observe), Code.STALE_DATA))
    outcome = world.grasp()
    assert outcome.code is Code.STALE_DATA
    assert len(world.done(fx.Observe)) == 1


def test_b33_no_transform_means_no_motion(world):
    world.faults.append(fail_on(lambda e: isinstance(e, fx.ToBase), Code.NO_TRANSFORM))
    outcome = world.grasp()
    assert outcome.code is Code.NO_TRANSFORM
    assert not world.done(fx.Execute)


def test_too_wide_is_refused_with_width_and_limit():
    outcome = World(box("red", 0.26, -0.2, size=0.09)).grasp()
    assert outcome.code is Code.TOO_WIDE
    assert "90 mm" in outcome.message
    assert "70 mm" in outcome.message


# --- planning
def test_b58_a_failed_plan_looks_again(world):
    world.faults.append(fail_on(lambda e: isinstance(e, fx.PlanGrasp), Code.NO_PLAN, times=1))
    outcome = world.grasp()
    assert outcome.success
    assert world.states.count(State.PLAN) == 2
    assert outcome.attempts == 1


def test_out_of_reach_names_the_reason_and_the_nearest_arm(world):
    world.faults.append(fail_on(lambda e: isinstance(e, fx.PlanGrasp), Code.UNREACHABLE))
    outcome = world.grasp()
    assert outcome.code is Code.UNREACHABLE
    assert "right arm gets within 200 mm" in outcome.message
    assert len(world.done(fx.PlanGrasp)) == 2  # plan_attempts
    assert outcome.attempts == 0


def test_in_the_overlap_the_second_arm_is_tried():
    world = World(box("red", 0.26, -0.05))
    world.faults.append(fail_on(lambda e: isinstance(e, fx.PlanGrasp) and e.arm == "right", Code.NO_PLAN))
    outcome = world.grasp()
    assert outcome.success
    assert outcome.arm == "left"


def test_a_place_out_of_reach_is_refused_before_anything_moves(world):
    world.faults.append(fail_on(lambda e: isinstance(e, fx.PlanPlace), Code.UNREACHABLE))
    outcome = world.grasp(place=(0.75, -0.5))
    assert outcome.code is Code.UNREACHABLE
    assert "could grasp, but not place" in outcome.message
    assert not world.done(fx.Execute)


def test_a_place_off_the_table_is_refused(world):
    assert world.grasp(place=(2.0, 0.0)).code is Code.INVALID_ARGUMENT


# --- grasping
def test_a70_a_miss_opens_backs_off_and_tries_another_way(world):
    world.slips = 1
    outcome = world.grasp()
    assert outcome.success
    assert outcome.attempts == 2
    missed = world.log[world.log.index(next(x for x in world.log if is_gripper(False)(x[1]))) :]
    kinds = [type(e) for _, e in missed[3:8]]
    assert kinds == [fx.MoveGripper, fx.Wait, fx.MoveLinear, fx.GoHome, fx.GoHome]
    first, second = world.done(fx.PlanGrasp)
    assert first.candidates[0].id == second.candidates[-1].id


def test_a71_without_an_object_the_grasp_fails():
    """The object disappears after its detection: three attempts at most, never a success."""
    world = World(box("red", 0.26, -0.2))
    world.faults.append(lambda e: world.objects.clear() if isinstance(e, fx.PlanGrasp) else None)
    outcome = world.grasp()
    assert outcome.code is Code.GRASP_MISSED
    assert "nothing is in view" in outcome.message
    assert outcome.attempts == 1


def test_three_misses_end_with_a_named_refusal_open_hand_and_home(world):
    world.slips = 99
    outcome = world.grasp()
    assert outcome.code is Code.GRASP_MISSED
    assert outcome.attempts == 3
    assert world.gap == pytest.approx(0.088)
    assert isinstance(world.log[-1][1], fx.GoHome)
    assert world.machine.carrying == ""


def test_a_hand_that_stops_short_has_met_the_object(world):
    world.tcp_error = 0.02
    outcome = world.grasp()
    assert outcome.code is Code.HAND_COLLISION
    assert "20.0 mm" in outcome.message
    assert not world.times(is_gripper(False))


def test_p08_held_but_still_seen_in_its_place_is_put_back(world):
    """The hand has something, but the camera says it is not the object: no success, and nothing is dropped."""
    real = world.carry_out

    def carry_out(effect):
        if is_execute("lift")(effect):
            world.pass_time(1.0)
            return None
        return real(effect)

    world.carry_out = carry_out
    outcome = world.grasp()
    assert outcome.code is Code.GRASP_MISSED
    assert "still stands at its place" in outcome.message
    linear = [e.what for e in world.done(fx.MoveLinear)]
    assert linear == ["put back", "back off"] * 3


def test_lost_on_the_way_is_found_again(world):
    def drop_once(effect):
        if not is_execute("carry")(effect) or world.machine.attempt > 1:
            return None
        world.objects["red"] = box("red", 0.3, -0.3)
        world.held, world.gap = None, 0.0
        return OpenArmError(Code.GRASP_LOST, "dropped on purpose")

    world.faults.append(drop_once)
    outcome = world.grasp()
    assert outcome.success
    assert outcome.attempts == 2


# --- placing
def test_p09_a_place_that_is_not_seen_within_2_cm_is_tried_again(world):
    world.place_error = 0.03
    outcome = world.grasp()
    assert outcome.code is Code.PLACE_FAILED
    assert "30 mm from its target" in outcome.message
    assert outcome.attempts == 3


def test_a_place_that_cannot_be_planned_puts_the_object_back(world):
    world.faults.append(fail_on(lambda e: isinstance(e, fx.PlanPlace), Code.NO_PLAN, times=1))
    outcome = world.grasp()
    assert outcome.code is Code.PLACE_FAILED
    assert world.objects["red"].p_base[:2] == pytest.approx((0.26, -0.2))
    assert world.machine.carrying == ""
    assert outcome.place_position == (0.0, 0.0, 0.0)


def test_a_carry_that_was_blocked_puts_the_object_back_and_tries_again(world):
    world.faults.append(fail_on(is_execute("carry"), Code.EXECUTION_FAILED, times=1))
    outcome = world.grasp()
    assert outcome.success, outcome.message
    assert outcome.attempts == 2
    first, _, second = world.done(fx.PlanPlace)
    assert first.targets[0].position != pytest.approx(second.targets[0].position)


def test_a_hand_that_can_put_its_object_nowhere_keeps_it_and_says_so(world):
    world.faults.append(fail_on(lambda e: isinstance(e, fx.PlanPlace), Code.NO_PLAN))
    outcome = world.grasp()
    assert outcome.code is Code.PLACE_FAILED
    assert "still holds 'red'" in outcome.message
    assert world.held == "red"
    assert world.machine.carrying == "right"


def test_a_failed_way_back_after_release_still_ends_well(world):
    world.faults.append(fail_on(is_execute("leave"), Code.EXECUTION_FAILED, times=1))
    outcome = world.grasp()
    assert outcome.success
    assert [e.what for e in world.done(fx.MoveLinear)] == ["leave"]


def test_the_placed_object_is_kept_clear_of_on_the_way_home(world):
    world.grasp()
    home = world.done(fx.GoHome)[-1]
    assert [b.id for b in home.obstacles] == ["detected/blue_0", "placed/red"]


def test_no_way_home_is_tried_without_obstacles_then_named(world):
    world.faults.append(fail_on(lambda e: isinstance(e, fx.GoHome) and e.arms == ("right",), Code.IN_COLLISION))
    outcome = world.grasp()
    assert outcome.code is Code.IN_COLLISION
    assert "could not go home" in outcome.message
    assert [len(e.obstacles) for e in world.done(fx.GoHome) if e.arms == ("right",)] == [2, 0]


# --- stopping
@pytest.mark.parametrize("code", [Code.CANCELLED, Code.ROBOT_LOST, Code.INTERNAL])
@pytest.mark.parametrize("state", list(State)[1:])
def test_a_stop_in_any_state_ends_the_request_and_the_next_works(world, state, code):
    world.faults.append(lambda e: OpenArmError(code, "stopped on purpose") if world.machine.state is state else None)
    outcome = world.grasp()
    assert outcome.code is code
    assert world.states[-2:] == [state, State.IDLE]
    world.faults.clear()
    if world.held:
        world.move_gripper(0.044)
    assert world.grasp().success


def test_p21_a_cancel_while_carrying_keeps_the_object(world):
    world.faults.append(fail_on(is_execute("carry"), Code.CANCELLED))
    outcome = world.grasp()
    assert outcome.code is Code.CANCELLED
    assert world.held == "red"
    assert world.machine.carrying == "right"
    assert world.times(is_gripper(True)) == world.times(is_gripper(True))[:1]


def test_a_second_request_is_refused_at_once_and_disturbs_nothing(world):
    world.machine.step(fx.GraspRequest("red"), world.t_ns)
    with pytest.raises(OpenArmError, match="a grasp of 'red' is running") as error:
        world.machine.step(fx.GraspRequest("blue"), world.t_ns)
    assert error.value.code is Code.BUSY
    assert (world.machine.state, world.machine.label) == (State.DETECT, "red")


def test_a_request_for_an_unknown_arm_is_refused_and_leaves_the_machine_idle(world):
    with pytest.raises(OpenArmError, match="auto, left, right"):
        world.machine.step(fx.GraspRequest("red", arm="middle"), world.t_ns)
    assert world.grasp().success


def test_b72_every_transition_has_a_reason(world):
    world.slips = 1
    machine_step, reasons = world.machine.step, []

    def step(event, t_ns):
        recipe = machine_step(event, t_ns)
        reasons.append((world.machine.previous, world.machine.state, world.machine.reason))
        return recipe

    world.machine.step = step
    world.grasp()
    assert all(reason for _, _, reason in reasons)
    assert all(a[1] is b[0] for a, b in pairwise(reasons))
