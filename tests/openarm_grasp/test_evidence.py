# SPDX-License-Identifier: Apache-2.0
"""Evidence: truth tables of the hand."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_common.robot.zeros import HandReach
from openarm_grasp.config import HeldConfig
from openarm_grasp.evidence.verdicts import (
    Evidence,
    Verdict,
    judge_grip,
    judge_lift,
    judge_path,
)

HELD = HeldConfig()
GOOD = Evidence(gap=0.0503, expected=0.05, effort=-30.0, speed=0.0)


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


@pytest.mark.parametrize("sight", [Code.OK, Code.GRASP_MISSED, Code.STALE_DATA])
@pytest.mark.parametrize("grip", [Code.OK, Code.GRASP_MISSED, Code.HAND_COLLISION, Code.GRASP_LOST])
@pytest.mark.requirement("A-71", "P-08")
def test_a_lift_needs_hand_and_camera(grip, sight):
    verdict = judge_lift(Verdict(grip, "hand"), Verdict(sight, "camera"))
    assert verdict.ok == (grip is Code.OK and sight is Code.OK)
    assert verdict.code is (sight if grip is Code.OK else grip)


@pytest.mark.parametrize(("steps", "goes"), [(0.08, True), (0.041, True), (0.035, False), (-0.08, False)])
def test_a_hand_has_pushed_when_it_has_gone_along_its_line(steps, goes):
    start, line = np.array([0.2, 0.1, 0.43]), np.array([0.0, 0.1, 0.0])
    verdict = judge_path(start, start + np.array([0.05, steps, 0.0]), line, 0.04)
    assert verdict.code is (Code.OK if goes else Code.EXECUTION_FAILED)
    assert f"the hand went {steps * 1e3:.0f} mm along its line of 100 mm" in verdict.reason
