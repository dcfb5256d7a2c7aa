# SPDX-License-Identifier: Apache-2.0
"""A request that fails asks the flight recorder, and its answer says where the recording is."""

from __future__ import annotations

import pytest
from openarm_interfaces.action import PickTwo
from openarm_interfaces.msg import PickRequest
from openarm_interfaces.srv import Grasp, SaveRecording

from tests.nodes.grasp.conftest import OPEN

pytestmark = pytest.mark.requirement("R-24", "N-24")


@pytest.fixture
def asked(bench) -> list[str]:
    """Reasons that the flight recorder was given."""
    reasons: list[str] = []

    def save(request: SaveRecording.Request, response: SaveRecording.Response) -> SaveRecording.Response:
        reasons.append(request.reason)
        response.success, response.path = True, f"/recordings/{len(reasons)}"
        return response

    bench.ros.node.create_service(SaveRecording, "/flight_recorder/save", save)
    client = bench.node._flight_recorder._client
    bench.until(client.service_is_ready, what="the grasp node has met the recorder")
    return reasons


@pytest.mark.requirement("A-71", "N-19")
def test_an_empty_hand_is_tried_again_and_recorded_with_its_reason_and_the_command_for_another_try(
    bench, asked
) -> None:
    bench.world.slips = 99
    request = Grasp.Request(label="red", arm="right", has_place_position=True)
    request.place_position.x, request.place_position.y = 0.25, -0.3
    answer = bench.ros.call(bench.service, request)
    assert (answer.code, answer.attempts, answer.recording) == ("GRASP_MISSED", 3, "/recordings/1")
    assert "closed on nothing" in answer.message
    reason, about, again = asked[0].splitlines()
    assert reason == f"GRASP_MISSED: {answer.message}"
    assert "label='red'" in about
    assert again == "again: openarm pick red --arm right --place 0.25 -0.3 0.0"
    bench.until(lambda: any(one.code for one in bench.status), what="the status of the end")
    assert {(one.state, one.code) for one in bench.status if one.code} == {("IDLE", "GRASP_MISSED")}
    assert {one.budget for one in bench.status if one.state == "PLAN"} == {5.0}
    assert sum(one.duration for one in answer.state_times) == pytest.approx(answer.duration, abs=0.05)
    assert {one.state for one in answer.state_times} >= {"DETECT", "CLOSE_GRIPPER", "RESET"}
    assert bench.world.q[bench.world.robot.finger_joint("right")] == OPEN
    assert bench.world.log[-1] == "move home"


@pytest.mark.long
def test_a_refusal_is_recorded_and_what_is_not_the_robots_fault_is_not(bench, asked) -> None:
    assert bench.ask("mug").recording == "/recordings/1"
    assert asked[0].startswith("UNKNOWN_OBJECT: ")
    for fields in ({"arm": "middle"}, {"label": "mug", "dry_run": True}, {}):
        answer = bench.ask(**{"label": "red", **fields})
        assert answer.recording == "", answer.message
    assert len(asked) == 1


@pytest.mark.long
@pytest.mark.requirement("P-02")
def test_one_of_two_that_is_not_in_view_is_refused_and_the_other_placed_and_there_is_one_recording(
    bench, asked
) -> None:
    goal = PickTwo.Goal(requests=[PickRequest(label="mug"), PickRequest(label="blue")])
    _, result = bench.ros.send_goal(bench.two, goal)
    answer = bench.ros.result(result, 60.0).result
    assert (answer.success, answer.outcome, answer.code) == (False, "PARTIAL", "UNKNOWN_OBJECT")
    assert [one.outcome for one in answer.results] == ["REFUSED", "SUCCESS"]
    assert "no 'mug' in view" in answer.message
    assert answer.recording == "/recordings/1"
    assert asked[0].splitlines()[2] == "again: openarm pick mug"
    assert len(asked) == 1
    assert bench.ask("", phase="place").code == "NOT_READY"


@pytest.mark.long
def test_a_recorder_that_does_not_answer_keeps_no_answer_back(bench) -> None:
    recorder = bench.node._flight_recorder
    assert bench.ask("mug").recording == "", "there is none"
    recorder._client.service_is_ready = lambda: True  # nobody will answer
    answer = bench.ask("mug")
    assert (answer.code, answer.recording) == ("UNKNOWN_OBJECT", "")
    assert not recorder._client._pending_requests
