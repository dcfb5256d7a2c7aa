# SPDX-License-Identifier: Apache-2.0
"""Placing: the object's place in the hand, free spots, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.detection import Detection, distances_from
from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_grasp.config import GraspConfig
from openarm_grasp.planning.candidates import GraspCandidate, propose
from openarm_grasp.planning.place import check_position, free_spots, other_grasps, place_targets, yaw_offsets
from tests.refusals import refused, refuses

CONFIG = GraspConfig()
HAND = RobotDescription.load().hand("right").parts
SHOULDERS = {"left": (0.0, 0.15), "right": (0.0, -0.15)}
TABLE = robot_work().table


def box(x=0.26, y=-0.2, yaw=0.3, size=(0.04, 0.06, 0.05), label="red") -> Detection:
    return Detection(label, 0.9, se3.make(se3.rot_z(yaw), (x, y, 0.4 + size[2] / 2.0)), np.array(size))


@settings(max_examples=25)
@given(st.floats(-3.0, 3.0), st.integers(0, 27), st.floats(0.16, 0.36), st.floats(-0.42, -0.06))
def test_the_object_keeps_its_place_in_the_hand(yaw, which, x, y):
    target = box(yaw=yaw)
    candidate = propose(target, CONFIG, HAND)[which % 14]
    T_tcp_object = se3.inverse(candidate.T_base_tcp) @ target.T_base_object
    for t in place_targets(target, candidate, [np.array([x, y])], CONFIG):
        T_base_object = t.T_base_tcp @ T_tcp_object
        assert T_base_object[:2, 3] == pytest.approx((x, y))
        # Upright, a millimetre above touching, turned by the offset.
        assert T_base_object[2, 2] == pytest.approx(1.0)
        assert T_base_object[2, 3] - target.size[2] / 2.0 == pytest.approx(0.401)
        turn = target.T_base_object[:3, :3].T @ T_base_object[:3, :3]
        assert turn == pytest.approx(se3.rot_z(t.yaw_offset), abs=1e-9)


def test_the_hand_comes_from_above_and_leaves_along_its_own_axis():
    candidate = propose(box(), CONFIG, HAND)[-1]
    assert candidate.tilt > 0.7
    for t in place_targets(box(), candidate, [np.array([0.2, -0.3])], CONFIG):
        assert t.approach_offset == pytest.approx((0.0, 0.0, CONFIG.approach.pregrasp_distance))
        assert t.retreat_offset == pytest.approx(-CONFIG.approach.pregrasp_distance * t.T_base_tcp[:3, 2])
        assert t.position == pytest.approx((0.2, -0.3, 0.4))


def test_small_turns_of_every_spot_come_before_large_turns_of_the_first():
    spots = [np.array([0.2, -0.3]), np.array([0.3, -0.3])]
    ids = [t.id for t in place_targets(box(), propose(box(), CONFIG, HAND)[0], spots, CONFIG)]
    assert ids[0] == "spot0/yaw+0"
    assert set(ids[:6]) == {f"spot{i}/yaw{y}" for i in (0, 1) for y in ("+0", "+30", "-30")}
    assert len(ids) == 24


def hands_there(target: Detection, candidate: GraspCandidate, yaw: float | None) -> set[tuple[float, ...]]:
    """How a hand may stand at a place."""
    ways = place_targets(target, candidate, [np.array([0.2, -0.3])], CONFIG, yaw=yaw)
    return {tuple(np.round(way.T_base_tcp[:3].ravel(), 6) + 0.0) for way in ways}


@settings(max_examples=15)
@given(st.sampled_from([box(), box(size=(0.05, 0.05, 0.05)), replace(box(size=(0.05, 0.05, 0.05)), round=True)]),
       st.sampled_from([None, 0.8]), st.integers(0, 27))  # fmt: skip
def test_grasps_with_which_the_hand_could_not_stand_otherwise_are_left_out(target, yaw, which):
    offered = propose(target, CONFIG, HAND)
    failed = offered[which]
    left = other_grasps(offered, failed, Code.UNREACHABLE, target, yaw)
    there = hands_there(target, failed, yaw)
    for candidate in offered:
        assert (candidate in left) == (hands_there(target, candidate, yaw) != there)


@pytest.mark.parametrize(("target", "yaw", "rounds"), [(box(), None, 7), (box(), 0.8, 14)])
def test_every_way_to_stand_there_is_tried_once(target, yaw, rounds):
    left = propose(target, CONFIG, HAND)
    for _ in range(rounds):
        assert left
        left = other_grasps(left, left[0], Code.IN_COLLISION, target, yaw)
    assert not left


def test_a_search_that_failed_says_nothing_about_other_holds():
    offered = propose(box(), CONFIG, HAND)
    left = other_grasps(offered, offered[0], Code.NO_PLAN, box(), None)
    assert len(left) == 21
    assert not any(c.id.startswith("red/x+/") for c in left)


def test_what_is_round_looks_the_same_at_any_yaw():
    target = replace(box(size=(0.05, 0.05, 0.05)), round=True)
    ways = place_targets(target, propose(target, CONFIG, HAND)[0], [np.array([0.2, -0.3])], CONFIG, yaw=0.8)
    assert len(ways) == 12


def test_scores_follow_the_order():
    targets = place_targets(box(), propose(box(), CONFIG, HAND)[0], [np.array([0.2, -0.3])], CONFIG)
    scores = [t.score for t in targets]
    assert scores == sorted(scores, reverse=True)
    assert len(set(scores)) == 2  # small turns, large turns


def test_a_failed_spot_comes_last_and_a_failed_turn_of_the_only_spot_too():
    spots, candidate = [np.array([0.2, -0.3]), np.array([0.3, -0.3])], propose(box(), CONFIG, HAND)[0]
    first = place_targets(box(), candidate, spots, CONFIG)
    again = place_targets(box(), candidate, spots, CONFIG, used=first[:1])
    assert {t.id.split("/")[0] for t in again[:12]} == {"spot1"}
    only = place_targets(box(), candidate, spots[:1], CONFIG, used=first[:1])
    assert only[-1].id == "spot0/yaw+0"
    assert only[-1].score < min(t.score for t in only[:-1])


@pytest.mark.parametrize(("step", "count"), [(15.0, 24), (30.0, 12), (90.0, 4), (180.0, 2), (100.0, 3)])
def test_yaw_offsets_go_once_round(step, count):
    offsets = yaw_offsets(step)
    assert len(offsets) == count
    assert offsets[0] == 0.0
    assert len({round(np.cos(o), 6) + 1j * round(np.sin(o), 6) for o in offsets}) == count


@pytest.mark.parametrize("arm", ["left", "right"])
@pytest.mark.requirement("P-19")
def test_free_spots_keep_clear_of_neighbours_and_origin(arm):
    side = 1.0 if arm == "left" else -1.0
    target, others = (
        box(y=side * 0.2),
        [box(x=0.3, y=side * 0.33, label="blue"), box(x=0.2, y=side * 0.1, label="green")],
    )
    spots = free_spots(arm, target, others, CONFIG, SHOULDERS)
    assert 1 <= len(spots) <= CONFIG.place.spots
    for spot in spots:
        assert 0.16 <= spot[0] <= 0.36
        assert 0.06 <= side * spot[1] <= 0.42
        assert np.linalg.norm(spot - target.p_base[:2]) >= 0.08
        assert min(np.linalg.norm(spot - d.p_base[:2]) for d in others) >= 0.10


@pytest.mark.requirement("P-19")
def test_a_spot_that_leaves_room_for_a_hand_comes_before_a_nearer_one() -> None:
    """What is put down too near to another object blocks the way to it later."""
    target = box(x=0.17, y=-0.10)
    others = [box(x=x, y=y, label="blue") for x, y in ((0.33, -0.12), (0.20, -0.26), (0.34, -0.36))]

    def rooms(config: GraspConfig) -> list[float]:
        spots = free_spots("right", target, others, config, SHOULDERS)
        return [min(float(np.linalg.norm(spot - d.p_base[:2])) for d in others) for spot in spots]

    near = [room < CONFIG.place.neighbour_room for room in rooms(CONFIG)]
    assert near == sorted(near)
    assert not near[0]
    assert rooms(GraspConfig.model_validate({"place": {"neighbour_room": 0.0}}))[0] < CONFIG.place.neighbour_room


@pytest.mark.requirement("P-19")
def test_a_spot_that_something_long_reaches_into_is_not_chosen_where_there_are_others() -> None:
    """Its middle may be far from there."""
    target = box(x=0.2, y=-0.08, size=(0.10, 0.06, 0.05))
    long = box(x=0.27, y=-0.30, yaw=0.0, size=(0.04, 0.30, 0.05), label="blue")
    spots = np.array(free_spots("right", target, [long], CONFIG, SHOULDERS))
    assert len(spots) == CONFIG.place.spots
    assert distances_from(long, spots).min() >= 0.5 * np.hypot(0.10, 0.06)


def test_every_free_spot_is_offered_for_what_a_hand_has_kept() -> None:
    some = free_spots("right", box(y=-0.3), [], CONFIG, SHOULDERS)
    every = free_spots("right", box(y=-0.3), [], CONFIG, SHOULDERS, every=True)
    assert len(every) > len(some) == CONFIG.place.spots
    assert [*map(tuple, every[: len(some)])] == [*map(tuple, some)]


def test_a_full_table_has_no_free_spot():
    crowd = [box(x=x, y=y, label="blue") for x in np.arange(0.1, 0.5, 0.08) for y in np.arange(-0.5, 0.0, 0.08)]
    for every in (False, True):
        error = refused(None, free_spots, "right", box(), crowd, CONFIG, SHOULDERS, every=every)
        assert error.code is Code.PLACE_FAILED


@pytest.mark.parametrize("every", [False, True])
def test_an_object_is_put_down_next_to_others_where_no_spot_keeps_its_distance(every) -> None:
    crowd = [box(x=x, y=y, label="blue") for x in np.arange(0.1, 0.5, 0.14) for y in np.arange(-0.5, 0.0, 0.14)]
    spots = np.array(free_spots("right", box(), crowd, CONFIG, SHOULDERS, every=every))
    assert min(distances_from(one, spots).min() for one in crowd) >= 0.5 * min(box().size[:2])


@pytest.mark.requirement("P-19", "P-03")
def test_of_the_places_that_may_be_chosen_a_free_one_is():
    choices = ((0.2, -0.2), (0.3, -0.2), (0.2, -0.35), (0.2, 0.3))
    others = [box(x=0.21, y=-0.21, label="blue"), box(x=0.29, y=-0.2, label="green")]
    spots = free_spots("right", box(x=0.2, y=0.3), others, CONFIG, SHOULDERS, choices)
    assert [tuple(map(float, spot)) for spot in spots] == [(0.2, -0.35)]
    with refuses(Code.PLACE_FAILED, "none of 2 places is free"):
        free_spots("right", box(x=0.2, y=0.3), others, CONFIG, SHOULDERS, choices[:2])


@pytest.mark.parametrize("position", [(0.05, 0.0), (0.3, 0.7), (float("nan"), 0.1), (0.3, float("inf"), 0.4)])
def test_a_place_off_the_table_is_refused(position):
    assert refused("not on the table", check_position, position, box(), [], TABLE).code is Code.INVALID_ARGUMENT


def test_a_place_on_another_object_is_refused_with_its_name():
    with refuses(Code.IN_COLLISION, "'blue' stands 20 mm"):
        check_position((0.30, -0.30), box(), [box(x=0.32, y=-0.30, label="blue")], TABLE)


def test_a_place_next_to_another_object_is_left_to_the_planner():
    p = check_position((0.30, -0.30, 9.9), box(), [box(x=0.36, y=-0.30, label="blue")], TABLE)
    assert p == pytest.approx((0.30, -0.30))
