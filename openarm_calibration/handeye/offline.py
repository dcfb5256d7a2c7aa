# SPDX-License-Identifier: Apache-2.0
"""From a set of samples to a calibration with its verdict: what the node and the command line both do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import cv2
import numpy as np

from openarm_calibration.handeye.closed_form import METHODS, closed_form
from openarm_calibration.handeye.observability import require_motion
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.solve import Solution, SolveConfig, solve
from openarm_calibration.handeye.verdict import Limits, Verdict, assess, side_by_side
from openarm_calibration.sampling.samples import SampleSet
from openarm_calibration.store.store import StoredCalibration
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL
from openarm_common.errors import Code, OpenArmError

REFINED = "REFINED"
ALGORITHMS = (REFINED, *METHODS)


@dataclass(frozen=True, eq=False)
class Result:
    """A solved session.

    Args:
        solution: The refinement, also where a closed form was asked for: the verdict rests on it.
        verdict: Grade and figures.
        methods: Every method beside the refinement.
        calibration: To be stored: of the method that was asked for.
    """

    solution: Solution
    verdict: Verdict
    methods: dict[str, dict[str, float] | str]
    calibration: StoredCalibration

    def as_json(self) -> dict[str, Any]:
        """For `--json`, services and reports."""
        return {
            "grade": self.verdict.grade,
            "reasons": list(self.verdict.reasons),
            "checks": {check.name: check.ratio for check in self.verdict.checks},
            "figures": self.verdict.figures,
            "methods": self.methods,
            "intrinsics": asdict(self.solution.problem.intrinsics[0]),
            "calibration": self.calibration.model_dump(mode="json"),
        }


def checked_algorithm(name: str) -> str:
    """Return the method's proper name.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the methods.
    """
    if name.upper() not in ALGORITHMS:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no algorithm {name!r}; algorithms: {', '.join(ALGORITHMS)}")
    return name.upper()


def calibrate(
    samples: SampleSet,
    *,
    algorithm: str = REFINED,
    config: SolveConfig | None = None,
    limits: Limits | None = None,
    session: str = "",
    created: str = "",
    stored: StoredCalibration | None = None,
) -> Result:
    """Solve a session and judge it.

    Args:
        samples: At least three poses that differ in rotation about two axes.
        algorithm: What the stored mount is of; the refinement unless a comparison wants otherwise.
        config: Of the solver.
        limits: Of the verdict.
        session: Hash of the session, for the record.
        created: When, as ISO 8601, for the record.
        stored: The calibration in use until now, for the drift.

    Raises:
        OpenArmError: DEGENERATE, with cause and advice; INVALID_ARGUMENT, for an unknown algorithm.
    """
    name = checked_algorithm(algorithm)
    solution = solve(samples.problem(), config)
    if "intrinsics" in solution.estimate.extras:
        solution = _with_found_intrinsics(solution)
    return judged(samples, solution, algorithm=name, limits=limits, session=session, created=created, stored=stored)


def _with_found_intrinsics(solution: Solution) -> Solution:
    """The same answer with the intrinsics that were found in place of those that were stated."""
    estimate, problem = solution.estimate, solution.problem
    if estimate.intrinsics is None:
        return solution
    found = [
        replace(stated, fx=stated.fx + float(d[0]), fy=stated.fy + float(d[1]), cx=stated.cx + float(d[2]),
                cy=stated.cy + float(d[3]))
        for stated, d in zip(problem.intrinsics, estimate.intrinsics, strict=True)
    ]  # fmt: skip
    settled = replace(estimate, intrinsics=np.zeros_like(estimate.intrinsics))
    return replace(solution, problem=problem.with_intrinsics(found), estimate=settled)


def judged(
    samples: SampleSet,
    solution: Solution,
    *,
    algorithm: str = REFINED,
    limits: Limits | None = None,
    session: str = "",
    created: str = "",
    stored: StoredCalibration | None = None,
) -> Result:
    """Judge a solution of a session, and make what is to be stored; arguments and errors as for `calibrate`."""
    problem = solution.problem
    before = None if stored is None else stored.T_parent_link @ T_LINK_OPTICAL
    verdict = assess(problem, solution, limits, before)
    X = solution.estimate.X[0]
    sigma_t, sigma_r = solution.sigma()
    if algorithm != REFINED:
        part = problem.subset(solution.used)
        require_motion(part)
        refined, X = X, closed_form(algorithm, samples.head.setup, part.A, part.free).X
        # its own error is not known; the distance from the refinement is the better part of it
        offset, angle = mount_error(X, refined)
        sigma_t, sigma_r = float(np.hypot(sigma_t, offset)), float(np.hypot(sigma_r, angle))
    calibration = StoredCalibration.of_mount(
        samples.head.camera, samples.head.parent, X @ se3.inverse(T_LINK_OPTICAL),
        sigma_translation=sigma_t, sigma_rotation=sigma_r, mount_seed=samples.head.mount_seed, method=algorithm,
        board=samples.board.label, samples=int(np.count_nonzero(solution.used)), session=session, created=created,
        versions=versions(),
    )  # fmt: skip
    return Result(solution, verdict, side_by_side(problem, solution), calibration)


def without_named(samples: SampleSet, names: Sequence[str]) -> None:
    """Remove samples by name.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the names there are.
    """
    for name in names:
        if not name:
            raise OpenArmError(Code.INVALID_ARGUMENT, "an empty name is no sample; give names such as s001")
        samples.remove(name)


def versions() -> dict[str, str]:
    """Of what computed the result."""
    out = {"opencv": cv2.__version__, "numpy": np.__version__}
    try:
        out["openarm-vision"] = version("openarm-vision")
    except PackageNotFoundError:
        out["openarm-vision"] = "checkout"
    return out
