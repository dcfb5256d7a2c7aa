# SPDX-License-Identifier: Apache-2.0
"""Compile the kernels of this package once, so that the first calibration does not wait for them."""

from __future__ import annotations

import numpy as np

from openarm_calibration.board.board import CircleGrid
from openarm_calibration.handeye.problem import BoardView, assemble, project
from openarm_calibration.handeye.solve import solve
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics


def warm() -> None:
    """Solve one small problem: a camera in the hand over a board."""
    board, optics, rng = CircleGrid(), Intrinsics(1280, 720, 900.0, 900.0, 640.0, 360.0), np.random.default_rng(0)
    row = np.array([optics.fx, optics.fy, optics.cx, optics.cy])
    turns = ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.5, 0.0), (-0.5, 0.3, 0.5), (0.3, -0.5, -0.5))
    poses = [se3.make(se3.exp_so3(turn), (0.0, 0.0, 0.4)) for turn in turns]
    pixels = [project(board.points, board.radius, T, row) for T in poses]
    views = [
        BoardView(
            board.points, seen + rng.normal(0.0, 0.1, seen.shape), se3.inverse(T), "in_hand", board.radius, pose=k
        )
        for k, (T, seen) in enumerate(zip(poses, pixels, strict=True))
    ]
    solve(assemble(views, [optics], poses))
