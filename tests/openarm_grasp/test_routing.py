# SPDX-License-Identifier: Apache-2.0
"""Which arm, and the sentence for what no arm reaches."""

from __future__ import annotations

import pytest

from openarm_common.errors import Code
from openarm_grasp.planning.arms import arm_order, out_of_reach, sides
from tests.refusals import refused

SHOULDERS = {"left": (0.0, 0.15), "right": (0.0, -0.15)}


@pytest.mark.parametrize(
    ("arm", "y", "expected"),
    [
        ("auto", 0.30, ("left",)),
        ("auto", -0.30, ("right",)),
        ("auto", 0.05, ("left", "right")),
        ("auto", -0.05, ("right", "left")),
        ("", -0.30, ("right",)),
        ("left", -0.30, ("left",)),
        ("right", 0.30, ("right",)),
    ],
)
@pytest.mark.requirement("P-11")
def test_arms_by_side_and_overlap(arm, y, expected):
    assert arm_order(arm, y, 0.12, SHOULDERS) == expected


@pytest.mark.parametrize("y", [-0.3, 0.0, 0.3])
def test_the_one_arm_of_a_robot_does_all(y):
    assert arm_order("auto", y, 0.12, {"main": (0.0, 0.0)}) == ("main",)
    assert sides("main", {"main": (0.0, 0.0)}) == (1.0, -1.0)


def test_of_three_arms_the_nearest_come_first():
    three = {"a": (0.0, 0.5), "b": (0.0, 0.0), "c": (0.0, -0.5)}
    assert arm_order("auto", 0.2, 0.12, three) == ("b", "a")
    assert arm_order("auto", -0.5, 0.12, three) == ("c",)


def test_an_unknown_arm_is_refused_with_the_choices():
    assert refused("auto, left, right", arm_order, "middle", 0.0, 0.12, SHOULDERS).code is Code.INVALID_ARGUMENT


def test_out_of_reach_names_the_nearest_arm_first():
    text = out_of_reach("'red' at (0.7, 0.0, 0.4) m", {"left": 0.31, "right": 0.23})
    assert text.index("right arm gets within 230 mm") < text.index("left arm gets within 310 mm")


def test_a_point_that_is_reached_but_not_graspable_says_so():
    assert "no orientation" in out_of_reach("'red'", {"right": 0.0})
