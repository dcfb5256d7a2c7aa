# SPDX-License-Identifier: Apache-2.0
"""Requests that take more than one way: by the other arm, from hand to hand, pushed into reach; in a scripted world."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

import numpy as np
import pytest

from openarm_common.description import RobotDescription
from openarm_common.errors import Code, OpenArmError
from openarm_grasp import effects as fx
from openarm_grasp.legs import run_task
from openarm_grasp.rehearsal import standing_at

#: How far either arm reaches over the middle, m.
OVER = 0.10


class TwoArms:
    """A performer and a link to a scripted world in which each arm reaches its own side and a strip of the other's."""

    def __init__(self, world: Any) -> None:
        self.world = world
        self.deadline_ns = 0
        self.description = RobotDescription.load()
        self.notes: list[str] = []
        self.stopped: Code | None = None
        #: The arms grasp nothing that stands further away than this, m; a hand may push it from there.
        self.far = 1.0
        #: Share of a push that the object follows.
        self.follows = 1.0
        self.hands_come_behind = True
        self.pushed = 0
        self._line: np.ndarray | None = None

    def ask(self, label: str = "red", **kwargs: Any) -> fx.GraspOutcome:
        request = fx.GraspRequest(label, **kwargs)
        machine = self.world.machine
        return _run(run_task(machine, self, self, request, lambda: self.notes.append(machine.reason)))  # type: ignore[arg-type]

    # --- performer
    def check_hands(self, machine: object, request: object) -> None:
        pass

    async def perform(self, recipe: fx.Effects) -> fx.Outcome:
        results: list[fx.Result] = []
        for done, effect in enumerate(recipe):
            try:
                if isinstance(effect, fx.PlanGrasp | fx.PlanPlace):
                    results.append(await self.plan(effect))
                    continue
            except OpenArmError as error:
                return fx.Outcome(error.code, error.message, tuple(results), done)
            if isinstance(effect, fx.Execute) and effect.trajectory == "push" and self._line is not None:
                self._push()
            outcome = self.world.perform((effect,))
            results += outcome.results
            if not outcome.ok:
                return fx.Outcome(outcome.code, outcome.message, tuple(results), done)
        return fx.Outcome(results=tuple(results), done=len(recipe))

    # --- link
    @property
    def now_ns(self) -> int:
        return self.world.t_ns

    def check(self) -> None:
        if self.stopped is not None:
            raise OpenArmError(self.stopped, "stopped on purpose")

    async def plan(self, effect: fx.PlanGrasp | fx.PlanPlace) -> fx.Planned:
        if isinstance(effect, fx.PlanGrasp):
            if "/push/" in effect.candidates[0].id:
                if not self.hands_come_behind:
                    raise OpenArmError(Code.UNREACHABLE, f"{effect.arm} arm: too far")
                self._line = effect.candidates[0].retreat_offset
                return fx.Planned(0, "transfer", "behind", "push")
            self._reach(effect.arm, effect.candidates[0].T_base_tcp[:2, 3])
            chosen = 0
        else:
            within = [i for i, way in enumerate(effect.targets) if self._reaches(effect.arm, way.position)]
            if not within:
                self._reach(effect.arm, effect.targets[0].position)
            chosen = within[0]
        outcome = self.world.perform((effect,))
        if not outcome.ok:
            raise OpenArmError(outcome.code, outcome.message)
        if isinstance(effect, fx.PlanPlace):
            self.world._target = effect.targets[chosen].position
        plan = outcome.last(fx.Planned)
        return fx.Planned(chosen, plan.transfer, plan.approach, plan.retreat)

    def _reaches(self, arm: str, p: np.ndarray) -> bool:
        y = float(p[1]) if arm == "left" else -float(p[1])
        return y >= -OVER and float(p[0]) <= self.far

    def _reach(self, arm: str, p: np.ndarray) -> None:
        if not self._reaches(arm, p):
            raise OpenArmError(Code.UNREACHABLE, f"{arm} arm: ({p[0]:.2f}, {p[1]:.2f}) is too far")

    def _push(self) -> None:
        self.pushed += 1
        assert self._line is not None
        objects = self.world.objects
        config = self.world.machine.around.config.push
        way = self._line * (1.0 - config.gap / np.linalg.norm(self._line)) * self.follows
        objects["red"] = standing_at(objects["red"], objects["red"].p_base[:2] + way[:2])


