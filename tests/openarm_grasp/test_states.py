# SPDX-License-Identifier: Apache-2.0
"""The states of a grasp as they are reported, and which may follow which."""

from __future__ import annotations

import itertools

import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.requests.states import SUCCESSORS, State, as_text, check_transition, mermaid
from openarm_grasp.strategies import pick_and_place as steps
from tests.openarm_grasp.scripted import Follow, Observe

S = State
ARM_MOVES = (S.MOVE_TO_PREGRASP, S.MOVE_TO_GRASP, S.CLOSE_GRIPPER, S.LIFT, S.PLACE)


@pytest.mark.requirement("B-56")
def test_the_ten_states():
    names = "IDLE DETECT TRANSFORM PLAN MOVE_TO_PREGRASP MOVE_TO_GRASP CLOSE_GRIPPER LIFT PLACE RESET"
    assert " ".join(state.value for state in State) == names
    assert set(SUCCESSORS) == set(State)


@pytest.mark.requirement("B-56")
def test_the_way_of_a_grasp_leads_once_round_and_skips_no_state():
    order = list(State)
    for state, successor in zip(order, [*order[1:], S.IDLE], strict=True):
        assert successor in SUCCESSORS[state]
        skipped = [other for other in order if order.index(other) > order.index(state) + 1 and other is not S.IDLE]
        allowed = {(S.TRANSFORM, S.PLACE)} | {(moving, S.RESET) for moving in ARM_MOVES}
        assert all((state, other) in allowed for other in SUCCESSORS[state] if other in skipped)


@pytest.mark.requirement("B-58")
def test_detection_fails_to_idle_and_planning_to_detect():
    assert S.IDLE in SUCCESSORS[S.DETECT]
    assert S.DETECT in SUCCESSORS[S.TRANSFORM]
    assert S.DETECT in SUCCESSORS[S.PLAN]


@pytest.mark.requirement("A-70")
def test_what_fails_with_the_arm_goes_home_before_it_looks_again():
    for state in ARM_MOVES:
        assert S.RESET in SUCCESSORS[state]
        assert S.DETECT not in SUCCESSORS[state]
    assert S.DETECT in SUCCESSORS[S.RESET]


@pytest.mark.parametrize("state", list(State))
def test_a_stop_ends_in_idle_from_every_state(state):
    assert S.IDLE in SUCCESSORS[state]


@pytest.mark.parametrize(("state", "successor"), list(itertools.product(State, State)))
@pytest.mark.requirement("P-29")
def test_only_what_is_written_is_allowed(state, successor):
    if successor in SUCCESSORS[state]:
        check_transition(state, successor)
        return
    with pytest.raises(OpenArmError, match=f"{successor.value} may not follow {state.value}; allowed: ") as error:
        check_transition(state, successor)
    assert error.value.code is Code.INTERNAL


@pytest.mark.requirement("P-29")
def test_a_strategy_that_takes_a_step_that_is_not_allowed_ends_as_a_defect(world, monkeypatch):
    """Without the closing of the hand, LIFT would follow MOVE_TO_GRASP: nothing is lifted, and the defect is named."""

    async def no_closing(run, grasp, why):
        return grasp, why

    monkeypatch.setattr(steps, "close", no_closing)
    world.ends(Code.INTERNAL, "LIFT may not follow MOVE_TO_GRASP")
    assert [call.trajectory for call in world.done(Follow)] == ["transfer", "approach"]


@pytest.mark.requirement("P-29")
def test_each_transition_that_is_reported_is_an_allowed_one(world):
    world.slips = 1
    world.fail(lambda call: isinstance(call, Observe) and world.state is S.IDLE, Code.STALE_DATA, times=1)
    world.grasp()
    assert len(world.status) > 12
    assert all(status.state in SUCCESSORS[status.previous] for status in world.status)


@pytest.mark.requirement("P-29")
def test_the_drawings_hold_every_transition_and_when_it_is_taken():
    drawing, text = mermaid(), as_text()
    for state, successors in SUCCESSORS.items():
        for other, when in successors.items():
            assert f"{state.value} --> {other.value}: {when}" in drawing
            assert when in text
    assert len(text.splitlines()) == sum(len(row) for row in SUCCESSORS.values())
