# SPDX-License-Identifier: Apache-2.0
"""Projection of circles and its derivatives."""

from __future__ import annotations

import cv2
import numpy as np

from openarm_calibration.board.board import CircleGrid
from openarm_calibration.handeye.problem import fit_poses, normal_equations, project
from openarm_common import se3

ROW = np.array([900.0, 910.0, 640.0, 360.0])
BOARD = CircleGrid()
POSE = se3.make(se3.exp_so3((0.3, -0.4, 0.5)), (0.02, 0.03, 0.4))


def test_the_centre_of_a_circles_image_is_that_of_its_ellipse() -> None:
    """Against an ellipse through 4000 points of the rim; the plain projection is 0.1 px off."""
    centre = BOARD.points[0]
    angle = np.linspace(0.0, 2.0 * np.pi, 4000, endpoint=False)
    rim = centre + BOARD.radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    ellipse = cv2.fitEllipseDirect(project(rim, 0.0, POSE, ROW).astype(np.float32).reshape(-1, 1, 2))
    ours = project(BOARD.points[:1], BOARD.radius, POSE, ROW)[0]
    np.testing.assert_allclose(ours, ellipse[0], atol=2e-3)
    assert np.linalg.norm(ours - project(BOARD.points[:1], 0.0, POSE, ROW)[0]) > 0.05


def test_derivatives_agree_with_differences() -> None:
    """Twist, scale, intrinsics."""

    def pixels(pose=POSE, scale=1.0, row=ROW):
        return project(BOARD.points, BOARD.radius, pose, row, scale).ravel()

    def moved(x):
        return se3.make(se3.exp_so3(x[3:]), x[:3]) @ POSE

    step = 1e-6
    columns = [(pixels(moved(step * e)) - pixels(moved(-step * e))) / (2 * step) for e in np.eye(6)]
    columns.append((pixels(scale=1 + step) - pixels(scale=1 - step)) / (2 * step))
    columns += [pixels(row=ROW + e) - pixels() for e in np.eye(4)]
    J = np.array(columns).T
    A, b, cost = normal_equations(
        BOARD.points, (pixels() + 1.0).reshape(-1, 2), np.array([0, 44]), np.array([BOARD.radius]), POSE[None],
        ROW[None], 1.0,
    )  # fmt: skip
    np.testing.assert_allclose(A[0], J.T @ J, atol=1e-8 * np.abs(A[0]).max())
    np.testing.assert_allclose(b[0], J.sum(axis=0), atol=1e-8 * np.abs(b[0]).max())
    assert cost[0] == 88.0


def test_a_pose_is_found_again_and_a_mark_behind_the_camera_is_no_number() -> None:
    pixels = project(BOARD.points, BOARD.radius, POSE, ROW)
    start = POSE @ se3.make(se3.exp_so3((0.1, -0.1, 0.1)), (0.01, 0.0, 0.02))
    found, cost = fit_poses(BOARD.points, pixels, np.array([0, 44]), np.array([BOARD.radius]), start[None], ROW[None])
    np.testing.assert_allclose(found[0], POSE, atol=1e-9)
    assert cost[0] < 1e-12
    behind = se3.make(None, (0.0, 0.0, -0.4))
    assert np.isnan(project(BOARD.points, BOARD.radius, behind, ROW)).all()
