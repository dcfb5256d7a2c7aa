# SPDX-License-Identifier: Apache-2.0
"""The registry of strategies: a new one is a function and a line."""

from __future__ import annotations

from dataclasses import replace

import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.requests.request import GraspOutcome, GraspRequest
from openarm_grasp.requests.task import Task
from openarm_grasp.strategies import registry
from openarm_grasp.strategies.pick_and_place import pick_and_place
from tests.openarm_grasp.scripted import Follow, standing


async def tap(task: Task) -> GraspOutcome | None:
    """Tap what stands too far away, so that it comes nearer, and pick it."""
    sighting = task.findings.sighting
    if sighting is None or task.findings.place_refused:
        return None
    task.note("tapping it")
    await task.robot.follow("left", "tap", "tap")
    task.displaced = "after the tap"
    return await pick_and_place(task, replace(task.request, why="tapped"))


@pytest.fixture
def far(robot, monkeypatch):
    """A world whose red cube is too far away for arms and pushes, and that has the new strategy."""
    world = robot(0.46, 0.02)
    world.far, world.hands_come_behind = 0.44, False
    monkeypatch.setitem(registry.STRATEGIES, "tap", tap)
    return world


def test_a_new_strategy_is_tried_after_those_before_it_and_its_name_is_the_route(far):
    def comes_nearer(call):
        if isinstance(call, Follow) and call.trajectory == "tap":
            far.objects["red"] = standing("red", 0.40, 0.02)

    far.faults.append(comes_nearer)
    outcome = far.ask()
    assert (outcome.code, outcome.route) == (Code.OK, "tap")
    assert "tapping it" in far.notes


def test_a_new_strategy_that_does_not_help_says_where_it_left_the_object(far):
    outcome = far.ask()
    assert (outcome.kind, outcome.code, outcome.route) == ("PARTIAL", Code.UNREACHABLE, "")
    assert "after the tap 'red' was seen at (0.460, 0.020) m" in outcome.message


def test_a_new_strategy_is_not_asked_when_the_direct_one_succeeds(robot, monkeypatch):
    world = robot(0.25, 0.25)
    monkeypatch.setitem(registry.STRATEGIES, "tap", tap)
    assert world.ask().route == "direct"
    assert "tapping it" not in world.notes


def test_a_new_strategy_cannot_claim_success(far, monkeypatch):
    async def boast(task: Task) -> GraspOutcome | None:
        return GraspOutcome(Code.OK, "done", task.request.label, attempts=1)

    monkeypatch.setitem(registry.STRATEGIES, "tap", boast)
    with pytest.raises(OpenArmError, match="OK without evidence"):
        registry.carry_out(far.task(GraspRequest("red"))).send(None)


def test_a_defect_of_a_strategy_is_answered(far, monkeypatch):
    async def breaks(task: Task) -> GraspOutcome | None:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setitem(registry.STRATEGIES, "tap", breaks)
    outcome = far.ask()
    assert (outcome.code, outcome.route) == (Code.INTERNAL, "")
    assert "strategy 'tap': ZeroDivisionError: by nothing" in outcome.message
