# SPDX-License-Identifier: Apache-2.0
"""Which model of the residuals is right? The one whose answer predicts left-out poses better than the closed forms do.

By its likelihood a misfit, which the marks of a view share, is right where lens or board bend the image, and wrong
where a few large errors of the robot pass for it: it then buys pixels with degrees. Poses that are left out decide. The
worst column of an answer counts (px, m, rad, each against the best closed form of it): with a misfit it must be
better than the closed forms, or than without, by a standard error, else the simpler model is taken (the
one-standard-error rule, Breiman et al. 1984, "Classification and Regression Trees"). m, rad, px.
"""

from __future__ import annotations

import math

import numpy as np

from openarm_calibration.handeye.closed_form import METHODS
from openarm_calibration.handeye.left_out import Held, closed_columns, held_out
from openarm_calibration.handeye.problem import Problem
from openarm_calibration.handeye.solve import SolveConfig, solve
from openarm_calibration.handeye.unknowns import Solution
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array


def solve_chosen(problem: Problem, config: SolveConfig | None = None) -> Solution:
    """Solve for the mounts of one camera and one board, with a misfit or without, as left-out poses have it.

    Args:
        problem: At least three robot poses that differ in rotation about two axes.
        config: How.

    Raises:
        OpenArmError: As `solve`.
    """
    config = config or SolveConfig()
    solution = solve(problem, config)
    part = problem.subset(solution.used)
    single = problem.cameras == 1 and problem.boards == 1 and bool((problem.kind < 2).all())
    if solution.estimate.noise.misfit == 0.0 or not single:
        return solution
    try:
        plain = solve(problem, config.model_copy(update={"misfit": False}))
    except OpenArmError as error:
        if error.code != Code.DEGENERATE:
            raise
        return solution
    best = np.min([closed_columns(part, method) for method in METHODS], axis=0)
    with_misfit, error = _worst(held_out(problem, solution, len(problem)), best)
    without, plain_error = _worst(held_out(problem, plain, len(problem)), best)
    return solution if with_misfit < max(1.0 - error, without - plain_error) else plain


def _worst(held: Held, best: Array) -> tuple[float, float]:
    """Return the largest of the columns over those of the best closed forms (3,), and its standard error."""
    mean = np.nan_to_num(held.squares, nan=math.inf).mean(axis=0)  # a mark behind the camera
    ratio = np.sqrt(mean) / best
    column = int(np.argmax(ratio))
    spread = float(np.std(held.squares[:, column], ddof=1)) / math.sqrt(len(held.squares))
    return float(ratio[column]), 0.5 * float(ratio[column]) * spread / float(mean[column])
