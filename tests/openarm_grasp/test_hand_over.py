# SPDX-License-Identifier: Apache-2.0
"""Requests that take more than one way: by the other arm, from hand to hand; in a scripted world."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_grasp.robot.interface import PlanPlace
from tests.openarm_grasp.scripted import OVER, Follow, GoHome, Grip, World


@pytest.mark.requirement("P-11")
def test_a_direct_request_goes_one_way_and_says_so(robot) -> None:
    outcome = robot(0.25, 0.25).ask(place=(0.25, 0.35))
    assert (outcome.code, outcome.route, outcome.arm, outcome.attempts) == (Code.OK, "direct", "left", 1)


@pytest.mark.requirement("P-11")
def test_the_other_arm_is_asked_before_a_hand_over(robot) -> None:
    """At y = 0.14 the left arm is nearer, but the right one reaches both ends."""
    two = robot(0.25, 0.14)
    two.reaches = lambda arm, p: (p[1] >= 0.1) if arm == "left" else (p[1] <= 0.2)
    outcome = two.ask(place=(0.25, -0.30))
    assert (outcome.code, outcome.route, outcome.arm) == (Code.OK, "direct", "right")
    assert any("from the other side" in note for note in two.notes)


@pytest.mark.requirement("P-12")
def test_an_object_goes_from_hand_to_hand_by_way_of_the_middle(robot) -> None:
    two = robot(0.25, -0.30, ("blue", 0.25, 0.15))
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.code, outcome.route, outcome.kind) == (Code.OK, "hand_over", "SUCCESS")
    assert outcome.arm == "left"
    assert two.objects["red"].p_base[:2] == pytest.approx((0.25, 0.30), abs=1e-6)
    lifts = [effect.arm for effect in two.done(Follow) if effect.trajectory == "lift"]
    assert lifts == ["right", "left"]
    notes = [note for note in two.notes if "hand-over" in note]
    assert "1 of 2: the right arm brings it to the middle" in notes[0]
    assert "2 of 2" in notes[1]
    # In between it stood where both reach, clear of the other object.
    middle = two.session.context.config.hand_over
    first = [effect for effect in two.done(PlanPlace) if effect.arm == "right"][-1]
    x, y, _ = first.targets[0].position
    assert middle.x[0] <= x <= middle.x[1]
    assert abs(y) <= middle.abs_y


@pytest.fixture
def two(robot) -> World:
    """A red cube on the right side, that only the right arm reaches."""
    return robot(0.25, -0.30)


@pytest.mark.requirement("P-12")
def test_a_taker_that_fails_leaves_a_partial_result_that_says_where_the_object_is(two: World) -> None:
    two.fail(lambda e: isinstance(e, Follow) and e.arm == "left" and e.trajectory == "approach",
                   Code.EXECUTION_FAILED)  # fmt: skip
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.kind, outcome.code, outcome.route) == ("PARTIAL", Code.EXECUTION_FAILED, "")
    x, y, _ = two.objects["red"].p_base
    assert f"'red' was seen at ({x:.3f}, {y:.3f}) m" in outcome.message
    assert abs(y) <= two.session.context.config.hand_over.abs_y


@pytest.mark.parametrize(("margin", "spot_y"), [(0.0, -0.03), (0.005, 0.0)])
@pytest.mark.requirement("P-12")
def test_the_taker_must_cope_with_an_object_that_stands_a_little_off(robot, margin, spot_y) -> None:
    """The nearest spot is within the taker's reach by 2 mm: too little, once a margin is asked for."""
    two = robot(0.25, -0.30, hand_over={"margin": margin, "margin_deg": 0.0, "tries": 50})
    two.reaches = lambda arm, p: p[1] <= OVER if arm == "right" else p[1] >= -0.032
    outcome = two.ask(place=(0.25, 0.30), dry_run=True)
    assert (outcome.code, outcome.route) == (Code.OK, "hand_over")
    assert f"{spot_y:.3f}) m, and the left arm from there" in outcome.message.replace("-0.000", "0.000")


@pytest.mark.long
@pytest.mark.requirement("P-12")
def test_a_spot_without_margin_is_better_than_none(robot) -> None:
    two = robot(0.25, -0.30, hand_over={"abs_y": 0.001, "tries": 50})
    two.reaches = lambda arm, p: p[1] <= OVER if arm == "right" else p[1] >= 0.0
    outcome = two.ask(place=(0.25, 0.30), dry_run=True)
    assert (outcome.code, outcome.route) == (Code.OK, "hand_over")
    assert "0.001) m, and the left arm" in outcome.message


