# SPDX-License-Identifier: Apache-2.0
"""Depth of a stereo pair: rectification, matching, pairs by stamp."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.lens import Lens
from openarm_perception.geometry.depth import DepthLimits
from openarm_perception.stereo.matching import StereoConfig, StereoMatcher
from openarm_perception.stereo.pairs import PairMatcher
from openarm_perception.stereo.rectification import Rectification, Rectified
from tests.refusals import refused

LENS = Intrinsics.from_fovy(320, 240, 52.0)
BASELINE = 0.063
LIMITS = DepthLimits(near=0.25, far=3.0)
SIDE_BY_SIDE = se3.make(None, (BASELINE, 0.0, 0.0))


def matcher(rectification: Rectification | None = None, **config: object) -> StereoMatcher:
    rectification = rectification or Rectification.from_pose(Lens(LENS), Lens(LENS), SIDE_BY_SIDE)
    return StereoMatcher(StereoConfig(**config), rectification, LIMITS)


def texture(seed: int = 0, size: int = 700) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.normal(0.0, 40.0, (size // 5, size // 5)), (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(128.0 + coarse + rng.normal(0.0, 8.0, (size, size)), 0, 255).astype(np.uint8)


def seen(
    T_camera: np.ndarray, n: np.ndarray, d: float, lens: Lens, pattern: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The image (h, w, 3) that a camera takes of a textured plane n·p = d, and its depth (h, w), by ray casting."""
    k = lens.intrinsics
    u, v = np.meshgrid(np.arange(k.width, dtype=np.float64), np.arange(k.height, dtype=np.float64))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPointsIter(pixels, k.matrix, lens.d, None, None, (3, 100, 1e-12))
    rays = rays.reshape(k.height, k.width, 2)
    rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)
    R, p = T_camera[:3, :3], T_camera[:3, 3]
    z = (d - n @ p) / (rays @ R.T @ n)
    points = (rays * z[..., None]) @ R.T + p
    at = (points[..., :2] * 250.0 + 350.0).astype(np.float32)
    grey = cv2.remap(pattern, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return np.repeat(grey[..., None], 3, axis=2), z


NORMAL = np.array([0.15, -0.3, 1.0]) / np.linalg.norm([0.15, -0.3, 1.0])


@given(st.floats(0.35, 1.2), st.floats(-0.4, 0.4), st.floats(-0.4, 0.4))
@settings(max_examples=3)
def test_depth_of_a_textured_plane_is_within_half_a_pixel(distance: float, a: float, b: float) -> None:
    """Nearly everywhere that both cameras see, at any slope."""
    n = np.array([a, b, 1.0]) / np.linalg.norm([a, b, 1.0])
    left, true = seen(np.eye(4), n, distance, Lens(LENS), texture())
    right, _ = seen(SIDE_BY_SIDE, n, distance, Lens(LENS), texture())
    z = matcher().depth(left, right)
    valid = np.isfinite(z) & (true > LIMITS.near) & (true < LIMITS.far)
    error = LENS.fx * BASELINE * (1.0 / z - 1.0 / true)[valid]  # pixels of disparity
    sees_both = true * (np.arange(320) - LENS.cx) / LENS.fx > SIDE_BY_SIDE[0, 3] - true * LENS.cx / LENS.fx
    assert valid.sum() > 0.9 * np.count_nonzero(sees_both)
    assert np.percentile(np.abs(error), 95) < 0.45
    assert abs(np.median(error)) < 0.25  # at integer disparities the sub-pixel part is drawn to one side


def test_cameras_with_distortion_that_are_turned_against_each_other() -> None:
    """Depth is that of the rectified left camera, whose rotation `R` of the rectification is."""
    D = np.array([-0.12, 0.05, 0.001, -0.001, 0.0])
    longer = replace(LENS, fx=LENS.fx + 3.0, fy=LENS.fy + 3.0)
    left_lens, right_lens = Lens(longer, "plumb_bob", tuple(D)), Lens(LENS, "plumb_bob", tuple(0.8 * D))
    T = SIDE_BY_SIDE @ se3.make(se3.exp_so3(np.array([0.01, -0.02, 0.015])))
    rectification = Rectification.from_pose(left_lens, right_lens, T)
    assert rectification.baseline == pytest.approx(BASELINE)
    assert not rectification.ready
    left, _ = seen(np.eye(4), NORMAL, 0.6, left_lens, texture())
    right, _ = seen(T, NORMAL, 0.6, right_lens, texture())
    z = matcher(rectification).depth(left, right)
    T_right_left = se3.inverse(T)
    R, *_ = cv2.stereoRectify(
        longer.matrix, D, LENS.matrix, 0.8 * D, (320, 240), T_right_left[:3, :3], T_right_left[:3, 3],
        flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )  # fmt: skip
    v, u = np.nonzero(np.isfinite(z))
    points = rectification.intrinsics.deproject(np.stack([u, v], axis=-1), z[v, u]) @ R
    assert len(points) > 0.7 * z.size
    distance = points @ NORMAL - 0.6
    assert np.percentile(np.abs(distance), 95) < 0.010  # half a pixel
    assert abs(np.median(distance)) < 0.003


def test_what_one_camera_alone_sees_has_no_depth() -> None:
    """Beside a near body before a wall; without the match back some of it has the depth of one of both."""
    near, far = texture(1), texture(2)
    left, _ = seen(np.eye(4), np.array([0.0, 0.0, 1.0]), 1.2, Lens(LENS), far)
    right, _ = seen(SIDE_BY_SIDE, np.array([0.0, 0.0, 1.0]), 1.2, Lens(LENS), far)
    d_near, d_far = (LENS.fx * BASELINE / z for z in (0.5, 1.2))
    shift = round(d_near)
    left[60:180, 140:220] = right[60:180, 140 - shift : 220 - shift] = near[:120, :80, None]
    # columns of the wall whose match lies behind the body
    hidden = slice(140 - int(d_near - d_far) + 3, 137)
    z = matcher().depth(left, right)[70:170]
    assert np.isfinite(z[:, hidden]).mean() < 0.2
    body = LENS.fx * BASELINE / z[:, 150:210]
    assert np.nanmedian(np.abs(body - shift)) < 0.1
    assert np.isfinite(z[:, 150:210]).mean() > 0.9
    loose = matcher(left_right=0.0, uniqueness=0, speckle_size=0).depth(left, right)[70:170]
    assert np.isfinite(loose[:, hidden]).mean() > 0.5


def test_what_has_no_texture_or_no_partner_has_no_depth() -> None:
    blank = np.full((240, 320, 3), 128, np.uint8)
    assert np.isnan(matcher().depth(blank, blank)).all()
    left, right = (np.repeat(texture(seed)[:240, :320, None], 3, axis=2) for seed in (5, 6))
    assert np.isfinite(matcher().depth(left, right)).mean() < 0.1
    loose = matcher(left_right=0.0, uniqueness=0, speckle_size=0)
    assert np.isfinite(loose.depth(left, right)).mean() > 0.5


def test_stripes_along_the_rows_have_no_depth_where_texture_is_asked_for() -> None:
    rows = np.repeat(texture(3)[:240, 200][:, None], 320, axis=1)
    stripes = np.repeat(rows[..., None], 3, axis=2)
    assert np.isnan(matcher(texture=2.0).depth(stripes, stripes)).all()


def test_depths_are_within_the_limits() -> None:
    left, true = seen(np.eye(4), NORMAL, 0.25, Lens(LENS), texture())
    right, _ = seen(SIDE_BY_SIDE, NORMAL, 0.25, Lens(LENS), texture())
    z = matcher().depth(left, right)
    assert np.isfinite(z).any()
    assert true.min() < LIMITS.near - 0.02
    assert np.nanmin(z) >= LIMITS.near


def test_a_pair_that_is_none_is_refused_with_the_reason() -> None:
    lens, P = Lens(LENS), np.hstack([LENS.matrix, np.zeros((3, 1))])
    shifted = P.copy()
    shifted[0, 3] = LENS.fx * BASELINE
    other = P.copy()
    other[0, 0] += 5.0
    for right, said in ((P, "baseline is -?0 m"), (shifted, "exchanged"), (other, "expected the same")):
        refused(said, Rectification, Rectified(lens, np.eye(3), P), Rectified(lens, np.eye(3), right))
    rectification = Rectification.from_pose(lens, lens, SIDE_BY_SIDE)
    refused("left image is 10x20", rectification.rectify, np.zeros((20, 10), np.uint8), np.zeros((240, 320), np.uint8))
    refused("raise `near`", StereoMatcher, StereoConfig(), rectification, DepthLimits(near=0.01, far=1.0))


@given(st.lists(st.tuples(st.sampled_from(["left", "right"]), st.integers(0, 40)), max_size=60), st.integers(0, 3))
def test_pairs_are_of_both_sides_and_within_the_gap(events: list[tuple[str, int]], gap: int) -> None:
    pairs: PairMatcher[tuple[str, int]] = PairMatcher(gap * 1e-3)
    used: list[tuple[str, int]] = []
    for event in events:
        found = pairs.add(event[0], event[1] * 1_000_000, event)
        if found is not None:
            stamp, left, right = found
            assert (left[0], right[0]) == ("left", "right")
            assert stamp == left[1] * 1_000_000
            assert abs(left[1] - right[1]) <= gap
            assert event in (left, right)
            used += [left, right]
    assert pairs.counts["paired"] * 2 == len(used)


def test_pairs_keep_the_rate_of_the_stamps_and_restart_with_time() -> None:
    pairs: PairMatcher[int] = PairMatcher(0.0, max_rate=10.0)

    def both(t_ms: int) -> bool:
        pairs.add("left", t_ms * 1_000_000, t_ms)
        return pairs.add("right", t_ms * 1_000_000, t_ms) is not None

    assert [both(t) for t in (1000, 1033, 1066, 1100, 1133, 10)] == [True, False, False, True, False, True]
    assert pairs.counts["passed"] == 3
