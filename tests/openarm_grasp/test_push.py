# SPDX-License-Identifier: Apache-2.0
"""Requests for what must be pushed into reach first; in a scripted world."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_grasp.config import GraspConfig
from openarm_grasp.planning.pushes import closed_hand, push_ways
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace
from tests.openarm_grasp.scripted import Follow, Grip, World


@pytest.fixture
def two(robot) -> World:
    """A red cube out of the reach of both arms."""
    return robot(0.46, 0.02, far=0.44)


@pytest.mark.requirement("N-13", "A-65")
def test_what_no_arm_grasps_is_pushed_into_reach_looked_at_and_picked(two: World) -> None:
    outcome = two.ask()
    assert (outcome.code, outcome.route) == (Code.OK, "push")
    assert two.pushed == 1
    pusher = next(e.arm for e in two.done(Follow))
    assert f"push 1 by the {pusher} hand moved it 100 mm" in outcome.message
    assert pusher != outcome.arm  # the hand that comes from the other side pushes
    assert next(e for e in two.done(Grip)).position == 0.0


@pytest.mark.requirement("N-13")
def test_the_grasp_after_a_push_is_planned_without_what_the_map_shows_of_the_object_now(two: World) -> None:
    plan, ahead = two.plan, list[PlanGrasp]()

    async def noted(effect: PlanGrasp | PlanPlace) -> Planned:
        if isinstance(effect, PlanGrasp) and not two.pushed:
            p = effect.target[0].T_frame_box[:2, 3]
            ahead.extend([effect] if np.hypot(*(p - (0.46, 0.02))) > 0.05 else [])
        return await plan(effect)

    two.plan = noted
    assert two.ask().route == "push"
    assert ahead
    for effect in ahead:
        (gone,) = effect.ignore_regions
        assert gone.T_frame_box[:2, 3] == pytest.approx((0.46, 0.02), abs=1e-6)


@pytest.mark.requirement("N-13")
def test_a_push_that_the_object_does_not_follow_goes_another_way_next_and_is_reported(two: World) -> None:
    two.follows = 0.1
    outcome = two.ask()
    assert two.pushed == 2  # no third way leads into reach
    first, second = (line[:2] / np.linalg.norm(line[:2]) for line in (two.lines[0], two.lines[-1]))
    assert first @ second < 0.5
    assert (outcome.kind, outcome.code, outcome.route) == ("PARTIAL", Code.UNREACHABLE, "")
    x, y, _ = two.objects["red"].p_base
    assert f"after the pushes 'red' was seen at ({x:.3f}, {y:.3f}) m" in outcome.message


@pytest.mark.requirement("N-13")
def test_the_camera_verifies_a_push(robot) -> None:
    """Half of the way is seen as half of the way, and the rest is pushed again."""
    two = robot(0.46, 0.02, far=0.40)
    two.follows = 0.5
    outcome = two.ask()
    assert outcome.code is Code.OK
    assert two.pushed == 2
    assert "push 2" in outcome.message


@pytest.mark.requirement("N-13")
def test_after_a_push_the_object_is_looked_for_where_it_was_pushed_to_not_where_the_request_said(robot) -> None:
    outcome = robot(0.46, 0.02, far=0.40).ask(object_at=(0.46, 0.02))
    assert (outcome.code, outcome.route) == (Code.OK, "push"), outcome.message


@pytest.mark.requirement("N-13")
def test_an_object_that_is_lost_in_a_push_is_reported(two: World) -> None:
    push = two.push
    two.push = lambda: (push(), two.objects.pop("red"))
    outcome = two.ask()
    assert (outcome.kind, outcome.success) == ("FAILED", False)
    assert outcome.code in (Code.NOTHING_DETECTED, Code.UNKNOWN_OBJECT)


def test_a_hand_that_meets_something_behind_the_object_does_not_push(two: World) -> None:
    two.tcp_error = 0.02
    outcome = two.ask()
    assert (outcome.kind, outcome.code) == ("FAILED", Code.HAND_COLLISION)
    assert two.pushed == 0


def test_what_can_neither_be_grasped_nor_pushed_is_refused_with_both_reasons(two: World) -> None:
    two.hands_come_behind = False
    outcome = two.ask()
    assert (outcome.kind, outcome.code) == ("REFUSED", Code.UNREACHABLE)
    assert "out of reach" in outcome.message
    assert "cannot be pushed into reach either" in outcome.message
    assert not two.done(Follow)


@pytest.mark.parametrize("height", [0.001, 0.003, 0.008, 0.05])
def test_what_is_thinner_than_the_hand_comes_down_to_can_not_be_pushed(robot, height: float) -> None:
    two = robot(0.46, 0.02)
    red = two.objects["red"]
    thin = replace(red, size=np.array([*red.size[:2], height]))
    hand = closed_hand(two.description, "right")
    ways = push_ways(thin, np.array([0.40, 0.02]), GraspConfig(), hand, two.session.context.hand)
    assert bool(ways) == (height > 0.01)


@pytest.mark.requirement("N-13")
def test_a_dry_run_of_a_push_moves_nothing(two: World) -> None:
    outcome = two.ask(dry_run=True)
    assert (outcome.code, outcome.route) == (Code.OK, "push")
    assert not two.done(Follow)


@pytest.mark.requirement("R-17")
def test_an_object_is_pushed_aside_as_far_as_a_push_goes_and_not_picked(robot) -> None:
    two = robot(0.30, 0.2)
    before = two.objects["red"].p_base
    outcome = two.ask("red", phase="aside")
    assert (outcome.code, outcome.kind, outcome.route) == (Code.OK, "SUCCESS", "aside"), outcome.message
    assert two.pushed == 1
    assert np.linalg.norm(two.objects["red"].p_base - before) == pytest.approx(GraspConfig().push.aside[0], abs=1e-3)
    assert "aside" in " ".join(two.notes)
    assert not [e for e in two.done(PlanPlace)]


def test_what_does_not_move_aside_is_pushed_in_other_directions_and_reported(robot) -> None:
    two = robot(0.30, 0.2)
    two.follows = 0.0
    outcome = two.ask("red", phase="aside")
    assert outcome.code is Code.PLACE_FAILED
    assert two.pushed == GraspConfig().push.most
    assert "does not move aside" in outcome.message
    ways = [line[:2] for line in two.lines]
    assert all(a @ b < 0.5 * np.linalg.norm(a) * np.linalg.norm(b) for a, b in itertools.combinations(ways, 2))


@pytest.mark.parametrize("arm", ["left", "right"])
def test_an_arm_that_is_asked_for_pushes_aside(robot, arm) -> None:
    assert robot(0.30, 0.02).ask("red", phase="aside", arm=arm).arm == arm


def test_a_dry_run_of_a_push_aside_moves_nothing(robot) -> None:
    two = robot(0.30, 0.2)
    outcome = two.ask("red", phase="aside", dry_run=True)
    assert (outcome.code, two.pushed) == (Code.OK, 0)
    assert outcome.message.startswith("can be done: the ")
