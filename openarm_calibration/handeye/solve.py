# SPDX-License-Identifier: Apache-2.0
"""From views to mounts, and where there is no answer, why: wrong input is named before the geometry is blamed."""

from __future__ import annotations

import numpy as np

from openarm_calibration.handeye.causes import diagnose, freed
from openarm_calibration.handeye.observability import FEWEST, require_motion
from openarm_calibration.handeye.problem import Problem
from openarm_calibration.handeye.refine import pixel_noise, refine
from openarm_calibration.handeye.robust import GOOD_ARM, SolveConfig, solve_robustly, starting_mounts
from openarm_calibration.handeye.unknowns import FREE, Noise, Priors, Solution
from openarm_common.errors import Code, OpenArmError

#: An answer with a smaller spread of the marks, and a good arm, is not one of wrong input, px.
_GOOD_PX = 1.0


def solve(
    problem: Problem, config: SolveConfig | None = None, priors: Priors = FREE, *, start: Solution | None = None
) -> Solution:
    """Solve for all mounts of a problem.

    Args:
        problem: Problem with at least three robot poses that differ in rotation about two axes.
        config: Settings of the solver.
        priors: Priors of the extras.
        start: A solution of nearly the same problem, to start from; None: a closed form.

    Raises:
        OpenArmError: DEGENERATE, when the views do not determine the mounts to the accuracy asked for, with the cause
            and what to add; INVALID_ARGUMENT, for numbers that are not finite.
    """
    try:
        return solve_robustly(problem, config, priors, start)
    except OpenArmError as error:
        named = _explained(problem, error)
        if not named:
            raise
        raise OpenArmError(Code.DEGENERATE, f"{named}; so there is no answer: {error.message}") from error


def _explained(problem: Problem, error: OpenArmError) -> str:
    """Return the sentence of what is wrong with the input, when that is why there is no answer; empty otherwise."""
    if error.code not in (Code.DEGENERATE, Code.INTERNAL) or len(problem) < FEWEST:
        return ""
    noise = Noise(pixel_noise(problem), 1e-4, 1e-4)
    base, alternatives = None, {}
    try:
        require_motion(problem)
        X, Z = starting_mounts(problem)
        base = refine(problem, X, Z, noise, estimate_robot=True)
        found = base.noise
        if found.translation < GOOD_ARM[0] and found.rotation < GOOD_ARM[1] and found.view_px < _GOOD_PX:
            return ""  # the views agree with each other: what lacks is more of them
        base, alternatives = freed(problem, base.X, base.Z, base.noise)
    except (OpenArmError, np.linalg.LinAlgError):
        pass
    causes = diagnose(problem, base, alternatives)
    return causes[0].sentence if causes else ""
