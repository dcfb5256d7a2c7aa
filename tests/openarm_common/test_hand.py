# SPDX-License-Identifier: Apache-2.0
"""The hand: finger joints and fingers, of a slide and of a hinge."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from openarm_common.robot.description import RobotDescription
from openarm_common.robot.hand import Hand, HandParts

MEASURES = {
    "opening": 0.04,
    "tip_clearance": 0.012,
    "tip_clearance_tilted": 0.018,
    "pad_centre": 0.017,
    "palm_depth": 0.045,
    "palm_depth_tilted": 0.03,
    "armature": 0.01,
}
#: Fingers of 9 cm on hinges: `sin` as a table.
HINGE = HandParts.model_validate(
    MEASURES
    | {"fingers": [[x, 0.09 * np.sin(x)] for x in np.linspace(0.0, 0.8, 9)], "tcp": [[0.0, 0.0], [0.04, -0.01]]}
)


@pytest.mark.parametrize("arm", ["left", "right"])
def test_a_slide_is_its_finger(arm: str) -> None:
    hand = RobotDescription.load("openarm_v1").hand(arm)
    assert hand.lever == 1.0
    assert (hand.closed, hand.opened) == (0.0, 0.044)
    assert hand.finger(0.0123) == pytest.approx(0.0123)


@given(st.floats(-0.01, 0.08), st.sampled_from([1.0, -1.0]))
def test_positions_and_fingers_are_inverse_to_each_other(finger: float, sign: float) -> None:
    hand = Hand("joint", sign, HINGE)
    assert hand.finger(hand.position(finger)) == pytest.approx(finger, abs=1e-12)
    assert sign * hand.lever > 0.0
    assert hand.lever == pytest.approx(sign * 0.0867, rel=0.01)  # m/rad, up to where it is open


def test_pads_meet_an_object_where_the_table_says() -> None:
    assert HINGE.tcp_shift(0.02) == pytest.approx(-0.005)
    assert HINGE.tcp_shift(0.06) == pytest.approx(-0.01)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"fingers": [[0.0, 0.0], [0.1, 0.0]]}, "ascending"),
        ({"fingers": [[0.0, 0.0]]}, "at least 2"),
        ({"opening": 0.09}, "beyond the last"),
        ({"tcp": [[0.02, 0.0], [0.01, 0.0]]}, "ascending"),
    ],
)
def test_a_hand_that_can_not_be_is_refused(wrong: dict[str, object], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        HandParts.model_validate(HINGE.model_dump() | wrong)
