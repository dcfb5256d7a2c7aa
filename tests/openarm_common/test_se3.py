# SPDX-License-Identifier: Apache-2.0
"""Properties of the rigid transforms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openarm_common import se3

finite = st.floats(-3.0, 3.0)
rotation_vectors = st.tuples(finite, finite, finite).map(np.array)
transforms = st.tuples(rotation_vectors, rotation_vectors).map(lambda wp: se3.make(se3.exp_so3(wp[0]), wp[1]))


@given(transforms)
def test_inverse_undoes(T: np.ndarray) -> None:
    assert np.allclose(se3.inverse(T) @ T, np.eye(4), atol=1e-12)
    assert np.allclose(T @ se3.inverse(T), np.eye(4), atol=1e-12)


@given(transforms, transforms, rotation_vectors)
def test_composition_is_application_in_turn(T_a: np.ndarray, T_b: np.ndarray, p: np.ndarray) -> None:
    assert np.allclose(se3.apply(T_a @ T_b, p), se3.apply(T_a, se3.apply(T_b, p)), atol=1e-9)


@given(rotation_vectors)
def test_exp_gives_a_rotation_and_log_its_vector(w: np.ndarray) -> None:
    R = se3.exp_so3(w)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.allclose(se3.exp_so3(se3.log_so3(R)), R, atol=1e-9)
    assert np.linalg.norm(se3.log_so3(R)) <= np.pi + 1e-9


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_log_at_half_a_turn(axis: int) -> None:
    w = np.zeros(3)
    w[axis] = np.pi
    assert np.allclose(np.abs(se3.log_so3(se3.exp_so3(w))), w, atol=1e-7)


@given(rotation_vectors)
@pytest.mark.requirement("B-64")
def test_quaternion_round_trip_is_xyzw_with_w_not_negative(w: np.ndarray) -> None:
    R = se3.exp_so3(w)
    q = se3.quat_xyzw_from_matrix(R)
    assert q[3] >= 0.0
    assert np.linalg.norm(q) == pytest.approx(1.0)
    assert np.allclose(se3.matrix_from_quat_xyzw(q), R, atol=1e-9)
    for scale in (-7.0, 1e200, 1e-8):
        assert np.allclose(se3.matrix_from_quat_xyzw(scale * q), R, atol=1e-9)


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0), (np.inf, 0.0, 0.0, 1.0)])
def test_a_quaternion_that_is_no_rotation_is_refused(q: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="not a rotation"):
        se3.matrix_from_quat_xyzw(q)


@pytest.mark.requirement("B-64")
def test_rotation_from_directions() -> None:
    R = se3.rotation_from_z_y((0.0, 0.0, -2.0), (0.0, 1.0, 0.3))
    assert np.allclose(R[:, 2], (0.0, 0.0, -1.0))
    assert np.allclose(R[:, 1], (0.0, 1.0, 0.0))
    assert np.linalg.det(R) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="parallel"):
        se3.rotation_from_z_y((0.0, 0.0, 1.0), (0.0, 0.0, 3.0))
    with pytest.raises(ValueError, match="zero"):
        se3.rotation_from_z_y((0.0, 0.0, 0.0), (0.0, 0.0, 3.0))


@given(transforms, transforms)
def test_interpolation_meets_both_ends(T_a: np.ndarray, T_b: np.ndarray) -> None:
    assert np.allclose(se3.interpolate(T_a, T_b, 0.0), T_a, atol=1e-9)
    assert np.allclose(se3.interpolate(T_a, T_b, 1.0), T_b, atol=1e-7)
    half = se3.interpolate(T_a, T_b, 0.5)
    angle = se3.angle_between(T_a[:3, :3], T_b[:3, :3])
    assert se3.angle_between(T_a[:3, :3], half[:3, :3]) == pytest.approx(angle / 2.0, abs=1e-6)


def test_urdf_rpy_is_fixed_axis() -> None:
    R = se3.matrix_from_rpy(0.1, 0.2, 0.3)
    assert np.allclose(R, se3.rot_z(0.3) @ se3.rot_y(0.2) @ se3.rot_x(0.1))


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_rpy_of_an_upright_pitch_gives_the_rotation_again(pitch: float) -> None:
    R = se3.matrix_from_rpy(0.4, pitch, 0.0)
    assert np.allclose(se3.matrix_from_rpy(*se3.rpy_from_matrix(R)), R)