def _run(work: Coroutine[Any, Any, fx.GraspOutcome]) -> fx.GraspOutcome:
    with pytest.raises(StopIteration) as end:
        work.send(None)
    return end.value.value


@pytest.fixture
def robot(worlds: Callable[..., Any], box: Callable[..., Any]) -> Callable[..., TwoArms]:
    def make(x: float, y: float, *others: tuple[str, float, float], **config: Any) -> TwoArms:
        return TwoArms(worlds(box("red", x, y), *(box(*other) for other in others), **config))

    return make


def test_p11_a_direct_request_goes_one_way_and_says_so(robot) -> None:
    two = robot(0.25, 0.25)
    outcome = two.ask(place=(0.25, 0.35))
    assert (outcome.code, outcome.route, outcome.arm, outcome.attempts) == (Code.OK, "direct", "left", 1)


def test_p11_the_other_arm_is_asked_before_a_hand_over(robot) -> None:
    """At y = 0.14 the left arm is nearer, but the right one reaches both ends."""
    two = robot(0.25, 0.14)
    two._reaches = lambda arm, p: (p[1] >= 0.1) if arm == "left" else (p[1] <= 0.2)
    outcome = two.ask(place=(0.25, -0.30))
    assert (outcome.code, outcome.route, outcome.arm) == (Code.OK, "direct", "right")
    assert any("from the other side" in note for note in two.notes)


def test_p12_an_object_goes_from_hand_to_hand_by_way_of_the_middle(robot) -> None:
    two = robot(0.25, -0.30, ("blue", 0.25, 0.15))
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.code, outcome.route, outcome.kind) == (Code.OK, "hand_over", "SUCCESS")
    assert outcome.arm == "left"
    assert two.world.objects["red"].p_base[:2] == pytest.approx((0.25, 0.30), abs=1e-6)
    lifts = [effect.arm for effect in two.world.done(fx.Execute) if effect.trajectory == "lift"]
    assert lifts == ["right", "left"]
    told = [note for note in two.notes if "hand-over" in note]
    assert "1 of 2: the right arm brings it to the middle" in told[0]
    assert "2 of 2" in told[1]
    # In between it stood where both reach, clear of the other object.
    middle = two.world.machine.around.config.hand_over
    first = next(effect for effect in two.world.done(fx.PlanPlace) if effect.arm == "right" and effect.after is None)
    x, y, _ = first.targets[0].position
    assert middle.x[0] <= x <= middle.x[1]
    assert abs(y) <= middle.abs_y


def test_p12_what_the_taker_cannot_use_is_not_chosen(robot) -> None:
    """The taker reaches one end of the strip only; nothing moves before a spot there is found."""
    two = robot(0.25, -0.30, hand_over={"tries": 50})
    two._reaches = lambda arm, p: p[1] <= OVER if arm == "right" else p[1] >= 0.02
    outcome = two.ask(place=(0.25, 0.30))
    assert outcome.route == "hand_over"
    assert len([e for e in two.world.done(fx.Execute) if e.trajectory == "lift"]) == 2


def test_p12_a_taker_that_fails_leaves_a_partial_result_that_says_where_the_object_is(robot) -> None:
    two = robot(0.25, -0.30)
    two.world.fail(lambda e: isinstance(e, fx.Execute) and e.arm == "left" and e.trajectory == "approach",
                   Code.EXECUTION_FAILED)  # fmt: skip
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.kind, outcome.code, outcome.route) == ("PARTIAL", Code.EXECUTION_FAILED, "")
    x, y, _ = two.world.objects["red"].p_base
    assert f"'red' was seen at ({x:.3f}, {y:.3f}) m" in outcome.message
    assert abs(y) <= two.world.machine.around.config.hand_over.abs_y


@pytest.mark.parametrize(("margin", "spot_y"), [(0.0, -0.03), (0.005, 0.0)])
def test_p12_the_taker_must_cope_with_an_object_that_stands_a_little_off(robot, margin, spot_y) -> None:
    """The nearest spot is within the taker's reach by 2 mm: too little, once a margin is asked for."""
    two = robot(0.25, -0.30, hand_over={"margin": margin, "margin_deg": 0.0, "tries": 50})
    two._reaches = lambda arm, p: p[1] <= OVER if arm == "right" else p[1] >= -0.032
    outcome = two.ask(place=(0.25, 0.30), dry_run=True)
    assert (outcome.code, outcome.route) == (Code.OK, "hand_over")
    assert f"{spot_y:.3f}) m, and the left arm from there" in outcome.message.replace("-0.000", "0.000")


