# SPDX-License-Identifier: Apache-2.0
"""Evidence: truth tables of hand and camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code
from openarm_grasp.config import HeldConfig
from openarm_grasp.evidence.verdicts import (
    Evidence,
    Grip,
    GripVerdict,
    Sight,
    SightVerdict,
    judge_grip,
    judge_lift,
    judge_place,
    judge_sight,
    judge_still,
)
from openarm_grasp.perception.detections import Frame

HELD = HeldConfig()
GOOD = Evidence(gap=0.0503, expected=0.05, effort=-30.0, speed=0.0)


def seen(label="red", x=0.26, y=-0.2, top=0.45, height=0.05) -> Detection:
    return Detection(label, 0.9, se3.make(p=(x, y, top - height / 2.0)), np.array([0.05, 0.05, height]))


def larger(**kwargs) -> Detection:
    return replace(seen(**kwargs), size=np.array([0.05, 0.09, 0.05]))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, Grip.HELD),
        ({"gap": 0.0505, "effort": 14.0}, Grip.HELD),
        ({"gap": 0.051}, Grip.HELD),
        ({"gap": 0.0}, Grip.EMPTY),
        ({"gap": 0.003}, Grip.EMPTY),
        ({"gap": 0.0, "effort": 0.0}, Grip.EMPTY),
        ({"gap": 0.044}, Grip.EMPTY),
        ({"gap": 0.056}, Grip.HAND_COLLISION),
        ({"gap": 0.080}, Grip.HAND_COLLISION),
        ({"speed": 0.002}, Grip.MOVING),
        ({"speed": -0.002}, Grip.MOVING),
        ({"effort": 0.0}, Grip.EMPTY),
        ({"effort": 5.0}, Grip.EMPTY),
        ({"effort": 5.1}, Grip.HELD),
        ({"tcp_error": 0.009}, Grip.HAND_COLLISION),
        ({"tcp_error": 0.008}, Grip.HELD),
    ],
)
@pytest.mark.requirement("A-71")
def test_grip_truth_table(changes, expected):
    evidence = Evidence(**{**vars(GOOD), **changes})
    grip, reason = judge_grip(evidence, HELD)
    assert grip is expected
    assert reason


@pytest.mark.parametrize(("pads", "held"), [((12.0, 14.0), True), ((12.0, 0.4), False), ((), False)])
@pytest.mark.requirement("A-69")
def test_where_there_are_sensors_both_pads_must_feel_the_object(pads, held):
    evidence = Evidence(**{**vars(GOOD), "pads": pads})
    grip, reason = judge_grip(evidence, HeldConfig(use_finger_force=True))
    assert (grip is Grip.HELD) == held, reason
    assert judge_grip(evidence, HELD)[0] is Grip.HELD  # without, the pads decide nothing


def test_a_driver_that_reports_no_effort_is_judged_by_the_gap():
    config = HeldConfig(use_effort=False)
    assert judge_grip(Evidence(0.05, 0.05, 0.0, 0.0), config)[0] is Grip.HELD
    assert judge_grip(Evidence(0.0, 0.05, 0.0, 0.0), config)[0] is Grip.EMPTY


@pytest.mark.parametrize(("gap", "effort"), [(0.0, 0.0), (0.05, 0.0), (0.02, 30.0)])
def test_what_was_held_and_is_not_is_lost(gap, effort):
    grip, _ = judge_grip(Evidence(gap, 0.05, effort, 0.0), HELD, was_held=True)
    assert grip is Grip.LOST
    assert grip.code is Code.GRASP_LOST


@pytest.mark.parametrize(
    ("after", "expected"),
    [
        ([], Sight.BLIND),
        ([Frame(1, ())], Sight.GONE),
        ([Frame(1, (seen("blue"),))], Sight.GONE),
        ([Frame(1, (seen(top=0.57, height=0.17),))], Sight.RISEN),
        ([Frame(1, (seen(top=0.481),))], Sight.RISEN),
        ([Frame(1, (seen(top=0.47),))], Sight.STILL_THERE),
        ([Frame(1, (seen(x=0.27),))], Sight.STILL_THERE),
        ([Frame(1, (seen(x=0.36),))], Sight.GONE),
        ([Frame(1, (seen(x=0.28, top=0.56),))], Sight.ASKEW),
        ([Frame(1, ()), Frame(2, (seen(),))], Sight.STILL_THERE),
        ([Frame(1, (seen(),)), Frame(2, ())], Sight.STILL_THERE),
    ],
)
@pytest.mark.requirement("P-08")
def test_sight_truth_table(after, expected):
    sight, reason = judge_sight(seen(), after, HELD, match_radius=0.03)
    assert sight is expected
    assert reason


@pytest.mark.parametrize("sight", list(Sight))
@pytest.mark.parametrize("grip", list(Grip))
@pytest.mark.requirement("A-71", "P-08")
def test_a_lift_needs_hand_and_camera(grip, sight):
    verdict = judge_lift(GripVerdict(grip, "hand"), SightVerdict(sight, "camera"))
    assert verdict.ok == (grip is Grip.HELD and sight in (Sight.RISEN, Sight.GONE))
    if grip is not Grip.HELD:
        assert verdict.code is grip.code
    elif sight is Sight.BLIND:
        assert verdict.code is Code.STALE_DATA


@pytest.mark.requirement("A-71")
def test_without_an_object_nothing_is_held():
    """The hand closes on nothing and the camera sees nothing: no evidence, no success."""
    grip = judge_grip(Evidence(gap=0.0, expected=0.05, effort=0.0, speed=0.0), HELD)
    sight = judge_sight(seen(), [Frame(1, ())], HELD, match_radius=0.03)
    verdict = judge_lift(grip, sight)
    assert verdict.code is Code.GRASP_MISSED


@pytest.mark.parametrize(
    ("frames", "code"),
    [
        ([], Code.STALE_DATA),
        ([Frame(1, ())], Code.PLACE_FAILED),
        ([Frame(1, (seen(x=0.27),))], Code.OK),
        ([Frame(1, (seen(x=0.281),))], Code.PLACE_FAILED),
        ([Frame(1, (seen("blue"),))], Code.PLACE_FAILED),
        ([Frame(1, (seen(),)), Frame(2, ())], Code.OK),  # missed once
        ([Frame(1, (seen(),)), Frame(2, (seen(x=0.29),))], Code.PLACE_FAILED),
    ],
)
@pytest.mark.requirement("P-09")
def test_a_place_counts_when_the_camera_sees_it_within_2_cm(frames, code):
    verdict = judge_place("red", np.array([0.26, -0.2, 0.4]), frames, 0.02)
    assert verdict.code is code


@pytest.mark.requirement("P-08")
def test_a_twin_elsewhere_is_not_taken_for_the_lifted_object() -> None:
    """A taller object of the same label stands beside: it proves nothing, and the one that is gone is gone."""
    twin = seen(x=0.40, top=0.50, height=0.10)
    assert judge_sight(seen(), [Frame(1, (twin,))], HELD, match_radius=0.03)[0] is Sight.ASKEW
    assert judge_sight(seen(), [Frame(1, (twin,))], HELD, match_radius=0.03, others=(twin,))[0] is Sight.GONE


@pytest.mark.parametrize(
    ("found", "still"),
    [
        ((), True),  # the hand hides it
        ((seen(x=0.27),), True),
        ((seen(x=0.28),), False),
        ((seen(x=0.40),), True),  # another one
        ((seen("blue", x=0.28),), True),
        ((larger(x=0.29),), True),  # pixels of the hand are in it
    ],
)
@pytest.mark.requirement("N-03")
def test_an_object_that_has_moved_is_noticed_before_the_hand_goes_down(found, still) -> None:
    assert judge_still(seen(), [Frame(1, found)], HELD)[0] is still


@pytest.mark.parametrize(
    ("height", "code"), [(0.05, Code.OK), (0.054, Code.OK), (0.06, Code.PLACE_FAILED), (0.04, Code.PLACE_FAILED)]
)
@pytest.mark.requirement("P-09")
def test_what_has_fallen_over_is_not_placed_and_no_other_try_would_help(height, code) -> None:
    verdict = judge_place("red", np.array([0.26, -0.2, 0.4]), [Frame(1, (seen(),))], 0.02, height=height)
    assert verdict.code is code
    assert verdict.final == (code is not Code.OK)
