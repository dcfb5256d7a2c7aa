# SPDX-License-Identifier: Apache-2.0
"""Which model of the residuals is right? The one that predicts left-out poses better, by a proper score.

By its likelihood a misfit, which the marks of a view share, is right where lens or board bend the image, and wrong
where a few large errors of the robot pass for it. Poses that are left out decide: the score is the log density of their
errors (translation of the board's centre, rotation), as normal with a covariance of its own, the likeliest one. That is
the determinant of their second moments, which weighs metres against radians by what the data have of each (logarithmic
score; Gneiting and Raftery 2007, "Strictly proper scoring rules, prediction, and estimation"). Where closed forms
beat an answer in the image, in position or in rotation, the one that they beat by less is taken. m, rad, px.
"""

from __future__ import annotations

import math

import numpy as np

from openarm_calibration.handeye.closed_form import METHODS
from openarm_calibration.handeye.left_out import HeldOut, closed_columns, held_out
from openarm_calibration.handeye.problem import Problem
from openarm_calibration.handeye.solve import SolveConfig, solve
from openarm_calibration.handeye.unknowns import Solution
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

#: Errors of six numbers: of no more poses than that the determinant is zero.
_FEWEST = 6
#: Errors within a hundredth of each other are the same.
_TIE = 1.01


def solve_chosen(problem: Problem, config: SolveConfig | None = None) -> Solution:
    """Solve for the mounts of one camera and one board, with a misfit or without, as left-out poses have it.

    Args:
        problem: Problem with at least three robot poses that differ in rotation about two axes.
        config: Settings of the solver.

    Raises:
        OpenArmError: Same as `solve`.
    """
    config = config or SolveConfig()
    solution = solve(problem, config)
    single = problem.cameras == 1 and problem.boards == 1 and bool((problem.kind < 2).all())
    if solution.estimate.noise.misfit == 0.0 or not single or np.count_nonzero(solution.used) <= _FEWEST:
        return solution
    try:
        plain = solve(problem, config.model_copy(update={"misfit": False}))
    except OpenArmError as error:
        if error.code != Code.DEGENERATE:
            raise
        return solution
    part = problem.subset(solution.used)
    best = np.nanmin([closed_columns(part, method) for method in METHODS], axis=0)
    ours, others = (_rank(held_out(problem, answer, len(problem)), best) for answer in (solution, plain))
    return plain if others < ours else solution


def _rank(held: HeldOut, best: Array) -> tuple[float, float]:
    """Return how far closed forms with errors (3,) beat an answer in any column, then its score; the lower the better.

    The score is the mean of minus twice the log density of left-out poses, up to a constant.
    """
    score = np.linalg.slogdet(held.twists.T @ held.twists / len(held.twists))[1]
    return max(float(np.nan_to_num(held.columns / best, nan=math.inf).max()), _TIE), float(score)
