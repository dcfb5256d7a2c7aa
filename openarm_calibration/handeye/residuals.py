# SPDX-License-Identifier: Apache-2.0
"""Each robot pose against what all others predict for it, and its influence on the answer.

One linear step takes a pose out: with `h` its share of the information and `g` its share of the right-hand side, the
answer without it moves by `-(H - h)⁻¹ g`. The prediction for the pose then has the spread of its own noise plus that
of the answer without it. m, rad, px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openarm_calibration.handeye.problem import Problem, chain, design
from openarm_calibration.handeye.projection import normal_equations
from openarm_calibration.handeye.refine import Estimate
from openarm_common.types import Array

#: Eigenvalues of scaled information below this are a direction that is not known at all.
_UNKNOWN = 1e-10


@dataclass(frozen=True)
class PoseTest:
    """One robot pose (all views taken at it) against the others.

    Args:
        distance: Squared distance by number of measurements, in units of what is expected (1 is usual).
        limit: Above it the pose contradicts the others.
        influence: How far the answer moves without it, in standard deviations of the answer (Cook).
        translation: Contradiction of the worst view, m at the board.
        rotation: The same, rad.
    """

    distance: float
    limit: float
    influence: float
    translation: float
    rotation: float


def pose_tests(
    problem: Problem, used: NDArray[np.bool_], estimate: Estimate, limit: float, usable: NDArray[np.bool_] | None = None
) -> tuple[PoseTest, ...]:
    """Test every robot pose of a problem; views that are not used are tested against all that are.

    Args:
        problem: All views.
        used: (n,) which views the estimate rests on.
        estimate: Of those.
        limit: Largest distance that is usual.
        usable: (n,) views whose marks lie on a board; the others are not looked at, their distance is infinite.

    Returns:
        By number of the pose, as `problem.pose` counts.
    """
    T, B = chain(problem, estimate.X, estimate.Z, np.zeros((len(problem), 6)))
    changes = estimate.intrinsics[problem.camera] if estimate.intrinsics is not None else 0.0
    squares, _, _ = normal_equations(
        problem.points, problem.pixels, problem.offsets, problem.radii, problem.free,
        problem.camera_rows() + changes, estimate.scale,
    )  # fmt: skip
    M = squares[:, :6, :6] * estimate.noise.px**-2.0
    G, K = design(problem, estimate.X, estimate.Z, T, B, estimate.extras)
    extra = 6 * (problem.cameras + problem.boards)
    # extras act beside the twist; their effect on it is what a view's own fit would make of them
    G6 = G[:, :6].copy()
    fit = np.ones(len(problem), dtype=bool) if usable is None else usable
    M[~fit] = np.eye(6)
    if estimate.extras:
        through = np.linalg.solve(M, squares[:, :6, 6:] * estimate.noise.px**-2.0)
        G6[:, :, extra:] += through @ G[:, 6:, extra:]
    y = np.array([_twist(T[i], problem.free[i]) for i in range(len(problem))])
    robot = np.linalg.inv(estimate.noise.prior)
    H = estimate.information
    scale = np.sqrt(np.maximum(np.diag(H), 1e-30))
    out: list[PoseTest] = []
    for pose in range(int(problem.pose.max()) + 1):
        rows = np.flatnonzero(problem.pose == pose)
        k = len(rows)
        if not fit[rows].all():
            out.append(PoseTest(np.inf, limit, 0.0, np.inf, np.inf))
            continue
        S = np.zeros((6 * k, 6 * k))
        Kg = np.concatenate([K[i] if problem.kind[i] < 2 else np.zeros((6, 6)) for i in rows])
        for n, i in enumerate(rows):
            S[6 * n : 6 * n + 6, 6 * n : 6 * n + 6] = np.linalg.inv(M[i])
        S += Kg @ robot @ Kg.T
        Gg, yg = np.concatenate(G6[rows]), np.concatenate(y[rows])
        inside = bool(used[rows].all())
        weighed = np.linalg.solve(S, np.concatenate([Gg, yg[:, None]], axis=1))
        share, right = Gg.T @ weighed[:, :-1], Gg.T @ weighed[:, -1]
        rest = (H - share if inside else H) / np.outer(scale, scale)
        values, vectors = np.linalg.eigh((rest + rest.T) / 2.0)
        values = np.maximum(values, _UNKNOWN)
        C = (vectors / values) @ vectors.T / np.outer(scale, scale)
        moved = -C @ right if inside else np.zeros(len(H))
        error = yg - Gg @ moved
        spread = S + Gg @ C @ Gg.T
        distance = float(error @ np.linalg.solve(spread, error)) / (6 * k)
        influence = float(np.sqrt(max(moved @ H @ moved, 0.0) / len(H)))
        worst = error.reshape(k, 6)
        at_board = np.linalg.norm(worst[:, :3] + np.cross(worst[:, 3:], T[rows][:, :3, 3]), axis=1)
        turn = np.linalg.norm(worst[:, 3:], axis=1)
        out.append(PoseTest(distance, limit, influence, float(at_board.max()), float(turn.max())))
    return tuple(out)


def _twist(T_from: Array, T_to: Array) -> Array:
    """Camera-frame twist (6,) that takes one pose of the board to another, to first order in the translation."""
    from openarm_common import se3

    w = se3.log_so3(T_to[:3, :3] @ T_from[:3, :3].T)
    half = T_from[:3, 3] + (T_to[:3, 3] - T_from[:3, 3]) / 2.0
    return np.concatenate([T_to[:3, 3] - T_from[:3, 3] - np.cross(w, half), w])
