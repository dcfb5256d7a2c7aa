# SPDX-License-Identifier: Apache-2.0
"""Filters of depth images and clouds."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import OpenArmError
from openarm_perception.geometry.depth import Deprojector, DepthLimits
from openarm_perception.geometry.filters import (
    CloudFilter,
    FilterConfig,
    drop_flying,
    median_depth,
    statistical_inliers,
    voxel_filter,
)

K = Intrinsics.from_fovy(160, 120, 60.0)


def step(flying: bool = True) -> np.ndarray:
    """A box at 0.6 m before a wall at 1 m, and a row of pixels between them as a sensor mixes them."""
    depth = np.full((120, 160), 1000, np.uint16)
    depth[40:80, 50:110] = 600
    if flying:
        depth[40:80, 110] = 800
    return depth


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.01, 0.02, 0.05]))
@pytest.mark.requirement("A-50")
def test_one_point_a_cell_on_an_absolute_lattice(seed: int, edge: float) -> None:
    """Every occupied cell has one point, in the cell, at the mean of what was there."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.3, 0.3, (rng.integers(1, 2000), 3)).astype(np.float32)
    out = voxel_filter(points, edge)
    key = lambda p: [tuple(k) for k in np.floor(p.astype(np.float64) / edge + 1e-9).astype(int)]  # noqa: E731
    groups: dict[tuple[int, ...], list[np.ndarray]] = {}
    for k, p in zip(
        [tuple(k) for k in np.floor(points.astype(np.float64) * (1 / edge)).astype(int)], points, strict=True
    ):
        groups.setdefault(k, []).append(p)
    assert len(out) == len(groups)
    np.testing.assert_allclose(out, [np.mean(g, axis=0) for g in groups.values()], atol=1e-6)
    assert len(set(key(out))) >= 0.99 * len(out)
    # points elsewhere do not move the cells
    more = np.concatenate([points, rng.uniform(1.0, 1.2, (50, 3)).astype(np.float32)])
    np.testing.assert_array_equal(voxel_filter(more, edge)[: len(out)], out)


def test_what_is_not_finite_or_far_too_far_is_dropped() -> None:
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e9, 0, 0], [0.1, 0.1, 0.1]], np.float32)
    np.testing.assert_allclose(voxel_filter(points, 0.01), [[0.1, 0.1, 0.1]])
    assert voxel_filter(np.empty((0, 3), np.float32), 0.01).shape == (0, 3)


@pytest.mark.parametrize("metres", [False, True])
@pytest.mark.requirement("A-51", "A-52")
def test_flying_pixels_go_and_surfaces_stay(metres: bool) -> None:
    """Edges included: the box keeps its outline, the mixed pixels and lonely ones are gone."""
    depth = step()
    depth[10, 10] = 300
    if metres:
        depth = (depth * 1e-3).astype(np.float32)
        depth[100:, :10] = np.nan
    out = drop_flying(depth, 0.03)
    kept = np.nan_to_num(out) > 0
    assert not kept[41:79, 110].any()
    assert not kept[10, 10]
    assert kept[41:79, 51:109].all()
    assert kept[:39].sum() == 39 * 160 - 1
    np.testing.assert_array_equal(out[kept], depth[kept])


@pytest.mark.requirement("A-51")
def test_the_median_takes_noise_and_keeps_holes_and_edges() -> None:
    rng = np.random.default_rng(0)
    clean = step(flying=False)
    noisy = (clean + rng.normal(0, 5, clean.shape)).astype(np.uint16)
    noisy[60, 80] = noisy[20:24, 20:24] = 0
    out = median_depth(noisy, 5)
    inner = np.s_[45:75, 55:105]
    assert np.std(out[inner][out[inner] > 0].astype(float) - 600) < 2.5
    assert out[60, 80] == 0
    assert (out[20:24, 20:24] == 0).all()
    assert np.abs(out[62, 81].astype(float) - 600) < 25  # next to a hole: not pulled towards zero
    metres = (noisy * 1e-3).astype(np.float32)
    metres[metres == 0] = np.nan
    np.testing.assert_array_equal(np.isnan(median_depth(metres, 3)), np.isnan(metres))
    with pytest.raises(OpenArmError, match="BAD_IMAGE"):
        median_depth(np.zeros((4, 4), np.uint8), 3)  # type: ignore[arg-type]


@pytest.mark.requirement("A-51")
def test_outliers_are_those_far_from_their_twenty_nearest() -> None:
    """A plane with points above it, which go; hardly any of the plane goes with them."""
    rng = np.random.default_rng(1)
    plane = np.column_stack([rng.uniform(0, 0.3, (3000, 2)), rng.normal(0, 0.001, 3000)])
    stray = np.column_stack([rng.uniform(0, 0.3, (40, 2)), rng.uniform(0.1, 0.3, 40)])
    points = np.concatenate([plane, stray]).astype(np.float32)
    kept = statistical_inliers(points, 20, 2.0)
    assert not kept[3000:].any()
    assert kept[:3000].mean() > 0.99
    for few in (0, 1, 2):
        assert statistical_inliers(points[:few]).all()
    assert statistical_inliers(np.zeros((50, 3), np.float32)).all()


def test_the_rule_is_that_of_open3d() -> None:
    """Written out: nearest ones include the point itself; needs no open3d."""
    rng = np.random.default_rng(2)
    points = rng.normal(size=(200, 3)).astype(np.float32)
    d = np.sort(np.linalg.norm(points[:, None].astype(np.float64) - points[None], axis=-1), axis=1)[:, :10]
    mean = d.mean(axis=1)
    np.testing.assert_array_equal(statistical_inliers(points, 10, 1.0), mean < mean.mean() + mean.std(ddof=1))


@pytest.mark.skipif(importlib.util.find_spec("open3d") is None, reason="the extra `cloud` (open3d) is not installed")
def test_open3d_agrees() -> None:
    """Named command, where open3d is installed: `pytest tests/openarm_perception/test_filters.py -k open3d`."""
    points = np.random.default_rng(3).normal(size=(2000, 3)).astype(np.float32)
    ours, theirs = (FilterConfig(outliers=True, outliers_by=by) for by in ("scipy", "open3d"))
    kept, expected = CloudFilter(ours).points(points), CloudFilter(theirs).points(points)
    assert 1500 < len(kept) < 2000
    assert abs(len(kept) - len(expected)) <= 1
    assert len(np.intersect1d(kept[:, 0], expected[:, 0])) >= len(kept) - 1


@pytest.mark.skipif(importlib.util.find_spec("open3d") is not None, reason="open3d is installed")
def test_open3d_that_is_asked_for_and_missing_is_named() -> None:
    with pytest.raises(OpenArmError, match=r"filter.outliers_by is open3d.*openarm-vision\[cloud\]"):
        CloudFilter(FilterConfig(outliers=True, outliers_by="open3d"))


def test_all_filters_together() -> None:
    config = FilterConfig(median=3, flying=0.03, voxel=0.01, outliers=True)
    cloud_filter = CloudFilter(config)
    deproject = Deprojector(DepthLimits(near=0.2, far=3.0))
    points = cloud_filter.points(deproject.valid_points(cloud_filter.depth(step()), K))
    assert 2000 < len(points) < 160 * 120
    assert not ((points[:, 2] > 0.65) & (points[:, 2] < 0.95)).any()
    with pytest.raises(ValueError, match="should be 0, 3 or 5"):
        FilterConfig(median=4)
