# SPDX-License-Identifier: Apache-2.0
"""Each state has a time budget; the answer says how long each took, and what took longer than expected is reported."""

from __future__ import annotations

import pytest

from openarm_grasp.config import BudgetConfig
from openarm_grasp.requests.state_times import StateClock
from openarm_grasp.requests.states import State
from tests.openarm_grasp.scripted import Follow

pytestmark = pytest.mark.requirement("N-19")

S = State


def clock(*entries: tuple[State, float, bool]) -> tuple[StateClock, list[str]]:
    made = StateClock(BudgetConfig(plan=2.0), 0)
    return made, [made.enter(state, round(t * 1e9), waits=waits) for state, t, waits in entries]


def test_a_visit_goes_on_while_its_state_is_entered_again():
    made, said = clock((S.DETECT, 0.0, False), (S.PLAN, 1.0, False), (S.PLAN, 2.5, False), (S.RESET, 3.5, False))
    assert said == ["", "", "", "PLAN took 2.5 s, expected at most 2 s"]
    detect, plan, reset = made.times(4_500_000_000)
    assert (detect.state, detect.duration, detect.exceeded) == ("DETECT", 1.0, False)
    assert (plan.state, plan.duration, plan.longest, plan.budget, plan.exceeded) == ("PLAN", 2.5, 2.5, 2.0, True)
    assert (reset.state, reset.duration) == ("RESET", 1.0)


def test_two_short_visits_exceed_no_budget_and_a_long_one_is_told_once():
    made, said = clock((S.PLAN, 0.0, False), (S.DETECT, 1.5, False), (S.PLAN, 2.0, False), (S.LIFT, 3.5, False))
    assert said == [""] * 4
    plan = next(one for one in made.times(4_000_000_000) if one.state == "PLAN")
    assert (plan.duration, plan.longest, plan.exceeded) == (3.0, 1.5, False)
    _, said = clock((S.PLAN, 0.0, False), (S.PLAN, 3.0, False), (S.PLAN, 6.0, False), (S.LIFT, 7.0, False))
    assert [bool(text) for text in said] == [False, True, False, False]


def test_the_time_that_a_person_takes_to_confirm_is_no_delay_of_the_state():
    made, said = clock((S.PLAN, 0.0, False), (S.PLAN, 1.0, True), (S.LIFT, 61.0, False))
    assert said == [""] * 3
    (plan,) = made.times(61_000_000_000)
    assert (plan.duration, plan.longest) == pytest.approx((61.0, 1.0))


def test_the_answer_breaks_down_the_time_and_what_is_late_is_said(worlds, box):
    world, warned = worlds(box("red", 0.26, -0.2), budget={"lift": 3.0}), []
    world.warn = warned.append
    world.faults.append(lambda call: world.pass_time(4.0) if call == Follow("right", "lift", "lift", True) else None)
    outcome = world.succeeds()
    times = {one.state: one for one in outcome.state_times}
    assert {"DETECT", "PLAN", "MOVE_TO_PREGRASP", "MOVE_TO_GRASP", "CLOSE_GRIPPER", "LIFT", "PLACE", "RESET"} >= {
        *times
    }
    assert sum(one.duration for one in times.values()) == pytest.approx(outcome.duration)
    assert [name for name, one in times.items() if one.exceeded] == ["LIFT"]
    assert warned == [f"LIFT took {times['LIFT'].longest:.1f} s, expected at most 3 s"]
    assert [status.late for status in world.status if status.late] == warned
    assert next(status for status in world.status if status.state is S.LIFT).budget == 3.0


def test_the_end_of_a_request_says_its_code(world):
    world.slips = 99
    assert world.status == []
    world.grasp()
    codes = [status.code for status in world.status]
    assert codes == [""] * (len(codes) - 1) + ["GRASP_MISSED"]