def lifts(two: World) -> list[str]:
    return [effect.arm for effect in two.done(Follow) if effect.trajectory == "lift"]


def shy_taker(two: World, times: int) -> None:
    """The left arm cannot grasp the object where it truly stands, so many times; the plan ahead did not know."""

    def reaches(arm: str, p: np.ndarray) -> bool:
        if arm == "right":
            return float(p[1]) <= OVER
        red, brought = two.objects.get("red"), len(lifts(two))
        there = red is not None and float(np.linalg.norm(red.p_base[:2] - p[:2])) < 0.02
        return float(p[1]) >= -OVER and not (there and 0 < brought <= times)

    two.reaches = reaches


@pytest.mark.requirement("P-12")
def test_a_taker_that_is_refused_after_all_gets_the_object_elsewhere(two: World) -> None:
    shy_taker(two, 1)
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.code, outcome.route, outcome.arm) == (Code.OK, "hand_over", "left")
    assert lifts(two) == ["right", "right", "left"]
    assert outcome.message.endswith("m, at try number 2")
    assert any("searching for another way from where it stands now" in note for note in two.notes)


@pytest.mark.requirement("P-12")
def test_it_is_brought_to_the_middle_as_often_as_the_parameter_says(robot) -> None:
    two = robot(0.25, -0.30, hand_over={"rounds": 2})
    shy_taker(two, 9)
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.kind, outcome.code, outcome.route) == ("PARTIAL", Code.UNREACHABLE, "")
    assert lifts(two) == ["right", "right"]
    x, y, _ = two.objects["red"].p_base
    assert f"at try number 2 'red' was seen at ({x:.3f}, {y:.3f}) m" in outcome.message


@pytest.mark.requirement("P-12")
def test_without_another_way_the_answer_says_both(two: World) -> None:
    """From the middle the right arm cannot lift it again."""
    shy_taker(two, 9)
    reaches = two.reaches

    def holds_on(arm: str, p: np.ndarray) -> bool:
        stands = "red" in two.objects and bool(lifts(two))
        return reaches(arm, p) and not (arm == "right" and stands and abs(p[1]) < 0.04)

    two.reaches = holds_on
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.kind, outcome.code) == ("PARTIAL", Code.UNREACHABLE)
    assert "no hand-over through the middle" in outcome.message
    assert "'red' was seen at" in outcome.message


@pytest.mark.requirement("P-12")
def test_a_giver_that_fails_never_calls_the_taker(two: World) -> None:
    two.fail(lambda e: isinstance(e, Follow) and e.trajectory == "approach", Code.EXECUTION_FAILED)
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.kind, outcome.code) == ("FAILED", Code.EXECUTION_FAILED)
    assert "on the way to the middle" in outcome.message
    assert {e.arm for e in two.done(Follow)} == {"right"}


@pytest.mark.requirement("P-11")
def test_a_full_middle_is_a_reason_to_refuse(robot) -> None:
    two = robot(0.25, -0.30, ("blue", 0.20, 0.0), ("green", 0.26, 0.0), ("orange", 0.32, 0.0))
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.kind, outcome.code) == ("REFUSED", Code.UNREACHABLE)
    assert "no free spot in the middle" in outcome.message
    assert not two.done(Follow)


@pytest.mark.requirement("P-11")
def test_an_arm_that_was_asked_for_is_not_replaced(robot) -> None:
    outcome = robot(0.25, -0.30).ask(place=(0.25, 0.30), arm="right")
    assert (outcome.kind, outcome.code) == ("REFUSED", Code.UNREACHABLE)


@pytest.mark.requirement("P-12")
def test_a_dry_run_reports_the_route_and_moves_nothing(two: World) -> None:
    outcome = two.ask(place=(0.25, 0.30), dry_run=True)
    assert (outcome.code, outcome.route) == (Code.OK, "hand_over")
    assert "the right arm brings it to the middle" in outcome.message
    assert not [e for _, e in two.log if isinstance(e, Follow | Grip | GoHome)]


def test_cancel_between_the_parts_ends_the_whole(two: World) -> None:
    two.on_report = lambda status: setattr(two, "stopped", Code.CANCELLED if "another way" in status.reason else None)
    outcome = two.ask(place=(0.25, 0.30))
    assert (outcome.kind, outcome.code) == ("CANCELLED", Code.CANCELLED)
