# SPDX-License-Identifier: Apache-2.0
"""Things on a table segmented by depth: what is found, what is said of outlines and shapes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code
from openarm_perception.geometry.depth import Deprojector, DepthLimits
from openarm_perception.segmentation.clusters import Segmentation, segment
from openarm_perception.segmentation.colors import join_smooth
from openarm_perception.segmentation.divide import SegmentationConfig
from openarm_perception.segmentation.grouping import group
from openarm_perception.segmentation.parts import joined
from openarm_perception.segmentation.support import find_support
from openarm_perception.segmentation.views import merge_views
from openarm_sim_bridge.cameras.noise import DepthNoiseConfig, add_depth_noise
from tests.refusals import refused

pytestmark = pytest.mark.requirement("R-19")

LIMITS = DepthLimits(near=0.1, far=3.0)


def seen(view, noise: DepthNoiseConfig | None = None, seed: int = 0):
    """Organised points of a view, noisy where asked for."""
    depth = view.depth.copy()
    if noise is not None:
        depth = add_depth_noise(depth, view.intrinsics.fy, noise, np.random.default_rng(seed))
    return Deprojector(LIMITS).organised(depth.astype(np.float32), view.intrinsics)


def at(result: Segmentation, x: float, y: float):
    """The cluster whose box is nearest to a place on the table."""
    return min(result.clusters, key=lambda one: np.hypot(*(one.T_frame_box[:2, 3] - (x, y))))


def test_boxes_and_cans_are_measured(tabletop):
    things = [
        tabletop.Thing("red", "box", (0.05, 0.07, 0.06), 0.2, 0.15, 0.4),
        tabletop.Thing("blue", "cylinder", (0.06, 0.06, 0.08), 0.35, -0.15),
        tabletop.Thing("green", "box", (0.04, 0.04, 0.04), 0.3, 0.0, 1.0),
    ]
    view = tabletop.render(things)
    points = seen(view, DepthNoiseConfig(enabled=True))
    result = segment(points, view.intrinsics, rgb=view.rgb, T_base_camera=view.T_base_camera)
    assert len(result.clusters) == 3
    assert result.label.dtype == np.uint16
    for thing in things:
        one = at(result, thing.x, thing.y)
        assert one.shape.kind == ("box" if thing.kind == "box" else "cylinder"), one.shape.why
        assert one.size == pytest.approx([*sorted(thing.size[:2]), thing.size[2]], abs=0.004)
        assert one.T_frame_box[:3, 3] == pytest.approx(thing.position, abs=0.003)
        assert one.outline.free > 0.97
        assert one.outline.cut == ""
        assert np.count_nonzero(one.mask) == one.pixels == np.count_nonzero(result.label == one.id)
        # its points lie on it, in the base frame
        assert one.points[:, 2].max() == pytest.approx(0.40 + thing.size[2], abs=0.02)


@pytest.mark.parametrize("seed", range(2))
def test_noise_on_the_table_behind_a_tall_thing_is_no_part_of_it(tabletop, seed):
    """Next to its far edge the image shows table, here 10 cm and more behind it."""
    can = tabletop.Thing("blue", "cylinder", (0.07, 0.07, 0.16), 0.3, 0.25)
    view = tabletop.render([can])
    points = seen(view, DepthNoiseConfig(enabled=True), seed)
    result = segment(points, view.intrinsics, rgb=view.rgb, T_base_camera=view.T_base_camera)
    (one,) = result.clusters
    raw = se3.apply(view.T_base_camera, points[result.label == one.id].astype(np.float64))
    assert np.linalg.norm(raw[:, :2] - can.position[:2], axis=1).max() < 0.035 + 0.010


def test_without_a_pose_the_table_may_be_slanted(tabletop):
    thing = tabletop.Thing("red", "box", (0.05, 0.07, 0.06), 0.3, 0.0, 0.4)
    camera = tabletop.look_at((0.9, 0.2, 0.8), (0.27, 0.0, 0.42), (0.0, 1.0, 0.0))
    view = tabletop.render([thing], camera)
    result = segment(seen(view), view.intrinsics)
    assert len(result.clusters) == 1
    one = result.clusters[0]
    assert sorted(one.size) == pytest.approx(sorted(thing.size), abs=0.004)
    # the pose of the box is that in the base frame, seen from the camera
    T = view.T_base_camera @ one.T_frame_box
    assert T[:3, 3] == pytest.approx(thing.position, abs=0.003)
    assert T[:3, 2] == pytest.approx((0.0, 0.0, 1.0), abs=0.01)


def test_what_is_no_prism_says_so_and_keeps_its_cloud(tabletop):
    lying = tabletop.Thing("red", "cylinder", (0.06, 0.06, 0.12), 0.3, 0.0, 0.5, lying=True)
    view = tabletop.render([lying])
    result = segment(seen(view), view.intrinsics, T_base_camera=view.T_base_camera)
    assert len(result.clusters) == 1
    one = result.clusters[0]
    assert one.shape.kind == "unknown"
    assert one.shape.why != ""
    assert "hid" not in one.shape.why
    assert one.outline.cut == ""
    assert one.size[:2] == pytest.approx((0.06, 0.12), abs=0.006)
    assert one.pixels > 1000


def test_a_box_on_a_wider_foot_is_no_prism(tabletop):
    """Its top is a rectangle, and all that is seen lies within 4 mm of the sides below that."""
    top = tabletop.Thing("red", "box", (0.050, 0.070, 0.055), 0.3, 0.1, 0.4)
    foot = tabletop.Thing("red", "box", (0.058, 0.078, 0.030), 0.3, 0.1, 0.4)
    view = tabletop.render([top, foot])
    points = seen(view, DepthNoiseConfig(enabled=True))
    (one,) = segment(points, view.intrinsics, rgb=view.rgb, T_base_camera=view.T_base_camera).clusters
    assert "out of the prism below its top" in one.shape.why
    assert one.size[:2] == pytest.approx(foot.size[:2], abs=0.006)


def test_what_is_in_front_hides_and_the_border_cuts(tabletop):
    behind = tabletop.Thing("red", "box", (0.05, 0.16, 0.05), 0.22, 0.0)
    front = tabletop.Thing("blue", "box", (0.03, 0.05, 0.12), 0.34, 0.0)
    camera = tabletop.look_at((0.95, 0.0, 0.75), (0.30, 0.0, 0.42), (0.0, 1.0, 0.0))
    view = tabletop.render([behind, front], camera)
    result = segment(seen(view), view.intrinsics, T_base_camera=camera)
    hidden = at(result, behind.x, behind.y)
    assert hidden.outline.hidden > 0.05
    assert "something nearer" in hidden.outline.cut
    assert at(result, front.x, front.y).outline.hidden < 0.02
    points = seen(view)
    u = int(np.nonzero(result.label == at(result, front.x, front.y).id)[1].mean())
    cut = segment(points[:, :u].copy(), _narrow(view.intrinsics, u), T_base_camera=camera)
    assert any(one.outline.border > 0.1 for one in cut.clusters)


def _narrow(lens, width: int):
    return type(lens)(width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)


def test_boxes_that_touch_are_apart_where_they_meet_in_a_notch(tabletop):
    low = tabletop.Thing("grey", "box", (0.08, 0.08, 0.03), 0.3, 0.0)
    tall = tabletop.Thing("grey", "box", (0.04, 0.04, 0.09), 0.362, 0.0)
    view = tabletop.render([low, tall], tabletop.look_at((0.1, 0.5, 0.9), (0.3, 0.0, 0.42), (1.0, 0.0, 0.0)))
    noise = DepthNoiseConfig(enabled=True)
    for seed in range(3):
        result = segment(seen(view, noise, seed), view.intrinsics, rgb=view.rgb, T_base_camera=view.T_base_camera)
        assert len(result.clusters) == 2, seed


def test_parts_of_one_plain_colour_are_one_thing(tabletop):
    handle = tabletop.Thing("red", "box", (0.15, 0.03, 0.025), 0.3, 0.0)
    head = tabletop.Thing("red", "box", (0.04, 0.10, 0.05), 0.395, 0.0)
    view = tabletop.render([handle, head])
    points = seen(view)
    assert len(segment(points, view.intrinsics, rgb=view.rgb, T_base_camera=view.T_base_camera).clusters) == 1
    assert len(segment(points, view.intrinsics, T_base_camera=view.T_base_camera).clusters) == 2


def test_the_robot_is_no_thing(tabletop):
    thing = tabletop.Thing("red", "box", (0.05, 0.07, 0.06), 0.3, 0.0)
    view = tabletop.render([thing])
    points = seen(view)
    robot = segment(points, view.intrinsics, T_base_camera=view.T_base_camera).label > 0
    result = segment(points, view.intrinsics, T_base_camera=view.T_base_camera, robot=robot)
    assert result.clusters == ()
    assert not result.label.any()


def test_a_background_takes_away_what_was_there_before(tabletop):
    tray = tabletop.Thing("grey", "box", (0.2, 0.3, 0.04), 0.3, 0.0)
    thing = tabletop.Thing("red", "box", (0.05, 0.07, 0.02), 0.3, 0.0)
    on_it = tabletop.Thing("red", "box", (0.05, 0.07, 0.09), 0.3, 0.0)
    noise = DepthNoiseConfig(enabled=True)
    empty, full = tabletop.render([tray]), tabletop.render([tray, on_it])
    background, points = seen(empty, noise), seen(full, noise, 1)
    found = segment(points, full.intrinsics, T_base_camera=full.T_base_camera, background=background)
    assert len(found.clusters) == 1
    assert found.clusters[0].size[:2] == pytest.approx(thing.size[:2], abs=0.008)
    refused("same camera in the same place", segment, points, full.intrinsics, background=background[:-1])
    refused("has it moved", segment, points, full.intrinsics, background=background + np.float32(0.5))


def test_without_a_plane_nothing_is_found():
    points = np.full((60, 80, 3), np.nan, np.float32)
    assert refused(None, find_support, points).code is Code.NOTHING_DETECTED
    points[:] = np.random.default_rng(0).uniform(0.5, 1.5, points.shape)
    refused("no plane", find_support, points)


def test_noise_is_measured_at_the_plane(tabletop):
    view = tabletop.render([])
    noise = DepthNoiseConfig(enabled=True)
    sigma = noise.subpixel / (noise.baseline * view.intrinsics.fy)
    assert find_support(seen(view, noise)).noise == pytest.approx(sigma, rel=0.25)


def test_views_of_one_table_are_merged(tabletop):
    things = [
        tabletop.Thing("red", "box", (0.05, 0.07, 0.06), 0.22, 0.12, 0.4),
        tabletop.Thing("blue", "cylinder", (0.06, 0.06, 0.08), 0.35, -0.12),
    ]
    cameras = [
        tabletop.look_at((0.55, 0.0, 1.10), (0.27, 0.0, 0.42), (0.0, 1.0, 0.0)),
        tabletop.look_at((-0.2, 0.4, 0.9), (0.27, 0.0, 0.42), (1.0, 0.0, 0.0)),
    ]
    views = [tabletop.render(things, camera) for camera in cameras]
    results = [segment(seen(v), v.intrinsics, T_base_camera=v.T_base_camera) for v in views]
    merged = merge_views([result.clusters for result in results])
    assert sorted(len(thing.seen) for thing in merged) == [2, 2]
    assert {seen for thing in merged for seen in thing.seen} == {(0, 1), (0, 2), (1, 1), (1, 2)}
    assert len(merge_views([results[0].clusters, ()])) == 2
    # another table, half a metre beside: nothing overlaps
    beside = [type(one)(**{**vars(one), "points": one.points + np.float32(0.5)}) for one in results[1].clusters]
    assert len(merge_views([results[0].clusters, beside])) == 4


def test_a_gap_in_a_notch_joins_nothing():
    """Two rows of patches, each joined by sure votes, with one doubtful link among many that are against."""
    pairs, weight = [], []
    for row in (0, 10):
        for i in range(1, 10):
            pairs.append((row + i, row + i + 1) if i < 9 else (row + 1, row + 3))
            weight.append(9.0)
    for i in range(1, 10):
        pairs.append((i, 10 + i))
        weight.append(4.0 if i == 5 else -8.0)
    root = group(21, np.array(pairs, np.int32), np.array(weight), np.full(len(pairs), 10.0))
    assert len(set(root[1:10])) == len(set(root[11:20])) == 1
    assert root[1] != root[11]


def test_the_same_image_gives_the_same_clusters(tabletop):
    view = tabletop.render([tabletop.Thing("red", "box", (0.05, 0.07, 0.06), 0.3, 0.0, 0.3)])
    points = seen(view, DepthNoiseConfig(enabled=True))
    a, b = (segment(points.copy(), view.intrinsics, T_base_camera=view.T_base_camera) for _ in range(2))
    assert np.array_equal(a.label, b.label)
    assert all(np.array_equal(x.T_frame_box, y.T_frame_box) for x, y in zip(a.clusters, b.clusters, strict=True))
    assert se3.is_pose(a.clusters[0].T_frame_box)


def test_parts_that_touch_are_one_thing_for_a_hand_and_boxes_apart_are_two(tabletop):
    handle = tabletop.Thing("red", "cylinder", (0.03, 0.03, 0.14), 0.25, 0.0, 0.0, lying=True)
    head = tabletop.Thing("blue", "box", (0.05, 0.05, 0.06), 0.345, 0.0, 0.0)
    alone = tabletop.Thing("green", "box", (0.05, 0.05, 0.06), 0.25, 0.18, 0.0)
    view = tabletop.render([handle, head, alone])
    points = seen(view, DepthNoiseConfig(enabled=True))
    found = [
        segment(
            points,
            view.intrinsics,
            SegmentationConfig(join_parts=joined),
            rgb=view.rgb,
            T_base_camera=view.T_base_camera,
        )
        for joined in (False, True)
    ]
    apart, joined = (sorted(one.pixels for one in result.clusters) for result in found)
    assert len(apart) == 3
    assert len(joined) == 2
    assert at(found[1], 0.25, 0.18).shape.kind == "box"
    assert joined[1] > apart[2]


#: An image in which no piece is next to another.
APART = np.zeros((1, 1), np.uint16)


def piece(n: float, half: float = 0.018):
    """A square piece that touches those of the next numbers."""
    edge = np.arange(-half, half + 1e-9, 0.004)
    grid = np.stack(np.meshgrid(edge, edge, [0.0]), axis=-1).reshape(-1, 3)
    return SimpleNamespace(points=grid + np.array([0.04 * n, 0.0, 0.4]), shape=SimpleNamespace(kind="unknown"))


def test_more_pieces_than_a_thing_has_parts_are_a_heap_and_stay_pieces():
    assert list(joined([piece(n) for n in range(3)], APART)) == [0, 0, 0]
    assert list(joined([piece(n) for n in range(4)], APART)) == [0, 1, 2, 3]
    assert list(joined([*(piece(n) for n in range(4)), piece(8), piece(9)], APART)) == [0, 1, 2, 3, 4, 4]
    assert list(joined([piece(n) for n in range(3)], APART, (1, 2, 1))) == [0, 1, 2]  # one of them was two


def test_pieces_with_a_gap_that_one_of_them_may_hide_are_one_thing():
    """They are next to each other in the image, since the nearer is higher."""
    label = np.zeros((20, 20), np.uint16)
    label[5:15, 2:9], label[5:15, 10:18] = 1, 2
    higher = piece(0.0)
    higher.points = higher.points + np.array([0.0, 0.0, 0.04])
    hidden, apart = piece(1.3), piece(1.6)
    assert list(joined([higher, hidden], label)) == [0, 0]
    assert list(joined([higher, hidden], APART)) == [0, 1]
    assert list(joined([higher, apart], label)) == [0, 1]
    both = [SimpleNamespace(points=one.points, shape=SimpleNamespace(kind="box")) for one in (higher, hidden)]
    assert list(joined(both, label)) == [0, 1]


def test_things_of_which_one_hides_all_that_is_between_them_are_two(tabletop):
    """A can in front of a box, 5 cm apart: pixels at its edge are no points between them."""
    can = tabletop.Thing("green", "cylinder", (0.066, 0.066, 0.115), 0.341, -0.348)
    box = tabletop.Thing("blue", "box", (0.066, 0.062, 0.098), 0.233, -0.417, 0.36)
    view = tabletop.render([can, box])
    points = seen(view, DepthNoiseConfig(enabled=True))
    config = SegmentationConfig(join_parts=True)
    result = segment(points, view.intrinsics, config, rgb=view.rgb, T_base_camera=view.T_base_camera)
    assert len(result.clusters) == 2
    away = np.linalg.norm(at(result, can.x, can.y).points[:, :2] - (can.x, can.y), axis=1)
    assert away.max() < 0.033 + 0.010


def test_two_bodies_are_two_things_though_they_touch():
    body, other, handle = piece(0.0, half=0.06), piece(3.05, half=0.06), piece(-1.97)
    assert list(joined([body, handle], APART)) == [0, 0]
    assert list(joined([body, other], APART)) == [0, 1]
    assert list(joined([body, other, handle], APART)) == [0, 1, 0]


@pytest.mark.parametrize(
    ("step", "broken", "things"), [(0, 0, 1), (10, 0, 1), (60, 0, 2), (0, 4, 2)], ids=["alike", "shade", "edge", "deep"]
)
def test_patches_without_an_edge_between_them_are_one_thing_whatever_their_colour(step, broken, things):
    patch = np.zeros((24, 24), np.int32)
    patch[2:22, 2:12], patch[2:22, 12:22] = 1, 2
    rgb = np.zeros((24, 24, 3), np.uint8)
    rgb[::4], rgb[1::4], rgb[2::4], rgb[3::4] = 20, 60, 120, 180  # stripes across both
    rgb[:, 12:] += np.uint8(step)
    border = np.tile(np.array([[1, 2, broken]], np.int32), (20, 1))
    root = join_smooth(np.arange(3, dtype=np.int32), patch, border, rgb)
    assert len({int(root[1]), int(root[2])}) == things
