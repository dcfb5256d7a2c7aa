# SPDX-License-Identifier: Apache-2.0
"""The command line of a request asks for the same."""

from __future__ import annotations

import shlex

import pytest

from openarm_bringup.cli import build_app
from openarm_grasp.requests.request import GraspRequest, command

FULL = GraspRequest(
    "red",
    arm="left",
    place=(0.25, -0.1),
    place_yaw=-0.5,
    phase="pick",
    timeout=30.0,
    velocity_scale=0.25,
    object_at=(0.3, -0.2),
)


@pytest.mark.parametrize("request_", [FULL, GraspRequest(""), GraspRequest("cup's", place_on="blue box")])
@pytest.mark.requirement("R-24")
def test_the_command_of_a_request_is_parsed_to_that_request(request_: GraspRequest) -> None:
    program, name, *words = shlex.split(command(request_))
    assert (program, name) == ("openarm", "pick")
    _, bound, *_ = build_app()["pick"].parse_args(words)
    given = bound.arguments
    assert given.get("label", "") == request_.label
    assert given.get("arm", ["auto"]) == [request_.arm]
    assert given.get("place") == ([(*request_.place, 0.0)] if request_.place else None)
    assert given.get("place_on") == ([request_.place_on] if request_.place_on else None)
    assert given.get("yaw") == (pytest.approx([-28.6478897]) if request_ is FULL else None)
    assert given.get("at") == ([request_.object_at] if request_.object_at else None)
    assert given.get("phase", "all") == request_.phase
    assert given.get("time_limit", 0.0) == request_.timeout
    assert given.get("speed", 0.0) == request_.velocity_scale
