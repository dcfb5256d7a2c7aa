# SPDX-License-Identifier: Apache-2.0
"""Antipodal grasps: of known shapes, wherever they stand, with room for the hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_grasp.config import ApproachConfig, CloudConfig
from openarm_grasp.sampling.antipodal import Search
from openarm_grasp.sampling.surface import View, fuse
from openarm_grasp.sampling.voxel_kernels import HIDDEN, OTHER, SEEN
from tests.openarm_grasp.clouds import ABOVE, SLANTED, TABLE_Z, ball, box, grasps, hand, seen, surface_of

APERTURE = 2.0 * 0.044


def tilted(parts, yaw, x, y):
    """Parts turned about the vertical through the middle of the region, and moved."""
    T = se3.make(p=(0.27 + x, -0.2 + y, 0.0)) @ se3.make(se3.rot_z(yaw)) @ se3.make(p=(-0.27, 0.2, 0.0))
    return [se3.apply(T, part) for part in parts], T


@pytest.mark.long
@settings(max_examples=2, phases=(Phase.explicit, Phase.generate))
@given(yaw=st.floats(-3.1, 3.1), x=st.floats(-0.05, 0.05), y=st.floats(-0.05, 0.05))
def test_an_object_turned_and_moved_gives_the_grasps_turned_and_moved(yaw, x, y):
    part = box((0.035, 0.11, 0.06))
    moved, T = tilted([part], yaw, x, y)
    camera = se3.apply(T, ABOVE)
    first, second = grasps(surface_of([part]))[0], grasps(surface_of(moved, camera))[0]
    for grasp, pose in ((first, np.eye(4)), (second, T)):
        local = se3.inverse(pose) @ grasp.T_base_tcp
        assert abs(local[0, 1]) > 0.99  # closes across the narrow side
        assert local[0, 3] == pytest.approx(0.27, abs=0.003)
        assert local[1, 3] == pytest.approx(-0.2, abs=0.012)
    assert first.width == pytest.approx(second.width, abs=0.006)  # a voxel each side
    assert first.score == pytest.approx(second.score, abs=0.6)


@settings(max_examples=3, phases=(Phase.explicit, Phase.generate))
@given(
    size=st.tuples(*[st.floats(0.015, 0.12)] * 3),
    yaw=st.floats(-1.5, 1.5),
    slanted=st.booleans(),
    neighbour=st.floats(0.06, 0.12),
)
def test_no_hand_is_in_what_was_seen_and_no_grasp_is_wider_than_the_hand(size, yaw, slanted, neighbour):
    part, other = box(size, yaw=yaw), box((0.03, 0.03, 0.10), x=0.27 + neighbour, y=-0.2 - neighbour)
    surface = surface_of([part], SLANTED if slanted else ABOVE, [other])
    shapes = {2.0 * one.opening: one for one in hand().narrower} | {None: hand()}
    everything = surface.middles(np.argwhere((surface.cells >= SEEN) & (surface.cells <= OTHER)))
    for grasp in grasps(surface):
        assert 0.0 < grasp.width < APERTURE
        assert grasp.apertures[0] <= grasp.width <= grasp.apertures[1] <= APERTURE
        shape = shapes[grasp.opened]
        local = se3.apply(se3.inverse(grasp.T_base_tcp), everything)
        near = ((local >= shape.points.min(axis=0)) & (local <= shape.points.max(axis=0))).all(axis=1)
        assert shape.holds(local[near]).max(initial=-1.0) <= 0.0
        assert se3.apply(grasp.T_base_tcp, shape.points)[:, 2].min() >= TABLE_Z
        assert se3.is_pose(grasp.T_base_tcp)


def test_the_same_surface_gives_the_same_grasps_whatever_the_global_generator_does():
    surface = surface_of([box((0.04, 0.06, 0.05), yaw=0.4)])
    first = grasps(surface)
    np.random.seed(7)
    second = grasps(surface)
    assert [g.score for g in first] == [g.score for g in second]
    assert all(np.array_equal(a.T_base_tcp, b.T_base_tcp) for a, b in zip(first, second, strict=True))


def test_a_ball_is_held_across_its_middle():
    best = grasps(surface_of([ball(0.03)]))[0]
    assert best.apertures[0] <= 0.06 <= best.apertures[1]
    y = best.T_base_tcp[:3, 1]
    off = (best.T_base_tcp[:3, 3] - (0.27, -0.2, TABLE_Z + 0.03)) @ y
    assert abs(off) < 0.003


def test_a_hammer_is_held_by_its_handle_near_the_head():
    handle, head = box((0.22, 0.024, 0.025)), box((0.03, 0.10, 0.03), x=0.27 + 0.11)
    surface = surface_of([handle, head])
    best = grasps(surface)[0]
    assert best.width < 0.05
    # the handle is 24 mm wide, the head 30 mm: the weight is between the middle and the head
    assert surface.centroid[0] > 0.28
    assert abs(best.T_base_tcp[0, 3] - surface.centroid[0]) < 0.035


def test_an_l_is_held_by_one_of_its_legs():
    legs = [box((0.12, 0.03, 0.04)), box((0.03, 0.10, 0.04), x=0.27 - 0.045, y=-0.2 + 0.05)]
    assert grasps(surface_of(legs))[0].width == pytest.approx(0.03, abs=0.005)


def test_what_is_wider_than_the_hand_in_all_directions_has_no_grasp():
    search = Search(surface_of([box((0.10, 0.10, 0.10), yaw=0.3)]), hand(), CloudConfig(), ApproachConfig())
    assert search.best() == ()


def test_where_nothing_narrower_is_there_the_hand_goes_around_what_leaves_little_room():
    config, opening = CloudConfig(), hand().opening
    for room, widest in ((0.012, opening - config.margin), (0.005, opening - 0.5 * config.margin)):
        width = 2.0 * opening - room
        search = Search(surface_of([box((width, width, 0.04))]), hand(), config, ApproachConfig())
        assert search.best()
        assert search.widest == pytest.approx(2.0 * widest)


def test_a_neighbour_keeps_the_fingers_away_from_its_side():
    target = box((0.04, 0.04, 0.06))
    walls = [box((0.02, 0.20, 0.06), x=0.27 + side * 0.045) for side in (1.0, -1.0)]
    for grasp in grasps(surface_of([target], others=walls)):
        assert abs(grasp.T_base_tcp[1, 1]) > 0.7  # fingers come in along the walls, not in them


def test_a_shadow_of_something_else_is_no_place_for_the_hand():
    target, tall = box((0.04, 0.04, 0.05)), box((0.04, 0.16, 0.15), x=0.35)
    camera = np.array([0.75, -0.2, 0.9])
    surface = surface_of([target], camera, [tall])
    if len(surface.points) < 20:
        pytest.fail("the object should be in view")
    hidden = surface.middles(np.argwhere(surface.cells == HIDDEN))
    for grasp in grasps(surface):
        deep = hand().holds(se3.apply(se3.inverse(grasp.T_base_tcp), hidden))
        assert (deep > 0.004).sum() <= 0.002 * len(hidden)


@pytest.mark.long
def test_the_hand_of_openarm_v2_holds_a_block():
    best = grasps(surface_of([box((0.04, 0.08, 0.05), yaw=0.5)]), hand("openarm_v2", "right"))[0]
    assert best.apertures[0] <= 0.04 <= best.apertures[1]
    y = np.array([np.cos(0.5), np.sin(0.5), 0.0])
    assert abs(float(best.T_base_tcp[:3, 1] @ y)) > 0.985


def test_a_second_view_is_worth_more_certainty():
    part = [box((0.04, 0.06, 0.09))]
    one = fuse([View(SLANTED, seen(part, SLANTED))], TABLE_Z)
    other = np.array([0.02, -0.38, 0.9])
    two = fuse([View(SLANTED, seen(part, SLANTED)), View(other, seen(part, other))], TABLE_Z)
    sure_one = max(g.parts["certainty"] for g in grasps(one))
    sure_two = max(g.parts["certainty"] for g in grasps(two))
    assert sure_two >= sure_one


@pytest.mark.requirement("R-16")
def test_a_wall_is_held_by_a_hand_that_is_opened_less_where_an_open_one_meets_the_wall_beyond():
    walls = [box((0.012, 0.10, 0.06), x=0.27 + side * 0.030) for side in (-1.0, 1.0)]
    found = [one for one in grasps(surface_of(walls)) if abs(one.T_base_tcp[0, 1]) > 0.9 and one.width < 0.03]
    assert found
    for one in found:
        assert one.opened is not None
        assert one.width + 0.008 <= one.opened < 0.08
        assert one.apertures[0] <= 0.012 <= one.apertures[1] <= one.opened


def test_candidates_lean_in_many_ways_so_that_an_arm_finds_one_that_it_reaches():
    found = grasps(surface_of([box((0.03, 0.09, 0.08))]))
    leans = {(round(2.0 * one.T_base_tcp[0, 2]), round(2.0 * one.T_base_tcp[1, 2])) for one in found}
    assert len(leans) >= 5