def test_p12_a_spot_without_margin_is_better_than_none(robot) -> None:
    two = robot(0.25, -0.30, hand_over={"abs_y": 0.001, "tries": 50})
    two._reaches = lambda arm, p: p[1] <= OVER if arm == "right" else p[1] >= 0.0
    outcome = two.ask(place=(0.25, 0.30), dry_run=True)
    assert (outcome.code, outcome.route) == (Code.OK, "hand_over")
    assert "0.001) m, and the left arm" in outcome.message


def lifts(two: TwoArms) -> list[str]:
    return [effect.arm for effect in two.world.done(fx.Execute) if effect.trajectory == "lift"]


def shy_taker(two: TwoArms, times: int) -> None:
    """The left arm cannot grasp the object where it truly stands, so many times; the plan ahead did not know."""

    def reaches(arm: str, p: np.ndarray) -> bool:
        if arm == "right":
            return float(p[1]) <= OVER
        red, brought = two.world.objects.get("red"), len(lifts(two))
        there = red is not None and float(np.linalg.norm(red.p_base[:2] - p[:2])) < 0.02
        return float(p[1]) >= -OVER and not (there and 0 < brought <= times)

    two._reaches = reaches


def test_p12_a_taker_that_is_refused_after_all_gets_the_object_elsewhere(robot) -> None:
    two = robot(0.25, -0.30)
    shy_taker(two, 1)
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.code, outcome.route, outcome.arm) == (Code.OK, "hand_over", "left")
    assert lifts(two) == ["right", "right", "left"]
    assert outcome.message.endswith("m, at try number 2")
    assert any("looking for another way from where it stands now" in note for note in two.notes)


def test_p12_it_is_brought_to_the_middle_as_often_as_the_parameter_says(robot) -> None:
    two = robot(0.25, -0.30, hand_over={"rounds": 2})
    shy_taker(two, 9)
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.kind, outcome.code, outcome.route) == ("PARTIAL", Code.UNREACHABLE, "")
    assert lifts(two) == ["right", "right"]
    x, y, _ = two.world.objects["red"].p_base
    assert f"at try number 2 'red' was seen at ({x:.3f}, {y:.3f}) m" in outcome.message


def test_p12_without_another_way_the_answer_says_both(robot) -> None:
    """From the middle the right arm cannot lift it again."""
    two = robot(0.25, -0.30)
    shy_taker(two, 9)
    reaches = two._reaches

    def holds_on(arm: str, p: np.ndarray) -> bool:
        stands = "red" in two.world.objects and bool(lifts(two))
        return reaches(arm, p) and not (arm == "right" and stands and abs(p[1]) < 0.04)

    two._reaches = holds_on
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.kind, outcome.code) == ("PARTIAL", Code.UNREACHABLE)
    assert "no hand-over through the middle" in outcome.message
    assert "'red' was seen at" in outcome.message


def test_p12_a_giver_that_fails_never_calls_the_taker(robot) -> None:
    two = robot(0.25, -0.30)
    two.world.fail(lambda e: isinstance(e, fx.Execute) and e.trajectory == "approach", Code.EXECUTION_FAILED)
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.kind, outcome.code) == ("FAILED", Code.EXECUTION_FAILED)
    assert "on the way to the middle" in outcome.message
    assert {e.arm for e in two.world.done(fx.Execute)} == {"right"}


def test_p11_a_full_middle_is_a_reason_to_refuse(robot) -> None:
    two = robot(0.25, -0.30, ("blue", 0.20, 0.0), ("green", 0.26, 0.0), ("orange", 0.32, 0.0))
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.kind, outcome.code) == ("REFUSED", Code.UNREACHABLE)
    assert "no free spot in the middle" in outcome.message
    assert not two.world.done(fx.Execute)


def test_p11_an_arm_that_was_asked_for_is_not_replaced(robot) -> None:
    outcome = robot(0.25, -0.30).ask(place=(0.25, 0.30), arm="right")
    assert (outcome.kind, outcome.code) == ("REFUSED", Code.UNREACHABLE)


def test_p12_a_dry_run_tells_the_way_and_moves_nothing(robot) -> None:
    two = robot(0.25, -0.30)
    outcome = two.ask(place=(0.25, 0.30), dry_run=True)
    assert (outcome.code, outcome.route) == (Code.OK, "hand_over")
    assert "the right arm brings it to the middle" in outcome.message
    assert not [e for _, e in two.world.log if isinstance(e, fx.Execute | fx.MoveGripper | fx.GoHome)]


