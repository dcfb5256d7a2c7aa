# SPDX-License-Identifier: Apache-2.0
"""The next best pose: which robot pose would tell most about the mounts.

A candidate is worth what it takes off the predicted errors of the camera's mount, position and rotation in their
units (`observability.UNITS`). What it would see is computed from the present estimate. m and rad.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from openarm_calibration.board.board import Board
from openarm_calibration.handeye.observability import UNITS, motion
from openarm_calibration.handeye.problem import Problem, View, assemble, chain
from openarm_calibration.handeye.projection import project
from openarm_calibration.handeye.refine import information_at, invert_scaled
from openarm_calibration.handeye.solve import Solution
from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

#: Marks nearer to the edge of the image do not count as seen, px.
EDGE = 12.0
#: Views that are tilted more are not detected well.
MOST_TILT = math.radians(55.0)
#: Samples that people are asked for.
ENOUGH = 12


@dataclass(frozen=True)
class Choice:
    """A candidate and what it would do.

    Args:
        index: Of the candidate.
        sigma_translation: Predicted error of the position with it, m.
        sigma_rotation: The same of the rotation, rad.
    """

    index: int
    sigma_translation: float
    sigma_rotation: float


def visible(board: Board, T_camera_board: Array, row: Array, size: tuple[int, int]) -> bool:
    """Whether all marks would be in the image (width, height), not tilted too far, and seen from the front."""
    direction = T_camera_board[:3, 3] / max(float(np.linalg.norm(T_camera_board[:3, 3])), 1e-9)
    if float(T_camera_board[:3, 2] @ direction) < math.cos(MOST_TILT):
        return False
    pixels = project(board.points, board.radius, T_camera_board, row)
    inside = (pixels > EDGE) & (pixels < np.array(size) - 1.0 - EDGE)
    return bool(np.isfinite(pixels).all() and inside.all())


def rank(board: Board, solution: Solution, candidates: Array) -> list[Choice]:
    """Candidates that show the board, the most telling first.

    Args:
        board: That is looked at.
        solution: So far; of one camera and one board.
        candidates: (n, 4, 4) robot poses A, as in the views.

    Raises:
        OpenArmError: UNREACHABLE, when no candidate would show the board.
    """
    problem, estimate = solution.problem.subset(solution.used), solution.estimate
    before = information_at(problem, estimate.X, estimate.Z, estimate.noise)
    sample = problem.views[0]
    k = problem.intrinsics[0]
    row = np.array([k.fx, k.fy, k.cx, k.cy])
    out: list[tuple[float, Choice]] = []
    for index, A in enumerate(candidates):
        T = _seen(problem, sample, A, estimate.X, estimate.Z)
        if not visible(board, T, row, (k.width, k.height)):
            continue
        view = View(board.points, project(board.points, board.radius, T, row), A, sample.setup, board.radius)
        gain = information_at(assemble([view], problem.intrinsics, [T]), estimate.X, estimate.Z, estimate.noise)
        covariance = invert_scaled(before + gain)[:6, :6]
        variance = np.diag(covariance)
        choice = Choice(index, math.sqrt(variance[:3].sum()), math.sqrt(variance[3:].sum()))
        out.append((float(np.sum(variance / UNITS**2)), choice))
    if not out:
        raise OpenArmError(
            Code.UNREACHABLE,
            f"none of {len(candidates)} candidate poses would show all of the board; move nearer to it",
        )
    return [choice for _, choice in sorted(out, key=lambda item: item[0])]


def _seen(problem: Problem, sample: View, A: Array, X: Array, Z: Array) -> Array:
    single = assemble([replace(sample, A=A)], problem.intrinsics, [problem.free[0]])
    return chain(single, X, Z, np.zeros((1, 6)))[0][0]


def around(T_camera_board: Array, count: int, rng: np.random.Generator) -> Array:
    """Views (count, 4, 4) T_camera_board around a first one: tilted, turned, nearer and farther."""
    out: list[Array] = []
    for _ in range(count):
        tilt = rng.uniform(math.radians(10.0), math.radians(40.0))
        azimuth = rng.uniform(0.0, math.tau)
        turn = se3.exp_so3((tilt * math.cos(azimuth), tilt * math.sin(azimuth), 0.0)) @ se3.rot_z(
            rng.uniform(-1.0, 1.0)
        )
        distance = float(np.linalg.norm(T_camera_board[:3, 3])) * rng.uniform(0.75, 1.2)
        offset = np.append(rng.uniform(-0.08, 0.08, 2), 1.0) * distance
        out.append(se3.make(turn @ T_camera_board[:3, :3], offset))
    return np.array(out)


def robot_pose(setup: str, X: Array, Z: Array, T_camera_board: Array) -> Array:
    """Robot pose A (4, 4) from which the camera sees the board at `T_camera_board`."""
    B = X @ T_camera_board @ se3.inverse(Z)
    return se3.inverse(B) if setup == "in_hand" else B


def advice(A: Sequence[Array] | Array) -> str:
    """What to do next, in words, for someone who moves the arm by hand.

    Args:
        A: Robot poses so far, (n, 4, 4).
    """
    poses = np.asarray(A, dtype=np.float64).reshape(-1, 4, 4)
    if len(poses) == 0:
        return "take a first sample with all of the board in the image, as large as it fits"
    seen = motion(poses)
    least = _least_turned(poses)
    if len(poses) < 3 or seen.rotation < math.radians(30.0) or seen.second < math.radians(15.0):
        return (
            f"rotate about the wrist's {least} axis by 30° or more (so far {math.degrees(seen.rotation):.0f}°, and"
            f" {math.degrees(seen.second):.0f}° about a second axis), with the board in the image"
        )
    if seen.translation < 0.05:
        return "move 5 cm or more nearer to the board, or farther from it, and tilt"
    if len(poses) < ENOUGH:
        return f"{ENOUGH - len(poses)} more of this kind; rotate about the wrist's {least} axis, which turned least"
    return "enough; solve, and look at the predicted error"


def _least_turned(poses: Array) -> str:
    """Axis of the gripper about which the poses turned least."""
    n = len(poses)
    logs = [se3.log_so3(poses[i, :3, :3].T @ poses[j, :3, :3]) for i in range(n) for j in range(i + 1, n)]
    spread = np.sum(np.square(logs), axis=0) if logs else np.zeros(3)
    return "xyz"[int(np.argmin(spread))]
