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


@pytest.mark.parametrize("requests", [(FULL,), (GraspRequest(""),), (GraspRequest("cup's"), FULL), (FULL, FULL)])
@pytest.mark.requirement("R-24")
def test_the_command_of_a_request_is_parsed_to_that_request(requests: tuple[GraspRequest, ...]) -> None:
    if len(requests) == 2:
        requests = tuple(GraspRequest(r.label, r.arm, r.place, place_yaw=r.place_yaw) for r in requests)
    program, name, *words = shlex.split(command(requests))
    assert (program, name) == ("openarm", "pick")
    _, bound, *_ = build_app()["pick"].parse_args(words)
    given = bound.arguments
    assert tuple(filter(None, (given.get("label"), given.get("second")))) == tuple(r.label for r in requests if r.label)
    assert given.get("arm", ["auto"]) == [r.arm for r in requests]
    whole = all(r.place for r in requests)
    assert given.get("place") == ([(*r.place, 0.0) for r in requests if r.place] if whole else None)
    assert given.get("yaw") == (pytest.approx([-28.6478897] * len(requests)) if whole else None)
    assert given.get("at") == ([(0.3, -0.2)] if requests == (FULL,) else None)
    assert given.get("phase", "all") == requests[0].phase
    assert given.get("time_limit", 0.0) == requests[0].timeout
    assert given.get("speed", 0.0) == requests[0].velocity_scale
