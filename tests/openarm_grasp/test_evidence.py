# SPDX-License-Identifier: Apache-2.0
"""Evidence: truth tables of hand and camera."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code
from openarm_common.robot.zeros import HandReach
from openarm_grasp.config import HeldConfig
from openarm_grasp.evidence.verdicts import (
    Evidence,
    Verdict,
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
    ("changes", "code", "reason"),
    [
        ({}, Code.OK, "held"),
        ({"gap": 0.0505, "effort": 14.0}, Code.OK, "held"),
        ({"gap": 0.051}, Code.OK, "held"),
        ({"gap": 0.0}, Code.GRASP_MISSED, "closed on nothing"),
        ({"gap": 0.003}, Code.GRASP_MISSED, "closed on nothing"),
        ({"gap": 0.0, "effort": 0.0}, Code.GRASP_MISSED, "closed on nothing"),
        ({"gap": 0.044}, Code.GRASP_MISSED, "narrower"),
        ({"gap": 0.056}, Code.HAND_COLLISION, "wider"),
        ({"gap": 0.080}, Code.HAND_COLLISION, "wider"),
        ({"speed": 0.002}, Code.GRASP_MISSED, "expected rest"),
        ({"speed": -0.002}, Code.GRASP_MISSED, "expected rest"),
        ({"effort": 0.0}, Code.GRASP_MISSED, "press with"),
        ({"effort": 5.0}, Code.GRASP_MISSED, "press with"),
        ({"effort": 5.1}, Code.OK, "held"),
        ({"tcp_error": 0.009}, Code.HAND_COLLISION, "from the grasp"),
        ({"tcp_error": 0.008}, Code.OK, "held"),
    ],
)
@pytest.mark.requirement("A-71")
def test_grip_truth_table(changes, code, reason):
    verdict = judge_grip(Evidence(**{**vars(GOOD), **changes}), HELD)
    assert verdict.code is code
    assert reason in verdict.reason


@pytest.mark.parametrize(
    ("gap", "effort", "empty", "reason"),
    [
        (0.0032, -6.4, True, "closed on nothing$"),
        (0.0062, -11.0, True, "closed on nothing$"),
        (0.0062, -12.0, False, "narrower"),  # firmer than closed on nothing: something thin is between the fingers
        (0.0010, -30.0, False, "narrower"),
        (
            0.0010,
            -6.0,
            True,
            "closed on nothing; this hand goes from 3.2 to 76.0 mm, learned undated: were its fingers",
        ),
        (0.0064, -6.4, False, "narrower"),
    ],
)
@pytest.mark.requirement("A-71")
def test_a_hand_that_was_learned_is_empty_where_it_reads_what_it_read_closed_on_nothing(gap, effort, empty, reason):
    evidence = replace(GOOD, gap=gap, effort=effort, reach=HandReach(closed=0.0016, opened=0.038, effort=6.4))
    assert evidence.empty(HELD) is empty
    assert re.search(reason, judge_grip(evidence, HELD).reason)
    assert replace(evidence, gap=min(gap, 0.0062)).empty(HeldConfig(use_effort=False))


@pytest.mark.parametrize(("pads", "held"), [((12.0, 14.0), True), ((12.0, 0.4), False), ((), False)])
@pytest.mark.requirement("A-69")
def test_where_there_are_sensors_both_pads_must_feel_the_object(pads, held):
    evidence = Evidence(**{**vars(GOOD), "pads": pads})
    verdict = judge_grip(evidence, HeldConfig(use_finger_force=True))
    assert verdict.ok == held, verdict.reason
    assert judge_grip(evidence, HELD).ok  # without, the pads decide nothing


def test_a_driver_that_reports_no_effort_is_judged_by_the_gap():
    config = HeldConfig(use_effort=False)
    assert judge_grip(Evidence(0.05, 0.05, 0.0, 0.0), config).ok
    assert judge_grip(Evidence(0.0, 0.05, 0.0, 0.0), config).code is Code.GRASP_MISSED


@pytest.mark.parametrize(("gap", "effort"), [(0.0, 0.0), (0.05, 0.0), (0.02, 30.0)])
def test_what_was_held_and_is_not_is_lost(gap, effort):
    assert judge_grip(Evidence(gap, 0.05, effort, 0.0), HELD, was_held=True).code is Code.GRASP_LOST


@pytest.mark.parametrize(
    ("after", "code", "reason"),
    [
        ([], Code.STALE_DATA, "no camera frame"),
        ([Frame(1, ())], Code.OK, "has gone"),
        ([Frame(1, (seen("blue"),))], Code.OK, "has gone"),
        ([Frame(1, (seen(top=0.57, height=0.17),))], Code.OK, "higher"),
        ([Frame(1, (seen(top=0.481),))], Code.OK, "higher"),
        ([Frame(1, (seen(top=0.47),))], Code.GRASP_MISSED, "still stands"),
        ([Frame(1, (seen(x=0.27),))], Code.GRASP_MISSED, "still stands"),
        ([Frame(1, (seen(x=0.36),))], Code.OK, "has left"),
        ([Frame(1, (seen(x=0.28, top=0.56),))], Code.GRASP_MISSED, "out of where"),
        ([Frame(1, (replace(seen(x=0.28, top=0.56), measured=False),))], Code.OK, "higher"),  # a part of it
        ([Frame(1, ()), Frame(2, (seen(),))], Code.GRASP_MISSED, "still stands"),
        ([Frame(1, (seen(),)), Frame(2, ())], Code.GRASP_MISSED, "still stands"),
    ],
)
@pytest.mark.requirement("P-08")
def test_sight_truth_table(after, code, reason):
    verdict = judge_sight(seen(), after, HELD, match_radius=0.03)
    assert verdict.code is code
    assert reason in verdict.reason


@pytest.mark.parametrize(
    ("top", "code"),
    [(0.57, Code.OK), (0.535, Code.OK), (0.511, Code.OK), (0.509, Code.GRASP_LOST), (0.485, Code.GRASP_LOST)],
)
@pytest.mark.requirement("P-07")
def test_what_is_seen_more_than_a_centimetre_below_the_hold_has_slipped(top, code):
    """A cube of 5 cm was lifted by 12 cm: its lower face should be at 0.52 m."""
    seen_part = replace(seen(top=top, height=top - 0.4), measured=False)
    verdict = judge_sight(seen(), [Frame(1, (seen_part,))], HELD, match_radius=0.03, lift=0.12)
    assert verdict.code is code
    assert ("slipped by at least" in verdict.reason) is (code is Code.GRASP_LOST)


@pytest.mark.parametrize("sight", [Code.OK, Code.GRASP_MISSED, Code.STALE_DATA])
@pytest.mark.parametrize("grip", [Code.OK, Code.GRASP_MISSED, Code.HAND_COLLISION, Code.GRASP_LOST])
@pytest.mark.requirement("A-71", "P-08")
def test_a_lift_needs_hand_and_camera(grip, sight):
    verdict = judge_lift(Verdict(grip, "hand"), Verdict(sight, "camera"))
    assert verdict.ok == (grip is Code.OK and sight is Code.OK)
    assert verdict.code is (sight if grip is Code.OK else grip)


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


@pytest.mark.parametrize(
    ("edges", "code"),
    [
        ([(0.05, 0.05)], Code.OK),
        ([(0.06, 0.05), (0.07, 0.06)], Code.OK),  # in one frame only
        ([(0.05, 0.062), (0.062, 0.05)], Code.PLACE_FAILED),
        ([(0.04, 0.04)], Code.OK),  # a part is hidden
    ],
)
@pytest.mark.requirement("P-09")
def test_an_object_whose_footprint_has_grown_leans(edges, code) -> None:
    frames = [Frame(i, (replace(seen(), size=np.array([*edge, 0.05])),)) for i, edge in enumerate(edges)]
    target, footprint = np.array([0.26, -0.2, 0.4]), np.array([0.05, 0.05])
    verdict = judge_place("red", target, frames, 0.02, height=0.05, footprint=footprint)
    assert verdict.code is code, verdict.reason
    assert ("not stand upright" in verdict.reason) is (code is not Code.OK)


@pytest.mark.requirement("P-08")
def test_a_twin_elsewhere_is_not_taken_for_the_lifted_object() -> None:
    """A taller object of the same label stands next to it: it proves nothing, and the one that is gone is gone."""
    twin = seen(x=0.40, top=0.50, height=0.10)
    assert judge_sight(seen(), [Frame(1, (twin,))], HELD, match_radius=0.03).code is Code.GRASP_MISSED
    assert judge_sight(seen(), [Frame(1, (twin,))], HELD, match_radius=0.03, others=(twin,)).ok


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