def test_cancel_between_the_parts_ends_the_whole(robot) -> None:
    two = robot(0.25, -0.30)
    two.stopped = Code.CANCELLED
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.kind, outcome.code) == ("CANCELLED", Code.CANCELLED)


# --- pushing
def test_n13_a65_what_no_arm_grasps_is_pushed_into_reach_looked_at_and_picked(robot) -> None:
    two = robot(0.46, 0.02)
    two.far = 0.44
    outcome = two.ask()
    assert (outcome.code, outcome.route) == (Code.OK, "push")
    assert two.pushed == 1
    pusher = next(e.arm for e in two.world.done(fx.Execute))
    assert f"push 1 by the {pusher} hand moved it 60 mm" in outcome.message
    assert pusher != outcome.arm  # the hand that comes from the other side pushes
    closed = next(e for e in two.world.done(fx.MoveGripper))
    assert closed.position == 0.0


def test_n13_the_grasp_after_a_push_is_planned_without_what_the_map_shows_of_the_object_now(robot) -> None:
    two = robot(0.46, 0.02)
    two.far = 0.44
    plan, ahead = two.plan, list[fx.PlanGrasp]()

    async def noted(effect: fx.PlanGrasp | fx.PlanPlace) -> fx.Planned:
        if isinstance(effect, fx.PlanGrasp) and not two.pushed:
            p = effect.target.T_frame_box[:2, 3]
            ahead.extend([effect] if np.hypot(*(p - (0.46, 0.02))) > 0.05 else [])
        return await plan(effect)

    two.plan = noted
    assert two.ask().route == "push"
    assert ahead
    for effect in ahead:
        (gone,) = effect.gone
        assert gone.T_frame_box[:2, 3] == pytest.approx((0.46, 0.02), abs=1e-6)


def test_n13_a_push_that_the_object_does_not_follow_is_repeated_three_times_and_told(robot) -> None:
    two = robot(0.46, 0.02)
    two.far, two.follows = 0.44, 0.1
    outcome = two.ask()
    assert two.pushed == 3
    assert (outcome.kind, outcome.code, outcome.route) == ("PARTIAL", Code.UNREACHABLE, "")
    x, y, _ = two.world.objects["red"].p_base
    assert f"after the pushes 'red' was seen at ({x:.3f}, {y:.3f}) m" in outcome.message


def test_n13_the_camera_verifies_a_push(robot) -> None:
    """Half of the way is seen as half of the way, and the rest is pushed again."""
    two = robot(0.46, 0.02)
    two.far, two.follows = 0.44, 0.5
    outcome = two.ask()
    assert outcome.code is Code.OK
    assert two.pushed == 2
    assert "push 2" in outcome.message


def test_n13_an_object_that_is_lost_in_a_push_is_told(robot) -> None:
    two = robot(0.46, 0.02)
    two.far = 0.44
    push = two._push
    two._push = lambda: (push(), two.world.objects.pop("red"))
    outcome = two.ask()
    assert (outcome.kind, outcome.success) == ("FAILED", False)
    assert outcome.code in (Code.NOTHING_DETECTED, Code.UNKNOWN_OBJECT)


def test_a_hand_that_meets_something_behind_the_object_does_not_push(robot) -> None:
    two = robot(0.46, 0.02)
    two.far, two.world.tcp_error = 0.44, 0.02
    outcome = two.ask()
    assert (outcome.kind, outcome.code) == ("FAILED", Code.HAND_COLLISION)
    assert two.pushed == 0


def test_what_can_neither_be_grasped_nor_pushed_is_refused_with_both_reasons(robot) -> None:
    two = robot(0.46, 0.02)
    two.far, two.hands_come_behind = 0.44, False
    outcome = two.ask()
    assert (outcome.kind, outcome.code) == ("REFUSED", Code.UNREACHABLE)
    assert "out of reach" in outcome.message
    assert "cannot be pushed into reach either" in outcome.message
    assert not two.world.done(fx.Execute)


def test_n13_a_dry_run_of_a_push_moves_nothing(robot) -> None:
    two = robot(0.46, 0.02)
    two.far = 0.44
    outcome = two.ask(dry_run=True)
    assert (outcome.code, outcome.route) == (Code.OK, "push")
    assert not two.world.done(fx.Execute)
