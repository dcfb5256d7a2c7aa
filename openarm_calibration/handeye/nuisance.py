# SPDX-License-Identifier: Apache-2.0
"""Fits in which causes are compared: noise as the data have it, and zeros of the joints that may be off.

Zeros that are off pass for a board of another size or a longer lens, since a few views of an arm in like postures tell
them badly apart. They are a nuisance parameter of every hypothesis: a prior of zero mean, whose deviation is the
likeliest one (empirical Bayes). m, rad, px.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from openarm_calibration.handeye.problem import Extra, Problem
from openarm_calibration.handeye.refine import refine
from openarm_calibration.handeye.unknowns import FREE, Estimate, Noise, Priors
from openarm_common.errors import OpenArmError
from openarm_common.types import Array

#: Deviations of the zeros that are tried, rad; each answer starts from the one before.
_SCALES = tuple(math.radians(degrees) for degrees in (0.03, 0.1, 0.3, 1.0, 3.0))


def fit(
    problem: Problem, X: Array, Z: Array, noise: Noise, extras: tuple[Extra, ...] = (), priors: Priors = FREE
) -> Estimate:
    """Return the likeliest answer, with zeros of the joints as the robot reports them.

    Args:
        problem: The views.
        X: (cameras, 4, 4) to start from.
        Z: (boards, 4, 4) to start from.
        noise: To start from.
        extras: More unknowns.
        priors: Of these.

    Raises:
        OpenArmError: As `refine`.
    """
    start = replace(noise, translation=max(noise.translation, 1e-4), rotation=max(noise.rotation, 1e-4), misfit=0.0)
    return refine(problem, X, Z, start, extras=extras, priors=priors, estimate_robot=True, estimate_px=True)


def with_zeros(problem: Problem, known: Estimate, priors: Priors = FREE) -> Estimate:
    """Return the likelier of an answer and the best one in which the zeros of the joints are off too.

    Args:
        problem: The views; without joint positions the answer is returned as it is.
        known: With zeros as the robot reports them.
        priors: Of its extras.
    """
    best = start = known
    worse = 0
    for scale in _SCALES if problem.joints else ():
        wide = replace(priors, zeros=np.full(problem.joints, scale))
        try:
            start = refine(
                problem, start.X, start.Z, replace(start.noise, misfit=0.0), zeros=start.zeros,
                extras=(*known.extras, "zeros"), priors=wide, estimate_robot=True, estimate_px=True,
            )  # fmt: skip
        except (OpenArmError, np.linalg.LinAlgError):
            break
        if start.evidence < best.evidence:
            best, worse = start, 0
        else:
            worse += 1
        if worse == 2:  # the evidence falls and then rises with the scale
            break
    return best
