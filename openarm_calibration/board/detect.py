# SPDX-License-Identifier: Apache-2.0
"""A board in a grey image: its marks, in an order that is checked.

Pixels are (u, v) with the centre of the top-left pixel at (0, 0). The pose of the board in the optical frame,
`T_camera_board` (4, 4), is a starting point for least squares.
"""

from __future__ import annotations

import cv2
import numpy as np

from openarm_calibration.board.board import Board
from openarm_calibration.board.circles import CircleGrid, SymmetricCircles
from openarm_calibration.board.detect_circles import detect_circles
from openarm_calibration.board.detect_corners import detect_aprilgrid, detect_charuco, detect_chessboard, detect_marker
from openarm_calibration.board.detection import BoardDetection, Grey
from openarm_calibration.board.squares import AprilGrid, Charuco, Chessboard
from openarm_calibration.handeye.problem import fit_poses
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.lens import Lens
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array, Bytes


def detect(board: Board, image: Grey) -> BoardDetection:
    """Find a board.

    Args:
        board: Board to find.
        image: (h, w) grey.

    Raises:
        OpenArmError: NOTHING_DETECTED, saying what was seen instead; BAD_IMAGE, for an image that is not grey.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise OpenArmError(Code.BAD_IMAGE, f"detection needs a grey 8-bit image, got {image.dtype} {image.shape}")
    cv2.setRNGSeed(0)  # finders draw: the same image has the same answer
    if isinstance(board, CircleGrid | SymmetricCircles):
        return detect_circles(board, image)
    if isinstance(board, Chessboard):
        return detect_chessboard(board, image)
    if isinstance(board, Charuco):
        return detect_charuco(board, image)
    if isinstance(board, AprilGrid):
        return detect_aprilgrid(board, image)
    return detect_marker(board, image)


def detect_undistorted(board: Board, image: Bytes, lens: Lens) -> tuple[BoardDetection, Bytes]:
    """Detect a board; return its marks, and the image, as a camera without the lens's distortion shows them.

    Args:
        board: Board to find.
        image: (h, w) grey, as the camera took it.
        lens: Lens of the camera.

    Raises:
        OpenArmError: NOTHING_DETECTED; BAD_IMAGE, for an image of another size, or a distortion without an inverse.
    """
    straight = lens.rectified(image)
    seen = detect(board, image)
    return BoardDetection(seen.ids, lens.undistorted(seen.pixels), seen.residual), straight


def guess_pose(points: Array, pixels: Array, radius: float, intrinsics: Intrinsics) -> tuple[Array, float]:
    """Return the pose of a flat board and the rms residual, px.

    Args:
        points: (n, 3) marks in the board frame, m, z = 0.
        pixels: (n, 2).
        radius: Radius of the circles, m.
        intrinsics: Intrinsics of the camera.

    Returns:
        (4, 4) T_camera_board, refined, the better of the two that a plane allows.

    Raises:
        OpenArmError: NOTHING_DETECTED, when there is none in front of the camera.
    """
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        points, pixels.reshape(-1, 1, 2), intrinsics.matrix, None, flags=cv2.SOLVEPNP_IPPE
    )
    best: tuple[Array, float] | None = None
    row = np.array([[intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]])
    offsets = np.array([0, len(points)], dtype=np.int64)
    for k in range(count):
        T = se3.make(cv2.Rodrigues(turns[k])[0], np.ravel(shifts[k]))
        if T[2, 3] <= 0.0:
            continue
        pose, cost = fit_poses(
            np.ascontiguousarray(points), np.ascontiguousarray(pixels), offsets, np.array([radius]), T[None], row
        )
        rms = float(np.sqrt(cost[0] / (2 * len(points))))
        if np.isfinite(rms) and (best is None or rms < best[1]):
            best = pose[0], rms
    if best is None:
        raise OpenArmError(Code.NOTHING_DETECTED, "the marks have no pose in front of the camera; are the ids right?")
    return best
