# SPDX-License-Identifier: Apache-2.0
"""The transition table, whole."""

from __future__ import annotations

import pytest

from openarm_grasp.states import TRANSITIONS, Event, State

S, E = State, Event


def test_b56_the_ten_states():
    names = "IDLE DETECT TRANSFORM PLAN MOVE_TO_PREGRASP MOVE_TO_GRASP CLOSE_GRIPPER LIFT PLACE RESET"
    assert " ".join(state.value for state in State) == names


@pytest.mark.parametrize("state", list(State))
def test_b56_every_event_is_defined_in_every_state(state):
    assert set(TRANSITIONS[state]) == set(Event)
    assert all(isinstance(follower, State) for follower in TRANSITIONS[state].values())


def test_b56_done_leads_once_round():
    state, path = S.IDLE, []
    for _ in range(10):
        state = TRANSITIONS[state][E.DONE]
        path.append(state)
    assert path == [*list(State)[1:], S.IDLE]


def test_b58_detection_fails_to_idle_and_planning_to_detect():
    assert TRANSITIONS[S.DETECT][E.AGAIN] is S.IDLE
    assert TRANSITIONS[S.TRANSFORM][E.AGAIN] is S.DETECT
    assert TRANSITIONS[S.PLAN][E.AGAIN] is S.DETECT


def test_a70_what_fails_with_the_arm_goes_home_and_looks_again():
    for state in (S.MOVE_TO_PREGRASP, S.MOVE_TO_GRASP, S.CLOSE_GRIPPER, S.LIFT, S.PLACE):
        assert TRANSITIONS[state][E.AGAIN] is S.RESET
    assert TRANSITIONS[S.RESET][E.AGAIN] is S.DETECT


@pytest.mark.parametrize("event", [E.CANCEL, E.LOST])
@pytest.mark.parametrize("state", list(State))
def test_cancel_and_a_lost_robot_end_everything(state, event):
    assert TRANSITIONS[state][event] is S.IDLE


@pytest.mark.parametrize("state", [s for s in State if s is not S.IDLE])
def test_a_request_changes_nothing_while_a_grasp_runs(state):
    assert TRANSITIONS[state][E.REQUEST] is state


@pytest.mark.parametrize("state", list(State))
def test_the_end_is_idle_or_the_way_home(state):
    assert TRANSITIONS[state][E.END] in (S.IDLE, S.RESET)
