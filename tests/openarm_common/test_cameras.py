# SPDX-License-Identifier: Apache-2.0
"""Camera frames, intrinsics and mounts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL, Intrinsics, load_cameras, true_mount
from tests.refusals import refused


@pytest.mark.requirement("A-27", "A-30")
def test_intrinsics_from_the_vertical_field_of_view() -> None:
    camera = load_cameras()["overhead"]
    assert camera.fovy_deg == 60.0
    k = camera.intrinsics
    assert (k.width, k.height) == (640, 480)
    assert k.fy == pytest.approx(240.0 / math.tan(math.radians(30.0)), abs=1e-6) == pytest.approx(415.692194, abs=1e-6)
    assert k.fx == k.fy
    assert (k.cx, k.cy) == (319.5, 239.5)


@given(st.floats(0.0, 639.0), st.floats(0.0, 479.0), st.floats(0.05, 5.0))
@pytest.mark.requirement("B-29")
def test_deprojection_is_the_pinhole_and_undoes_projection(u: float, v: float, z: float) -> None:
    k = Intrinsics.from_fovy(640, 480, 60.0)
    p = k.deproject((u, v), z)
    assert p == pytest.approx([(u - k.cx) * z / k.fx, (v - k.cy) * z / k.fy, z])
    assert k.project(p) == pytest.approx([u, v], abs=1e-6)


def test_points_behind_the_camera_have_no_pixel() -> None:
    assert np.isnan(Intrinsics.from_fovy(640, 480, 60.0).project((0.1, 0.1, -1.0))).all()


@pytest.mark.requirement("B-34")
def test_optical_frame_looks_along_link_x_with_y_down() -> None:
    assert np.allclose(T_LINK_OPTICAL[:3, :3] @ (0, 0, 1), (1, 0, 0))
    assert np.allclose(T_LINK_OPTICAL[:3, :3] @ (1, 0, 0), (0, -1, 0))
    assert np.allclose(T_LINK_OPTICAL[:3, :3] @ (0, 1, 0), (0, 0, -1))


@pytest.mark.parametrize("name", ["overhead", "wrist", "spectator"])
def test_mounts_look_forward_with_the_stated_right(name: str) -> None:
    camera = load_cameras()[name]
    R = camera.T_parent_optical[:3, :3]
    forward = np.array(camera.forward) / np.linalg.norm(camera.forward)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.allclose(R[:, 2], forward, atol=1e-9)
    assert R[:, 0] @ np.array(camera.image_right) > 0.99 * np.linalg.norm(camera.image_right)
    assert np.allclose(camera.T_parent_link[:3, 0], forward, atol=1e-9)


def test_the_mount_seed_moves_each_camera_by_a_bounded_error_of_its_own() -> None:
    cameras = load_cameras()
    assert np.array_equal(true_mount(cameras["overhead"], None), cameras["overhead"].T_parent_link)
    assert np.array_equal(true_mount(cameras["spectator"], 1), cameras["spectator"].T_parent_link)
    errors = []
    for seed in range(20):
        for name in ("overhead", "wrist"):
            E = se3.inverse(cameras[name].T_parent_link) @ true_mount(cameras[name], seed)
            assert 0.004 < np.linalg.norm(E[:3, 3]) <= 0.015
            assert math.radians(0.5) < se3.angle_between(np.eye(3), E[:3, :3]) <= math.radians(2.0) + 1e-9
            errors.append(E[:3, 3])
    assert len({tuple(e) for e in errors}) == len(errors)
    assert np.array_equal(true_mount(cameras["wrist"], 3), true_mount(cameras["wrist"], 3))


def test_two_cameras_of_one_name_are_refused(tmp_path) -> None:
    text = "cameras:\n" + 2 * (
        "  - {name: a, parent: world, position: [0, 0, 1], forward: [0, 0, -1], image_right: [0, 1, 0]}\n"
    )
    path = tmp_path / "cameras.yaml"
    path.write_text(text)
    refused("unique", load_cameras, path)


PAIR = """
cameras:
  - {name: head_left, parent: world, position: [0, 0.03, 1], forward: [1, 0, -1], image_right: [0, -1, 0], depth: false}
  - {name: head_right, parent: world, position: [0, -0.03, 1], forward: [1, 0, -1], image_right: [0, -1, 0],
     depth: false, left: head_left, baseline: 0.06}
"""


def test_a_pair_moves_as_one_body_with_the_mount_seed(tmp_path) -> None:
    path = tmp_path / "cameras.yaml"
    path.write_text(PAIR)
    left, right = load_cameras(path).values()
    for seed in (None, 1, 2):
        moved = se3.inverse(true_mount(left, seed)) @ true_mount(right, seed)
        assert moved == pytest.approx(se3.make(None, (0.0, -0.06, 0.0)), abs=1e-12)
    assert not np.allclose(true_mount(right, 1), right.T_parent_link)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("left: head_left", "left: hand", "left is 'hand', expected another camera: head_left"),
        ("left: head_left", "left: head_right", "expected another camera"),
        ("baseline: 0.06", "baseline: 0.07", "0.07 m .* to its right, at 0.0000, -0.0400, 1.0000"),
        (", baseline: 0.06", "", "baseline > 0"),
        ("left: head_left, ", "", "name the left camera"),
        ("left: head_left", "left: head_left, width: 320", "width, height and fovy_deg differ"),
    ],
)
def test_a_pair_that_is_not_side_by_side_is_refused(tmp_path, old: str, new: str, said: str) -> None:
    path = tmp_path / "cameras.yaml"
    assert old in PAIR
    path.write_text(PAIR.replace(old, new))
    refused(said, load_cameras, path)
