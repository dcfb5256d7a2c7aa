# SPDX-License-Identifier: Apache-2.0
"""The question on an object: what of it is seen, seen through, hidden, on depth images with known answers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.camera.depth_view import DepthView
from openarm_world import Shares, explain, fit, view_of
from tests.openarm_world.made import ABOVE, LENS, clouds, image

BOX = ((0.05, 0.02, 0.03), (0.08, 0.06, 0.06))
#: A thing as large as an arm over half of the box.
ARM = ((0.10, 0.02, 0.3), (0.14, 0.3, 0.05))
STANDS = np.eye(4)


def points_of(boxes: dict[int, object], i: int = 1) -> np.ndarray:
    cloud = clouds(*image(boxes))
    return cloud.points[cloud.labels == i][::4].astype(np.float64)


def shift(x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    return se3.make(None, (x, y, z))


def test_what_stands_is_seen_and_what_was_taken_away_is_seen_through() -> None:
    points = points_of({1: BOX})
    assert explain(points, STANDS, image({1: BOX})[0]) == Shares(1.0, 0.0, 0.0)
    assert explain(points, STANDS, image({})[0]) == Shares(0.0, 1.0, 0.0)


def test_noise_of_a_d435_leaves_what_stands_where_it_is() -> None:
    rng = np.random.default_rng(0)
    points = points_of({1: BOX})
    assert max(explain(points, STANDS, image({1: BOX}, noise=rng)[0]).left for _ in range(20)) < 0.015


@pytest.mark.parametrize("step", [0.01, 0.02, 0.04])
def test_what_was_pushed_is_seen_through_along_one_edge(step: float) -> None:
    """The free share is that of the strip which it has left, but for a pixel (2.5 mm) that its neighbours hide."""
    middle, edges = BOX
    view = image({1: ((middle[0] + step, *middle[1:]), edges)})[0]
    shares = explain(points_of({1: BOX}), STANDS, view)
    assert shares.free == pytest.approx(step / edges[0], abs=0.07)
    assert shares.left > 0.015
    assert explain(points_of({1: BOX}), shift(step), view).left < 0.015


@pytest.mark.parametrize("way", [(0.0, 0.0, 0.0), (0.010, -0.006, 0.0), (0.0, 0.0, 0.012), (0.03, 0.02, 0.0)])
def test_the_motion_that_explains_an_image_best_says_how_far_a_thing_is_from_where_it_should_be(way) -> None:
    middle, edges = BOX
    view = image({1: (tuple(np.add(middle, way)), edges)}, noise=np.random.default_rng(1))[0]
    for turns in (False, True):
        T, shares = fit(points_of({1: BOX}), STANDS, view, turns=turns)
        assert se3.apply(T, np.array(middle)) - middle == pytest.approx(way, abs=0.0055)  # one and a half pixels
        assert shares.left < 0.015


def test_a_turn_is_found_where_one_may_be() -> None:
    """The camera has turned about the vertical through the thing, and is believed where it was."""
    middle = se3.make(p=(BOX[0][0], BOX[0][1], 0.0))
    turn = middle @ se3.make(se3.rot_z(0.2)) @ se3.inverse(middle)
    view = image({1: BOX}, se3.inverse(turn) @ ABOVE)[0]
    seen = DepthView(view.depth, LENS, ABOVE, 0.05, 3.0)
    T, shares = fit(points_of({1: BOX}), STANDS, seen)
    assert T[:2, :2] == pytest.approx(turn[:2, :2], abs=0.04)
    assert shares.left < 0.015 < fit(points_of({1: BOX}), STANDS, seen, turns=False)[1].left


def test_what_is_behind_an_arm_is_hidden_and_not_gone() -> None:
    points = points_of({1: BOX})
    shares = explain(points, STANDS, image({1: BOX, 2: ARM})[0])
    assert 0.1 < shares.hidden < 0.9
    assert shares.left == 0.0
    view = image({2: ARM})[0]  # and taken away behind it
    gone = explain(points, STANDS, view)
    assert shares.hidden <= gone.hidden < shares.hidden + 0.15  # along its edge, and below it
    assert gone.left == 1.0


def test_out_of_the_image_behind_the_camera_and_without_depth_is_hidden() -> None:
    points, view = points_of({1: BOX}), image({1: BOX})[0]
    assert explain(points, shift(3.0), view).hidden == 1.0
    assert explain(points, shift(0.0, 0.0, 2.0), view).hidden == 1.0
    for none in (0.0, np.nan):
        empty = DepthView(np.full_like(view.depth, none), LENS, ABOVE, 0.05, 3.0)
        assert explain(points, STANDS, empty) == Shares(0.0, 0.0, 1.0)
    assert explain(np.zeros((0, 3)), STANDS, view).left == 0.0


def test_millimetres_say_the_same_as_metres() -> None:
    view = image({1: BOX})[0]
    counts = DepthView(np.round(view.depth * 1e3).astype(np.uint16), LENS, ABOVE, 0.05, 3.0)
    assert explain(points_of({1: BOX}), STANDS, counts) == explain(points_of({1: BOX}), STANDS, view)


@settings(deadline=None, max_examples=40)
@given(
    st.tuples(*[st.floats(-0.1, 0.1)] * 2, st.floats(-0.03, 0.1)),
    st.tuples(*[st.floats(-0.15, 0.15)] * 2, st.floats(-0.2, 0.2)),
)
def test_a_moved_camera_sees_a_thing_that_moves_with_it_alike(way, aside) -> None:
    """What counts is where the points are in the camera: base frame and camera may move together."""
    T = se3.make(se3.rot_z(way[2] * 10.0), way)
    points, view = points_of({1: BOX}), image({1: ((BOX[0][0] + aside[0], BOX[0][1] + aside[1], 0.03), BOX[1])})[0]
    moved = DepthView(view.depth, LENS, T @ ABOVE, 0.05, 3.0)
    first, second = explain(points, STANDS, view), explain(points, T, moved)
    assert first.seen + first.free + first.hidden == pytest.approx(1.0)
    assert (second.seen, second.free) == pytest.approx((first.seen, first.free), abs=0.02)  # rounding to pixels


@pytest.mark.parametrize(("depth", "within"), [(0.5, 0.003), (1.0, 0.006), (2.0, 0.024)])
def test_a_point_is_seen_within_the_noise_at_its_depth(depth: float, within: float) -> None:
    """Three millimetres, and from 0.7 m on with the square of the depth."""
    view = DepthView(np.full((LENS.height, LENS.width), depth, np.float32), LENS, np.eye(4), 0.05, 3.0)
    for off, expected in ((0.9, Shares(1.0, 0.0, 0.0)), (1.2, Shares(0.0, 1.0, 0.0)), (-1.2, Shares(0.0, 0.0, 1.0))):
        assert explain(np.array([[0.0, 0.0, depth - off * within]]), STANDS, view) == expected


def test_what_is_next_to_something_nearer_is_hidden_and_not_seen_through() -> None:
    depth = np.full((LENS.height, LENS.width), 1.0, np.float32)
    depth[120, 160] = 0.3
    view = DepthView(depth, LENS, np.eye(4), 0.05, 3.0)
    for u, expected in ((160, 1.0), (161, 1.0), (162, 0.0)):
        point = LENS.deproject((u, 120), 0.5)
        assert explain(point[None], STANDS, view).hidden == expected


def test_a_cloud_makes_the_image_that_it_was_seen_in():
    x, y = np.meshgrid(np.arange(0.0, 0.6, 0.003), np.arange(-0.3, 0.3, 0.003))
    ground = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.4)])
    on = (np.abs(ground[:, :2] - (0.3, 0.0)) < 0.03).all(axis=1)
    camera, top = np.array([0.1, 0.1, 1.2]), ground[on] + (0.0, 0.0, 0.05)
    for points, expected in (
        (np.concatenate([ground, top]), (1.0, 0.0, 0.0)),
        (ground, (0.0, 1.0, 0.0)),
        (camera + 0.5 * (top - camera), (0.0, 0.0, 1.0)),  # something nearer hides it
        (np.empty((0, 3)), (0.0, 0.0, 1.0)),
        (2.0 * camera - ground, (0.0, 0.0, 1.0)),  # the camera looks away
    ):
        shares = explain(top, np.eye(4), view_of(points, camera))
        assert (shares.seen, shares.free, shares.hidden) == pytest.approx(expected, abs=0.02)
