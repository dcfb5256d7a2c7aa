# SPDX-License-Identifier: Apache-2.0
"""The transition table, whole."""

from __future__ import annotations

import pytest
import yaml

from openarm_common.config import load_yaml
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import config_dir
from openarm_grasp.strategy.states import TRANSITIONS, Event, State, as_text, load_transitions, mermaid

S, E = State, Event


@pytest.mark.requirement("B-56")
def test_the_ten_states():
    names = "IDLE DETECT TRANSFORM PLAN MOVE_TO_PREGRASP MOVE_TO_GRASP CLOSE_GRIPPER LIFT PLACE RESET"
    assert " ".join(state.value for state in State) == names


@pytest.mark.parametrize("state", list(State))
@pytest.mark.requirement("B-56")
def test_every_event_is_defined_in_every_state(state):
    assert set(TRANSITIONS[state]) == set(Event)
    assert all(isinstance(follower, State) for follower in TRANSITIONS[state].values())


@pytest.mark.requirement("B-56")
def test_done_leads_once_round():
    state, path = S.IDLE, []
    for _ in range(10):
        state = TRANSITIONS[state][E.DONE]
        path.append(state)
    assert path == [*list(State)[1:], S.IDLE]


@pytest.mark.requirement("B-58")
def test_detection_fails_to_idle_and_planning_to_detect():
    assert TRANSITIONS[S.DETECT][E.AGAIN] is S.IDLE
    assert TRANSITIONS[S.TRANSFORM][E.AGAIN] is S.DETECT
    assert TRANSITIONS[S.PLAN][E.AGAIN] is S.DETECT


@pytest.mark.requirement("A-70")
def test_what_fails_with_the_arm_goes_home_and_looks_again():
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


def edited(tmp_path, **changes: str):
    """The suite's table with some pairs changed, as a file: DETECT_again="DETECT"."""
    table = load_yaml(config_dir() / "params" / "grasp_transitions.yaml")
    for key, follower in changes.items():
        state, _, event = key.rpartition("_")
        table[state][event] = follower
    path = tmp_path / "table.yaml"
    path.write_text(yaml.safe_dump(table))
    return path


@pytest.mark.requirement("P-29")
def test_a_table_may_be_edited_within_limits(tmp_path):
    table = load_transitions(edited(tmp_path, DETECT_again="DETECT", RESET_again="IDLE"))
    assert table[S.DETECT][E.AGAIN] is S.DETECT
    assert table[S.RESET][E.AGAIN] is S.IDLE


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"CLOSE_GRIPPER_done": "PLACE"}, "CLOSE_GRIPPER.done is PLACE, expected LIFT"),
        ({"LIFT_again": "DETECT"}, "goes home before it tries again"),
        ({"PLACE_cancel": "RESET"}, "PLACE.cancel is RESET, expected IDLE"),
        ({"PLAN_skip": "PLACE"}, "only a hand that holds its object already"),
        ({"IDLE_request": "PLAN"}, "nothing is grasped that was not looked for"),
        ({"LIFT_done": "FLY"}, "LIFT.done is 'FLY', expected one of IDLE"),
    ],
)
@pytest.mark.requirement("P-29")
def test_what_would_skip_evidence_or_the_way_home_is_refused(tmp_path, change, why):
    with pytest.raises(OpenArmError, match=why) as error:
        load_transitions(edited(tmp_path, **change))
    assert error.value.code is Code.CONFIG_INVALID


@pytest.mark.requirement("P-29")
def test_missing_and_unknown_names_are_all_told(tmp_path):
    path = edited(tmp_path)
    table = yaml.safe_load(path.read_text())
    del table["LIFT"]["done"]
    table["FLY"] = {}
    path.write_text(yaml.safe_dump(table))
    with pytest.raises(OpenArmError) as error:
        load_transitions(path)
    assert "LIFT.done is 'None'" in error.value.message
    assert "no state 'FLY'" in error.value.message


@pytest.mark.requirement("P-29")
def test_the_drawings_hold_every_state_and_the_skips():
    drawing = mermaid(TRANSITIONS)
    assert all(state.value in drawing for state in State)
    assert "TRANSFORM --> PLACE: skip" in drawing
    assert "LIFT --> RESET: again, end" in drawing
    lines = as_text(TRANSITIONS).splitlines()
    assert len(lines) == 11
    assert lines[0].split() == [event.value for event in Event]
