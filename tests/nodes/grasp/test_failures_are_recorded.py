# SPDX-License-Identifier: Apache-2.0
"""A request that fails asks the flight recorder, and its answer says where the recording is."""

from __future__ import annotations

import pytest
from openarm_interfaces.action import PickTwo
from openarm_interfaces.msg import PickRequest
from openarm_interfaces.srv import Grasp, SaveRecording
from rclpy.action import ActionClient

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


def test_a_failure_is_recorded_with_its_reason_and_the_command_for_another_try(bench, asked) -> None:
    bench.world.slips = 99
    request = Grasp.Request(label="red", arm="right", has_place_position=True)
    request.place_position.x, request.place_position.y = 0.25, -0.3
    answer = bench.ros.call(bench.service, request)
    assert (answer.code, answer.recording) == ("GRASP_MISSED", "/recordings/1")
    reason, about, again = asked[0].splitlines()
    assert reason == f"GRASP_MISSED: {answer.message}"
    assert "label='red'" in about
    assert again == "again: openarm pick red --arm right --place 0.25 -0.3 0.0"


def test_a_refusal_is_recorded_and_what_is_not_the_robots_fault_is_not(bench, asked) -> None:
    assert bench.ask("mug").recording == "/recordings/1"
    assert asked[0].startswith("UNKNOWN_OBJECT: ")
    for fields in ({"arm": "middle"}, {"label": "mug", "dry_run": True}, {}):
        answer = bench.ask(**{"label": "red", **fields})
        assert answer.recording == "", answer.message
    assert len(asked) == 1


def test_of_two_requests_there_is_one_recording(bench, asked) -> None:
    goal = PickTwo.Goal(requests=[PickRequest(label="mug"), PickRequest(label="red")])
    _, result = bench.ros.send_goal(ActionClient(bench.ros.node, PickTwo, "/grasp/pick_two"), goal)
    answer = bench.ros.result(result, 60.0).result
    assert not answer.success
    assert answer.recording == "/recordings/1"
    assert asked[0].splitlines()[2] == "again: openarm pick mug red --arm auto --arm auto"
    assert len(asked) == 1


def test_a_recorder_that_does_not_answer_keeps_no_answer_back(bench) -> None:
    recorder = bench.node._flight_recorder
    assert bench.ask("mug").recording == "", "there is none"
    recorder._client.service_is_ready = lambda: True  # nobody will answer
    answer = bench.ask("mug")
    assert (answer.code, answer.recording) == ("UNKNOWN_OBJECT", "")
    assert not recorder._client._pending_requests
