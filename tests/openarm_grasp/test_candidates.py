# SPDX-License-Identifier: Apache-2.0
"""Candidates: directions, heights, offsets, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_grasp.config import GraspConfig
from openarm_grasp.planning.candidates import Box, held_boxes, obstacle_boxes, propose, target_box, tcp_height, turned
from tests.refusals import refuses

TABLE = 0.40
CONFIG = GraspConfig()
HAND = RobotDescription.load().hand("right").parts
DOWN = np.array([0.0, 0.0, -1.0])


def box(x=0.26, y=-0.2, yaw=0.3, size=(0.04, 0.06, 0.05), label="red") -> Detection:
    T = se3.make(se3.rot_z(yaw), (x, y, TABLE + size[2] / 2.0))
    return Detection(label, 0.9, T, np.array(size))


boxes = st.builds(
    box,
    x=st.floats(0.16, 0.36),
    y=st.floats(-0.42, 0.42),
    yaw=st.floats(-np.pi, np.pi),
    size=st.tuples(st.floats(0.04, 0.07), st.floats(0.04, 0.08), st.floats(0.04, 0.115)),
)


@settings(max_examples=25)
@given(boxes)
@pytest.mark.requirement("B-42", "B-43", "B-44", "B-45", "B-46")
def test_candidates_of_any_box_lean_by_their_tilt_close_on_an_edge_and_come_along_their_own_axis(target):
    found, edges = propose(target, CONFIG, HAND), target.T_base_object[:2, :2]
    assert found[0].tilt == 0.0
    assert found[0].T_base_tcp[:3, 2] @ DOWN >= 0.99
    for c in found:
        R, p = c.T_base_tcp[:3, :3], c.T_base_tcp[:3, 3]
        assert pytest.approx(np.eye(3), abs=1e-9) == R @ R.T
        assert np.linalg.det(R) == pytest.approx(1.0)
        assert R[:, 2] @ DOWN == pytest.approx(np.cos(c.tilt))
        assert abs(R[2, 1]) < 1e-9
        assert np.max(np.abs(R[:2, 1] @ edges)) > 1.0 - 1e-9
        across = abs(R[:, 1] @ target.T_base_object[:3, 0]) > 0.5
        assert c.width == target.size[0 if across else 1]
        # Out of the fingers: from the pre-grasp to the grasp.
        assert 0.05 <= np.linalg.norm(c.approach_offset) <= 0.08
        assert -c.approach_offset @ R[:, 2] == pytest.approx(CONFIG.approach.pregrasp_distance)
        if c.tilt == 0.0:
            assert c.approach_offset == pytest.approx((0.0, 0.0, CONFIG.approach.pregrasp_distance))
        assert c.retreat_offset == pytest.approx((0.0, 0.0, CONFIG.approach.lift_height))
        # Over the centre and above the table.
        assert p[:2] == pytest.approx(target.p_base[:2])
        assert p[2] >= TABLE + 0.012
        assert target.top - p[2] <= 0.045 + 1e-9


@pytest.mark.requirement("B-46")
def test_pregrasp_distance_of_6_cm_is_a_parameter():
    config = GraspConfig.model_validate({"approach": {"pregrasp_distance": 0.06}})
    assert propose(box(), config, HAND)[0].approach_offset[2] == pytest.approx(0.06)


@pytest.mark.parametrize("value", [0.04, 0.09])
@pytest.mark.requirement("B-45")
def test_pregrasp_distance_is_5_to_8_cm(value):
    with pytest.raises(ValueError, match="pregrasp_distance"):
        GraspConfig.model_validate({"approach": {"pregrasp_distance": value}})


@pytest.mark.requirement("B-48")
def test_pregrasp_distance_must_exceed_the_path_tolerance():
    with pytest.raises(ValueError, match="at least twice path_tolerance"):
        GraspConfig.model_validate({"approach": {"pregrasp_distance": 0.06, "path_tolerance": 0.035}})


@pytest.mark.parametrize(
    ("height", "tilt_deg", "expected"),
    [
        (0.04, 0.0, 0.012),  # the tips decide
        (0.08, 0.0, 0.035),  # the palm decides: 0.08 - 0.045
        (0.062, 0.0, 0.017),
        (0.115, 0.0, 0.070),
        (0.04, 30.0, 0.021),
        (0.115, 30.0, 0.085),
    ],
)
def test_tcp_height_clears_tips_and_palm(height, tilt_deg, expected):
    assert tcp_height(height, np.radians(tilt_deg), HAND) == pytest.approx(expected)


def test_a_square_box_offers_both_edges_flips_tilts_and_leans():
    found = propose(box(size=(0.05, 0.05, 0.05)), CONFIG, HAND)
    assert len(found) == 2 * 2 * (1 + 3 * 2)
    assert len({c.id for c in found}) == len(found)


def can(x=0.26, y=-0.2, yaw=0.0, width=0.06) -> Detection:
    return replace(box(x, y, yaw, (width, width, 0.08)), round=True)


@settings(max_examples=10)
@given(st.floats(-np.pi, np.pi))
@pytest.mark.requirement("B-43")
def test_what_is_round_is_taken_from_any_side(yaw):
    """Whatever yaw the camera gave it: a hand stands across every 30 degrees."""
    found = propose(can(yaw=yaw), CONFIG, HAND)
    assert len({c.id for c in found}) == len(found) == 6 * 2 * (1 + 3 * 2)
    across = {round(np.degrees(np.arctan2(*c.T_base_tcp[[1, 0], 1]))) % 360 for c in found if c.tilt == 0.0}
    assert across == set(range(0, 360, 30))
    assert {c.width for c in found} == {0.06}


@pytest.mark.requirement("B-43")
def test_the_steps_around_what_is_round_are_a_parameter():
    config = GraspConfig.model_validate({"approach": {"round_step_deg": 45.0, "tilts_deg": [0.0]}})
    assert [c.id for c in propose(can(), config, HAND)] == [f"red/{a}{f}/tilt0" for a in (0, 45, 90, 135) for f in "+-"]


def test_something_round_and_too_wide_is_refused():
    with refuses(Code.TOO_WIDE, "85 mm × 85 mm"):
        propose(can(width=0.085), CONFIG, HAND)


def test_tilts_are_tried_in_order():
    tilts = [c.tilt for c in propose(box(), CONFIG, HAND)]
    assert tilts == sorted(tilts)


def test_leaning_away_from_the_shoulder_comes_first():
    found = propose(box(x=0.3, y=-0.15, yaw=np.pi / 2), CONFIG, HAND, shoulder_xy=(0.0, -0.15))
    leaning = next(c for c in found if c.tilt > 0.0 and abs(c.T_base_tcp[0, 2]) > 0.1)
    assert leaning.T_base_tcp[0, 2] > 0.0


def test_score_is_the_sum_of_its_parts():
    for c in propose(box(), CONFIG, HAND):
        assert c.score == pytest.approx(sum(c.parts.values()))
        assert set(c.parts) == {"tilt", "width", "side", "room"}


@pytest.mark.requirement("N-21")
def test_hands_whose_fingers_have_room_come_first():
    """A block stands close to the narrow side, across which the hand would close by itself: it turns by a quarter."""
    alone = box(yaw=0.0, size=(0.045, 0.05, 0.05))
    neighbour = box(x=alone.p_base[0] + 0.075, yaw=0.0, size=(0.05, 0.05, 0.05), label="blue")
    assert "/x" in propose(alone, CONFIG, HAND)[0].id
    offered = propose(alone, CONFIG, HAND, others=(neighbour,))
    assert "/y" in offered[0].id
    rooms = {c.id.split("/")[1][0]: c.parts["room"] for c in offered}
    assert rooms["y"] == 0.0
    assert rooms["x"] < -0.15  # the finger would stand in the block
    assert len(offered) == len(propose(alone, CONFIG, HAND))  # the planner has the last word


def test_only_the_narrow_edge_of_a_wide_box_is_grasped():
    found = propose(box(size=(0.05, 0.09, 0.05)), CONFIG, HAND)
    assert {c.width for c in found} == {0.05}


@pytest.mark.requirement("B-17")
def test_too_wide_states_widths_and_limit():
    with refuses(Code.TOO_WIDE, "85 mm × 90 mm") as error:
        propose(box(size=(0.085, 0.09, 0.05)), CONFIG, HAND)
    assert "78 mm" in error.value.message


def test_a_78_mm_side_measured_a_millimetre_too_wide_is_still_grasped():
    assert propose(box(size=(0.079, 0.079, 0.05)), CONFIG, HAND)


def test_target_box_ends_above_the_table_and_at_the_top():
    target = box()
    made = target_box(target, CONFIG)
    half = made.size[2] / 2.0
    assert made.T_frame_box[2, 3] - half == pytest.approx(TABLE + CONFIG.approach.table_gap)
    assert made.T_frame_box[2, 3] + half == pytest.approx(target.top)


def test_obstacles_are_inflated_sideways_and_upwards():
    other = box(label="blue")
    made = obstacle_boxes([other], CONFIG)[0]
    assert made.id == "detected/blue_0"
    assert made.size == pytest.approx(other.size + np.array([0.01, 0.01, 0.005]))
    assert made.T_frame_box[2, 3] - made.size[2] / 2.0 == pytest.approx(other.bottom)


def test_held_box_is_the_target_seen_from_the_hand():
    target, c = box(), propose(box(), CONFIG, HAND)[0]
    (held,) = held_boxes(target, c, CONFIG)
    assert c.T_base_tcp @ held.T_frame_box == pytest.approx(target_box(target, CONFIG).T_frame_box)
    # Centred between the fingers.
    assert held.T_frame_box[1, 3] == pytest.approx(0.0, abs=1e-9)


def test_what_is_no_box_is_held_as_the_boxes_about_its_cloud():
    target, c = box(), propose(box(), CONFIG, HAND)[0]
    parts = tuple(Box(f"target/red_{n}", se3.make(p=(0.3, -0.2, 0.42 + n * 0.02)), np.full(3, 0.02)) for n in (0, 1))
    held = held_boxes(target, replace(c, held=parts), CONFIG)
    assert [one.id for one in held] == ["target/red_0", "target/red_1"]
    for one, part in zip(held, parts, strict=True):
        assert c.T_base_tcp @ one.T_frame_box == pytest.approx(part.T_frame_box)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_hand_that_is_turned_a_little_holds_at_the_same_place_and_stays_above_the_table(axis):
    for one in propose(box(size=(0.05, 0.09, 0.03)), CONFIG, HAND):
        for angle in (0.09, -0.09):
            other = turned(one, axis, angle, HAND)
            assert se3.angle_between(other.T_base_tcp[:3, :3], one.T_base_tcp[:3, :3]) == pytest.approx(0.09)
            raised = other.T_base_tcp[:3, 3] - one.T_base_tcp[:3, 3]
            assert raised[:2] == pytest.approx((0.0, 0.0))
            assert 0.0 <= raised[2] < 0.008
            lower = HAND.opening * abs(other.T_base_tcp[2, 1])  # of the two fingers
            assert other.T_base_tcp[2, 3] - lower >= one.T_base_tcp[2, 3] - 1e-9 - HAND.opening * abs(
                one.T_base_tcp[2, 1]
            )
            assert other.approach_offset == pytest.approx(-CONFIG.approach.pregrasp_distance * other.T_base_tcp[:3, 2])
            assert -other.T_base_tcp[2, 2] == pytest.approx(np.cos(other.tilt))
            assert other.score < one.score
