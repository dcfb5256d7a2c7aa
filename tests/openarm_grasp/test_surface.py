# SPDX-License-Identifier: Apache-2.0
"""The fused surface: what is seen, filled, in shadow and free, and its normals."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.sampling.surface import View, fuse
from openarm_grasp.sampling.voxel_kernels import FILLED, FREE, HIDDEN, OTHER, SEEN, SHADOW
from tests.openarm_grasp.clouds import ABOVE, SLANTED, TABLE_Z, box, seen, surface_of


def cell(surface, *p):
    return int(surface.cells[tuple(np.floor(surface.voxel(np.array([p]))[0]).astype(int))])


def test_below_what_is_seen_is_full_and_next_to_it_is_free():
    surface = surface_of([box((0.05, 0.05, 0.061))])
    assert cell(surface, 0.27, -0.2, TABLE_Z + 0.0605) == SEEN
    assert cell(surface, 0.27, -0.2, TABLE_Z + 0.03) == FILLED
    assert cell(surface, 0.27 + 0.05, -0.2, TABLE_Z + 0.03) == FREE
    assert surface.top == pytest.approx(TABLE_Z + 0.061, abs=0.0026)
    assert surface.centroid == pytest.approx([0.27, -0.2, TABLE_Z + 0.03], abs=0.002)


def test_a_slanted_view_leaves_a_shadow_behind_the_object_and_none_before_it():
    surface = surface_of([box((0.05, 0.05, 0.08))], SLANTED)
    away = np.array([0.27, -0.2]) - SLANTED[:2]
    away /= np.linalg.norm(away)
    behind, before = np.array([0.27, -0.2]) + 0.045 * away, np.array([0.27, -0.2]) - 0.045 * away
    assert cell(surface, *behind, TABLE_Z + 0.01) == SHADOW
    assert cell(surface, *before, TABLE_Z + 0.01) == FREE


def test_the_shadow_of_something_else_is_hidden_and_its_own_cells_are_others():
    surface = surface_of([box((0.04, 0.04, 0.04))], SLANTED, [box((0.04, 0.04, 0.12), x=0.34, y=-0.15)])
    assert cell(surface, 0.34, -0.15, TABLE_Z + 0.06) == OTHER
    assert (surface.cells == HIDDEN).any()


def test_a_second_view_frees_the_shadow_that_it_looks_into():
    parts = [box((0.05, 0.05, 0.08))]
    other_side = np.array([0.0, -0.45, 0.9])
    one = fuse([View(SLANTED, seen(parts, SLANTED))], TABLE_Z)
    both = fuse([View(SLANTED, seen(parts, SLANTED)), View(other_side, seen(parts, other_side))], TABLE_Z)
    assert (one.cells == SHADOW).sum() > 1000
    assert (both.cells == SHADOW).sum() < 0.1 * (one.cells == SHADOW).sum()
    assert both.views == 2


def test_of_a_view_that_is_not_whole_only_its_rays_free_anything():
    parts, near = [box((0.05, 0.05, 0.08))], np.array([0.0, -0.45, 0.9])
    first = View(SLANTED, seen(parts, SLANTED))
    alone, blind = fuse([first], TABLE_Z), fuse([first, View(near, seen(parts, near), whole=False)], TABLE_Z)
    hidden = alone.middles(np.argwhere(alone.cells == SHADOW))
    # the table below the shadow, as the second camera sees it: each point more than once
    table = np.repeat(hidden[hidden[:, 2] < TABLE_Z + 0.003], 4, axis=0)
    looking = fuse([first, View(near, seen(parts, near), table=table, whole=False)], TABLE_Z)
    shadows = [int((surface.cells == SHADOW).sum()) for surface in (alone, blind, looking)]
    assert shadows[1] > 0.5 * shadows[0]
    assert shadows[2] < 0.7 * shadows[1]


def test_a_view_from_the_side_frees_what_lies_below_an_overhang():
    parts = [box((0.10, 0.04, 0.02)) + np.array([0.0, 0.0, 0.05]), box((0.02, 0.04, 0.06))]
    under = (0.27 + 0.035, -0.2, TABLE_Z + 0.012)
    assert cell(surface_of(parts), *under) == FILLED
    side = np.array([0.60, -0.2, 0.55])
    both = fuse([View(ABOVE, seen(parts)), View(side, seen(parts, side, 0.001))], TABLE_Z)
    assert cell(both, *under) == FREE


def test_normals_of_a_wall_point_out_of_it():
    surface = surface_of([box((0.05, 0.08, 0.06))])
    index = np.floor(surface.voxel(np.array([[0.27 + 0.0249, -0.2, TABLE_Z + 0.03]]))[0]).astype(int)
    assert surface.normals[tuple(index)] == pytest.approx([1.0, 0.0, 0.0], abs=0.1)


def test_an_organised_cloud_with_holes_is_as_good_as_its_points():
    points = seen([box((0.05, 0.05, 0.06))])
    points = points[: len(points) // 10 * 10]
    organised = points.reshape(-1, 10, 3).copy()
    organised[::97, 3] = np.nan
    kept = organised[np.isfinite(organised).all(axis=-1)]
    one, other = fuse([View(ABOVE, organised)], TABLE_Z), fuse([View(ABOVE, kept)], TABLE_Z)
    assert np.array_equal(one.cells, other.cells)


@pytest.mark.parametrize(
    ("view", "table_z", "code", "words"),
    [
        (View(ABOVE, np.zeros((5, 3))), TABLE_Z, Code.NOTHING_DETECTED, "expected at least 20"),
        (View(ABOVE, np.zeros((5, 2))), TABLE_Z, Code.INVALID_ARGUMENT, r"shape \(5, 2\)"),
        (View(np.array([np.nan, 0, 1]), np.zeros((5, 3))), TABLE_Z, Code.INVALID_ARGUMENT, "finite coordinates"),
        (View(ABOVE, np.zeros((5, 3))), np.inf, Code.INVALID_ARGUMENT, "finite height"),
        (
            View(ABOVE, np.array([0.2, 0.2, 0.5]) + np.eye(3)[np.arange(30) % 3]),
            TABLE_Z,
            Code.INVALID_ARGUMENT,
            "0.8 m",
        ),
    ],
)
def test_what_is_no_view_of_an_object_is_refused_in_a_sentence(view, table_z, code, words):
    with pytest.raises(OpenArmError, match=words) as refused:
        fuse([view], table_z)
    assert refused.value.code is code


def test_no_view_is_refused():
    with pytest.raises(OpenArmError, match="no view"):
        fuse([], TABLE_Z)
