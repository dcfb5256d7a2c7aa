# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms as 4×4 matrices.

``T_parent_child`` maps child coordinates to parent coordinates: ``p_parent = T_parent_child @ p_child``. Rotations
are 3×3 matrices, quaternions are ``(x, y, z, w)`` as in ROS messages. Angles are radians, lengths metres.
Orientations are built from directions (``rotation_from_z_y``); roll, pitch, yaw exist only because URDF is written in
them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.types import Array

#: Corners (8, 3) of a box of half edges 1.
BOX_CORNERS: Array = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def make(R: ArrayLike | None = None, p: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Build a transform.

    Args:
        R: (3, 3) rotation; None is the identity.
        p: (3,) translation, m.
    """
    T = np.eye(4)
    if R is not None:
        T[:3, :3] = R
    T[:3, 3] = p
    return T


def inverse(T: Array) -> Array:
    """Invert a rigid transform."""
    R_t = T[:3, :3].T
    out = np.eye(4)
    out[:3, :3] = R_t
    out[:3, 3] = -R_t @ T[:3, 3]
    return out


def is_pose(T: Array) -> bool:
    """Whether (4, 4) is a rotation and a translation, to six digits."""
    return bool(
        np.isfinite(T).all()
        and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
        and np.array_equal(T[3], (0.0, 0.0, 0.0, 1.0))
        and np.linalg.det(T[:3, :3]) > 0.0
    )


def apply(T: Array, points: ArrayLike) -> Array:
    """Map points (..., 3) through `T`."""
    return np.asarray(points, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def rot_x(angle: float) -> Array:
    """Return the rotation about x."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rot_y(angle: float) -> Array:
    """Return the rotation about y."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rot_z(angle: float) -> Array:
    """Return the rotation about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def matrix_from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """Return URDF's fixed-axis roll, pitch, yaw: ``Rz(yaw) Ry(pitch) Rx(roll)``.

    Args:
        roll: About x, rad.
        pitch: About y, rad.
        yaw: About z, rad.
    """
    return rot_z(yaw) @ rot_y(pitch) @ rot_x(roll)


def rpy_from_matrix(R: Array) -> tuple[float, float, float]:
    """Return roll, pitch, yaw of a rotation (3, 3), see `matrix_from_rpy`; with the pitch upright, the yaw is 0."""
    level = math.hypot(R[0, 0], R[1, 0])
    pitch = math.atan2(-R[2, 0], level)
    if level < 1e-9:
        return math.atan2(-R[1, 2], R[1, 1]), pitch, 0.0
    return math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])


def rotation_from_z_y(z: ArrayLike, y: ArrayLike) -> Array:
    """Return the rotation whose z axis is `z` and whose y axis is `y` made perpendicular to it.

    For a gripper: z is the approach (out of the fingers), y the opening axis.

    Raises:
        ValueError: When `z` is zero or `y` is parallel to it.
    """
    z_axis = np.asarray(z, dtype=np.float64)
    y_axis = np.asarray(y, dtype=np.float64)
    z_norm = float(np.linalg.norm(z_axis))
    if z_norm < 1e-12:
        raise ValueError(f"z must not be the zero vector, got {z_axis.tolist()}")
    z_axis = z_axis / z_norm
    y_axis = y_axis - z_axis * float(y_axis @ z_axis)
    y_norm = float(np.linalg.norm(y_axis))
    if y_norm < 1e-9:
        raise ValueError(f"y {np.asarray(y).tolist()} is parallel to z {np.asarray(z).tolist()}")
    y_axis = y_axis / y_norm
    return np.stack([np.cross(y_axis, z_axis), y_axis, z_axis], axis=1)


def exp_so3(w: ArrayLike) -> Array:
    """Return the rotation of a rotation vector (3,), rad (Rodrigues)."""
    v = np.asarray(w, dtype=np.float64)
    angle = float(np.linalg.norm(v))
    K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    if angle < 1e-8:
        return np.eye(3) + K + 0.5 * K @ K
    return np.eye(3) + np.sin(angle) / angle * K + (1.0 - np.cos(angle)) / angle**2 * K @ K


def log_so3(R: Array) -> Array:
    """Return the rotation vector (3,) of a rotation, rad; norm in [0, pi]."""
    q = quat_xyzw_from_matrix(R)
    if q[3] < 0.0:
        q = -q
    s = float(np.linalg.norm(q[:3]))
    if s < 1e-12:
        return 2.0 * q[:3]
    return q[:3] * (2.0 * float(np.arctan2(s, q[3])) / s)


def angle_between(R_a: Array, R_b: Array) -> float:
    """Return the angle of the rotation from `R_a` to `R_b`, rad in [0, pi]."""
    return float(np.linalg.norm(log_so3(R_a.T @ R_b)))


def interpolate(T_a: Array, T_b: Array, u: float) -> Array:
    """Interpolate between two transforms: straight line, one constant turn; `u` in [0, 1].

    Args:
        T_a: (4, 4) at u = 0.
        T_b: (4, 4) at u = 1.
        u: 0 .. 1.
    """
    R = T_a[:3, :3] @ exp_so3(u * log_so3(T_a[:3, :3].T @ T_b[:3, :3]))
    return make(R, (1.0 - u) * T_a[:3, 3] + u * T_b[:3, 3])


def matrix_from_quat_xyzw(q_xyzw: ArrayLike) -> Array:
    """Return the rotation of a quaternion (x, y, z, w); need not be normalised.

    Raises:
        ValueError: When the quaternion is zero or not finite.
    """
    q = np.asarray(q_xyzw, dtype=np.float64)
    largest = float(np.abs(q).max())  # squares of finite numbers may be infinite
    if not 1e-9 <= largest < np.inf:
        raise ValueError(f"quaternion (x, y, z, w) {q.tolist()} is not a rotation: expected a finite, non-zero norm")
    q = q / largest
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def quat_xyzw_from_matrix(R: Array) -> Array:
    """Return the unit quaternion (x, y, z, w) of a rotation, by its largest component (Shepperd 1978), with w >= 0."""
    m = R
    trace = float(m[0, 0] + m[1, 1] + m[2, 2])
    candidates = (float(m[0, 0]), float(m[1, 1]), float(m[2, 2]), trace)
    k = int(np.argmax(candidates))
    if k == 3:
        q = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1.0 + trace])
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        q = np.empty(4)
        q[k] = 1.0 + 2.0 * m[k, k] - trace
        q[i] = m[i, k] + m[k, i]
        q[j] = m[j, k] + m[k, j]
        q[3] = m[j, i] - m[i, j]
    q = q / np.linalg.norm(q)
    return -q if q[3] < 0.0 else q
