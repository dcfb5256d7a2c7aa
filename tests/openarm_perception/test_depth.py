# SPDX-License-Identifier: Apache-2.0
"""Depth images to points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_perception.geometry import depth as depth_module
from openarm_perception.geometry.depth import Deprojector, DepthLimits

K = Intrinsics.from_fovy(16, 12, 60.0)
LIMITS = DepthLimits(near=0.2, far=2.0)


def reference(depth, scale: float, intrinsics: Intrinsics, limits: DepthLimits):
    """The pinhole written out, in double precision."""
    z = depth.astype(np.float64) * scale
    z = np.where((z >= limits.near) & (z <= limits.far), z, np.nan)
    v, u = np.mgrid[: intrinsics.height, : intrinsics.width]
    x = (u - intrinsics.cx) * z / intrinsics.fx
    y = (v - intrinsics.cy) * z / intrinsics.fy
    return np.stack([x, y, z], axis=-1)


@settings(max_examples=8)
@given(hnp.arrays(np.uint16, (12, 16), elements=st.integers(0, 2500).filter(lambda d: d not in (200, 2000))))
@pytest.mark.requirement("A-47", "B-29")
def test_millimetres_equal_the_pinhole_written_out(depth) -> None:
    """16UC1 over 1000; x = (u - cx) z / fx, y = (v - cy) z / fy; the filtered points are the valid ones."""
    expected = reference(depth, 1e-3, K, LIMITS)
    deprojector = Deprojector(LIMITS)
    points = deprojector.organised(depth, K)
    assert points.dtype == np.float32
    np.testing.assert_allclose(points, expected, atol=1e-6)
    kept = deprojector.valid_points(depth, K)
    np.testing.assert_allclose(kept, expected[np.isfinite(expected[..., 2])], atol=1e-6)


@settings(max_examples=30)
@given(hnp.arrays(np.float32, (12, 16), elements=st.floats(0.0, 2.5, width=32) | st.just(float("nan"))))
@pytest.mark.requirement("A-47")
def test_metres_equal_the_pinhole_written_out(depth) -> None:
    """32FC1 is metres."""
    near, far = np.float32(LIMITS.near), np.float32(LIMITS.far)
    depth[np.isin(depth, [near, far])] = 1.0
    np.testing.assert_allclose(Deprojector(LIMITS).organised(depth, K), reference(depth, 1.0, K, LIMITS), atol=1e-6)


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf, -1.0, 0.199, 2.001])
@pytest.mark.requirement("A-48")
def test_invalid_and_too_near_depth_is_removed(bad: float) -> None:
    """Zero, NaN and what is outside the limits of the camera becomes NaN, and is left out of the filtered points."""
    depth = np.ones((12, 16), np.float32)
    depth[3, 5] = bad
    deprojector = Deprojector(LIMITS)
    points = deprojector.organised(depth, K)
    assert np.isnan(points[3, 5]).all()
    assert np.isfinite(np.delete(points.reshape(-1, 3), 3 * 16 + 5, axis=0)).all()
    assert len(deprojector.valid_points(depth, K)) == 12 * 16 - 1


@pytest.mark.requirement("A-31")
def test_rays_follow_the_intrinsics_of_each_frame() -> None:
    """A changed CameraInfo changes the points at once; nothing else says what the intrinsics are."""
    depth = np.full((12, 16), 1000, np.uint16)
    deprojector = Deprojector(LIMITS)
    first = deprojector.organised(depth, K)
    wider = Intrinsics.from_fovy(16, 12, 90.0)
    second = deprojector.organised(depth, wider)
    np.testing.assert_allclose(second[..., :2] / first[..., :2], K.fx / wider.fx, rtol=1e-6)
    np.testing.assert_allclose(deprojector.organised(depth, K), first)


@pytest.mark.requirement("A-28", "A-30")
def test_planar_depth_of_a_tilted_camera_gives_a_flat_table(tabletop) -> None:
    """With fy = (h/2)/tan(fovy/2) and depth along the axis, a rendered table is flat and at its height to 1 mm."""
    view = tabletop.render([])
    assert view.intrinsics.fy == pytest.approx(240.0 / np.tan(np.radians(30.0)), rel=1e-6)
    assert view.intrinsics.fy == pytest.approx(415.69, abs=0.01)
    for depth in (view.depth, view.millimetres):
        points = Deprojector(DepthLimits(near=0.2, far=0.95)).organised(depth, view.intrinsics)
        base = points @ view.T_base_camera[:3, :3].T + view.T_base_camera[:3, 3]
        on_table = (np.abs(base[..., 0] - 0.4) < 0.45) & (np.abs(base[..., 1]) < 0.5)
        assert np.count_nonzero(on_table) > 200_000
        assert np.abs(base[on_table, 2] - 0.40).max() < 1e-3


@pytest.mark.parametrize("depth", [np.ones((12, 16)), np.ones((12, 16), np.uint8), np.ones((12, 16, 1), np.float32)])
@pytest.mark.requirement("B-28")
def test_unknown_encodings_are_refused(depth) -> None:
    """Neither 16UC1 nor 32FC1."""
    with pytest.raises(OpenArmError, match=r"expected \(h, w\) of uint16 millimetres") as caught:
        Deprojector(LIMITS).organised(depth, K)
    assert caught.value.code is Code.BAD_IMAGE


@pytest.mark.requirement("B-30")
def test_an_image_of_another_size_than_its_info_is_refused() -> None:
    """The message names both sizes."""
    with pytest.raises(OpenArmError, match=r"8x6 pixels.*16x12"):
        Deprojector(LIMITS).valid_points(np.ones((6, 8), np.float32), K)


def test_images_of_messages_and_of_arrays_share_a_compiled_kernel() -> None:
    """A read-only view is another type to numba; it would be compiled again, in a callback, at the first frame."""
    depth = np.ones((12, 16), np.float32)
    message = np.frombuffer(depth.tobytes(), np.float32).reshape(12, 16)
    deprojector = Deprojector(LIMITS)
    for image in (depth, message, np.ones((12, 32), np.float32)[:, ::2]):
        np.testing.assert_array_equal(deprojector.organised(image, K), deprojector.organised(depth, K))
        assert len(deprojector.valid_points(image, K)) == depth.size
    assert all(len(kernel.signatures) <= 2 for kernel in (depth_module._organise, depth_module._filter))


def test_writes_into_a_given_array() -> None:
    """A caller that owns the memory saves an allocation a frame."""
    out = np.empty((12, 16, 3), np.float32)
    assert Deprojector(LIMITS).organised(np.ones((12, 16), np.float32), K, out) is out


def test_limits_must_be_in_order() -> None:
    """Far before near is a mistake in the configuration."""
    with pytest.raises(ValueError, match="far must be larger than near"):
        DepthLimits(near=1.0, far=0.5)
