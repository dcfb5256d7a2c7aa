# SPDX-License-Identifier: Apache-2.0
"""Is the result right? Held-out error, scale, delay, drift, and a grade against stated limits.

Held-out errors come from solving without some poses and predicting them: px in the image, mm at the board's distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from openarm_calibration.handeye.causes import diagnose, freed
from openarm_calibration.handeye.left_out import held_out, reprojection_rms, rival
from openarm_calibration.handeye.limits import Limits
from openarm_calibration.handeye.problem import Problem
from openarm_calibration.handeye.refine import mount_error, refine
from openarm_calibration.handeye.solve import SolveConfig, solve
from openarm_calibration.handeye.transforms import difference
from openarm_calibration.handeye.unknowns import Estimate, Priors, Solution
from openarm_calibration.sampling.samples import SampleSet
from openarm_common.camera.cameras import Intrinsics
from openarm_common.types import Array

if TYPE_CHECKING:
    from openarm_calibration.handeye.accuracy import Accuracy

Grade = Literal["pass", "warn", "fail"]
GRADES: tuple[Grade, ...] = ("pass", "warn", "fail")
#: Ratio to a limit beyond which a calibration fails.
_FAIL = 3.0
#: Of a robot whose joints are not known.
_OF_POSES = "poses that are not of one moment with the images, or of another link"


@dataclass(frozen=True)
class Check:
    """One criterion.

    Args:
        name: Name of the check, a word or two.
        ratio: Over its limit; above 1 is a warning, above 3 a failure.
        text: The figure in a sentence.
    """

    name: str
    ratio: float
    text: str


@dataclass(frozen=True)
class Grading:
    """Grade, why, the figures (SI units, px), and all checks.

    Args:
        grade: Pass, warn or fail.
        reasons: Texts of the checks beyond their limits.
        figures: SI units and px.
        checks: All of them.
        closed_form: The method whose answer is to be used instead, as it predicts left-out views better; usually none.
    """

    grade: Grade
    reasons: tuple[str, ...]
    figures: dict[str, Any]
    checks: tuple[Check, ...] = ()
    closed_form: str = ""


def estimate_delay(samples: SampleSet, config: SolveConfig | None = None, rounds: int = 4) -> tuple[float, float]:
    """Return how old the images are at their stamps, with its standard deviation, s; needs samples of a moving robot.

    The deviation is infinite when the robot stood in all samples.

    Args:
        samples: Samples of a moving robot.
        config: Parameters of the solver.
        rounds: Most rounds.
    """
    config = config or SolveConfig(most_translation=0.1, most_rotation=0.2, reject_outliers=False)
    delay, sigma = 0.0, math.inf
    for _ in range(rounds):
        problem = samples.problem(delay)
        if not np.abs(problem.rate).max() > 1e-4:
            return 0.0, math.inf
        estimate = solve(problem, config.model_copy(update={"extras": ("delay",)})).estimate
        delay += estimate.delay
        sigma = math.sqrt(float(estimate.covariance()[-1, -1]))
        if abs(estimate.delay) < 1e-5:
            break
    return delay, sigma


def assess(
    problem: Problem,
    solution: Solution,
    limits: Limits | None = None,
    stored: Array | None = None,
    by_zeros: Accuracy | None = None,
) -> Grading:
    """Grade a solution of one camera.

    Args:
        problem: All views.
        solution: Solution of them.
        limits: None is the defaults.
        stored: (4, 4) the mount X in use until now, for the drift.
        by_zeros: Accuracy with zeros of the joints that may be off; None: they are taken for exact.
    """
    limits = limits or Limits()
    sigma_t, sigma_r = solution.sigma()
    one_out, folds = held_out(problem, solution, len(problem)), held_out(problem, solution, 5)
    now = solution.estimate
    part = problem.subset(solution.used)
    base, alternatives = freed(part, now.X, now.Z, now.noise)
    causes = diagnose(part, base, alternatives)
    scale, scale_sigma = alternatives["board size"].value() if "board size" in alternatives else (1.0, math.inf)
    focal, focal_sigma = 1.0, math.inf
    if "focal length" in alternatives:
        focal, focal_sigma = _focal(alternatives["focal length"].estimate, problem.intrinsics[0])
    better = rival(problem, solution, one_out)
    true_t, true_r = lens_t, lens_r = accuracy(solution, limits)
    if by_zeros is not None:
        true_t, true_r = math.hypot(true_t, by_zeros.translation), math.hypot(true_r, by_zeros.rotation)
    poses = len(np.unique(problem.pose[solution.used]))
    figures: dict[str, Any] = {
        "sigma_translation": sigma_t, "sigma_rotation": sigma_r,
        "accuracy_translation": true_t, "accuracy_rotation": true_r,
        "px": now.noise.px, "misfit_px": now.noise.misfit_px(float(np.mean(part.marks))),
        "robot_translation": solution.estimate.noise.translation, "robot_rotation": solution.estimate.noise.rotation,
        "condition": solution.condition, "samples": poses,
        "reprojection_px": reprojection_rms(part, now.X, now.Z),
        "leave_one_out_px": one_out.px, "leave_one_out": one_out.metres,
        "five_fold_px": folds.px, "five_fold": folds.metres,
        "scale": scale, "scale_sigma": scale_sigma, "focal": focal, "focal_sigma": focal_sigma,
        "by_sample": {name: {"px": px, "metres": m} for name, (px, m) in one_out.by_name.items()},
        "influence": {v.name: solution.tests[int(problem.pose[k])].influence for k, v in enumerate(problem.views)},
        "outliers": {outlier.name: outlier.reason for outlier in solution.outliers},
        "causes": {cause.name: cause.evidence for cause in causes},
    }  # fmt: skip
    because = ""
    if max(lens_t / sigma_t, lens_r / sigma_r) > 2.0:
        because = f", as the focal length is known to {limits.focal_known:.1%}: take more poses, near and far"
    if by_zeros is not None:
        figures |= {"hand": by_zeros.hand, "zeros_sigma": by_zeros.zeros}
        least = max(by_zeros.zeros, key=by_zeros.zeros.__getitem__)
        if max(true_t / max(sigma_t, lens_t), true_r / max(sigma_r, lens_r)) > 1.4:
            because = f", as the zero of {least} is known to {math.degrees(by_zeros.zeros[least]):.2f}°"
    outliers, views = len(solution.outliers), len(problem)
    arm = solution.estimate.noise
    spread = "wrong joint zeros; find them by `openarm calibrate zeros`" if problem.joints else _OF_POSES
    checks = [
        Check(
            "position", _beyond(sigma_t, true_t, limits.translation),
            f"accuracy of the position {true_t * 1e3:.2f} mm{because}",
        ),
        Check(
            "rotation", _beyond(sigma_r, true_r, limits.rotation),
            f"accuracy of the rotation {math.degrees(true_r):.3f}°{because}",
        ),
        Check(
            "held out", one_out.metres / limits.held_out, f"held-out error {one_out.metres * 1e3:.3f} mm at the board"
        ),
        Check(
            "robot", arm.rotation / limits.robot,
            f"the hand seems off by {arm.translation * 1e3:.1f} mm and {math.degrees(arm.rotation):.2f}° from pose to"
            f" pose, as with {spread}",
        ),
        Check(
            "contradictions", outliers / max(views, 1) / 0.1,
            f"{outliers} of {views} samples contradict the others",
        ),
        Check("poses", 1.5 if poses < limits.samples else 0.0, f"{poses} poses, {limits.samples} are wanted"),
    ]  # fmt: skip
    if math.isnan(one_out.metres):
        del checks[2]
    if causes:
        cause = causes[0]
        allowed = max(cause.translation / limits.translation, cause.rotation / limits.rotation)
        # what moves the mount by more than the grade allows is a failure, however sure the answer is of itself
        checks.insert(0, Check(cause.name, _FAIL + allowed if allowed > 1.0 else allowed, cause.sentence))
    if better is not None:
        # an answer of last resort: never a pass
        checks.append(Check("closed form", 2.0, better.sentence))
    if stored is not None:
        offset, angle = mount_error(solution.estimate.X[0], stored)
        figures |= {"drift": offset, "drift_rotation": angle}
        # a drift is no fault of this result: never more than a warning
        text = f"the camera is {offset * 1e3:.1f} mm and {math.degrees(angle):.2f}° from what is stored"
        checks.append(Check("drift", min(offset / limits.drift, 2.0), text))
    reasons = tuple(check.text for check in checks if check.ratio > 1.0)
    worst = max(check.ratio for check in checks)
    grade: Grade = "fail" if worst > _FAIL else "warn" if worst > 1.0 else "pass"
    return Grading(grade, reasons, figures, tuple(checks), "" if better is None else better.method)


def _beyond(repeatable: float, accurate: float, limit: float) -> float:
    """Return an error over its limit: what is only not known of lens and zeros is a warning, and no failure."""
    return max(repeatable / limit, min(accurate / limit, _FAIL))


def _focal(estimate: Estimate, stated: Intrinsics) -> tuple[float, float]:
    """Return the focal length over the stated one where it is free, and its deviation.

    Of fx and fy the one farther off.

    Args:
        estimate: Estimate with free intrinsics.
        stated: Stated intrinsics of the first camera.
    """
    first = 6 * (len(estimate.X) + len(estimate.Z))
    sigma = np.sqrt(np.maximum(np.diag(estimate.covariance())[first : first + 2], 0.0))
    both = [
        (float(change) / f, float(s) / f)
        for change, s, f in zip(estimate.intrinsics[0, :2], sigma, (stated.fx, stated.fy), strict=True)
    ]
    change, deviation = max(both, key=lambda pair: abs(pair[0]) - 3.0 * pair[1])
    return 1.0 + change, deviation


def accuracy(solution: Solution, limits: Limits) -> tuple[float, float]:
    """Return the predicted error of the first mount with what is not known of the intrinsics, m and rad.

    Focal length, principal point and distortion are freed within the deviations of the limits; the answer moves by as
    much as the data then want, and that counts as error too. Repeatability, of `Solution.sigma`, takes them for exact.

    Args:
        solution: Solution of one camera.
        limits: Deviations of the intrinsics.
    """
    now = solution.estimate
    priors = Priors(focal=limits.focal_known, centre=limits.centre_known, distortion=limits.distortion_known)
    free = refine(
        solution.problem.subset(solution.used), now.X, now.Z, now.noise, extras=("intrinsics", "distortion"),
        priors=priors,
    )  # fmt: skip
    away = difference(now.X[0], free.X[0])
    covariance = free.covariance()[:6, :6] + np.outer(away, away)
    least_t, least_r = solution.sigma()
    variance = np.diag(covariance)
    return max(math.sqrt(variance[:3].sum()), least_t), max(math.sqrt(variance[3:].sum()), least_r)
