# SPDX-License-Identifier: Apache-2.0
"""From sets of samples to calibrations with their verdicts: shared by the node and the command line.

Sessions of several cameras that are solved together have in common the spread of the robot's errors, the error itself
where the arm had the same posture, and the mount of the board where both use the same one in the same set-up. m, rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from openarm_calibration.handeye.accuracy import Accuracy, accuracy_of
from openarm_calibration.handeye.choice import solve_chosen
from openarm_calibration.handeye.closed_form import REFINED, checked_algorithm, closed_form
from openarm_calibration.handeye.left_out import side_by_side
from openarm_calibration.handeye.observability import condition_number, require_motion
from openarm_calibration.handeye.problem import BoardView, Problem, assemble, layout
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.solve import SolveConfig, solve
from openarm_calibration.handeye.unknowns import Estimate, Outlier, Solution, invert_scaled
from openarm_calibration.handeye.verdict import Grading, Limits, assess
from openarm_calibration.sampling.samples import SampleSet
from openarm_calibration.store.store import StoredCalibration, versions
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL, Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.zeros import zeros_label
from openarm_common.types import Mask

#: Postures within this of each other have the same error of the robot, rad or m.
_SAME_POSTURE = 1e-3


@dataclass(frozen=True, eq=False)
class Result:
    """A solved session.

    Args:
        solution: The refinement, also where a closed form was asked for: the verdict rests on it.
        verdict: Grade and figures.
        methods: Every method compared with the refinement.
        calibration: Calibration to store: that of the method that was asked for.
    """

    solution: Solution
    verdict: Grading
    methods: dict[str, dict[str, float] | str]
    calibration: StoredCalibration

    def as_json(self) -> dict[str, Any]:
        """Return the result for `--json`, services and reports."""
        return {
            "grade": self.verdict.grade,
            "reasons": list(self.verdict.reasons),
            "checks": {check.name: check.ratio for check in self.verdict.checks},
            "figures": self.verdict.figures,
            "methods": self.methods,
            "intrinsics": asdict(self.solution.problem.intrinsics[0]),
            "calibration": self.calibration.model_dump(mode="json"),
        }


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
        samples: Samples with at least three poses that differ in rotation about two axes.
        algorithm: Algorithm of the stored mount; the refinement unless a comparison wants otherwise.
        config: Parameters of the solver.
        limits: Limits of the verdict.
        session: Hash of the session, for the record.
        created: When, as ISO 8601, for the record.
        stored: The calibration in use until now, for the drift.

    Raises:
        OpenArmError: DEGENERATE, with cause and advice; INVALID_ARGUMENT, for an unknown algorithm.
    """
    name = checked_algorithm(algorithm)
    solution = solve_chosen(samples.problem(), config)
    if "intrinsics" in solution.estimate.extras:
        solution = _with_found_intrinsics(solution)
    return judged(samples, solution, algorithm=name, limits=limits, session=session, created=created, stored=stored)


def _with_found_intrinsics(solution: Solution) -> Solution:
    """Return the same answer with the intrinsics that were found in place of those that were stated."""
    estimate, problem = solution.estimate, solution.problem
    found = [
        Intrinsics(k.width, k.height, *row)
        for k, row in zip(problem.intrinsics, (problem.intrinsics_rows + estimate.intrinsics).tolist(), strict=True)
    ]
    settled = replace(estimate, intrinsics=np.zeros_like(estimate.intrinsics))
    return replace(solution, problem=assemble(problem.views, found, list(problem.free)), estimate=settled)


def judged(
    samples: SampleSet,
    solution: Solution,
    *,
    algorithm: str = REFINED,
    limits: Limits | None = None,
    session: str = "",
    created: str = "",
    stored: StoredCalibration | None = None,
    accuracy: Accuracy | None = None,
) -> Result:
    """Judge a solution of a session, and make what is to be stored; other arguments and errors as for `calibrate`.

    Args:
        samples: Samples of one camera.
        solution: Solution of them.
        algorithm: See `calibrate`.
        limits: Limits of the verdict.
        session: Hash of the session.
        created: When.
        stored: The calibration in use until now.
        accuracy: Accuracy of the arm, where zeros of the joints were solved for; None: determined by the samples.
    """
    problem = solution.problem
    before = None if stored is None else stored.T_parent_link @ T_LINK_OPTICAL
    unknown: tuple[str, ...] = ()
    if accuracy is None and problem.joints:
        try:
            accuracy = accuracy_of(samples, solution)
        except OpenArmError as error:
            unknown = (f"the accuracy with zeros of the joints that may be off is not known: {error.message}",)
    verdict = assess(problem, solution, limits, before, accuracy)
    if unknown:
        grade = "warn" if verdict.grade == "pass" else verdict.grade
        verdict = replace(verdict, grade=grade, reasons=(*verdict.reasons, *unknown))
    X, figures = solution.estimate.X[0], verdict.figures
    sigma_t, sigma_r = figures["accuracy_translation"], figures["accuracy_rotation"]
    if algorithm == REFINED and verdict.closed_form:
        algorithm = verdict.closed_form
    if algorithm != REFINED:
        part = problem.subset(solution.used)
        require_motion(part)
        refined, X = X, closed_form(algorithm, samples.head.setup, part.A, part.free).X
        # its own error is not known; the distance from the refinement is the better part of it
        offset, angle = mount_error(X, refined)
        sigma_t, sigma_r = float(np.hypot(sigma_t, offset)), float(np.hypot(sigma_r, angle))
    calibration = StoredCalibration.of_mount(
        samples.head.camera, samples.head.parent, X @ se3.inverse(T_LINK_OPTICAL), intrinsics=problem.intrinsics[0],
        sigma_translation=sigma_t, sigma_rotation=sigma_r, mount_seed=samples.head.mount_seed, method=algorithm,
        board=samples.board.label, samples=int(np.count_nonzero(solution.used)), session=session, created=created,
        zeros=zeros_label(samples.description.zeros), versions=versions(),
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


# --- several cameras
def join(sessions: Sequence[SampleSet], *, one_board: bool = True) -> tuple[Problem, tuple[Problem, ...]]:
    """Return the problem of all sessions, and those of each.

    Args:
        sessions: Sessions of different cameras.
        one_board: Whether sessions in which the same link carries the same board found it in the same place.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for no session, or two of the same camera; DEGENERATE, for one without samples.
    """
    names = [samples.head.camera for samples in sessions]
    if not names or len(set(names)) < len(names):
        listed = ", ".join(names) or "none"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"sessions of {listed}; expected one session for each camera")
    own = tuple(samples.problem() for samples in sessions)
    boards: list[object] = []
    postures: list[tuple[tuple[str, str], dict[str, float]]] = []
    views: list[BoardView] = []
    for camera, (samples, problem) in enumerate(zip(sessions, own, strict=True)):
        head = samples.head
        kept = (head.setup, _links(samples)[0 if head.setup == "in_hand" else 1], samples.board)
        place: object = kept if one_board else camera
        if place not in boards:
            boards.append(place)
        for sample, view in zip(samples.samples, problem.views, strict=True):
            pose = _posture(postures, _links(samples), {name: sample.joints[name] for name in samples.joint_names})
            name = f"{head.camera}/{view.name}"
            views.append(replace(view, camera=camera, board=boards.index(place), pose=pose, name=name))
    guesses = np.concatenate([problem.free for problem in own])
    return assemble(views, [problem.intrinsics[0] for problem in own], list(guesses)), own


def _links(samples: SampleSet) -> tuple[str, str]:
    """Return what the arm's pose is measured from, and the link that moves."""
    head = samples.head
    return (head.base, head.parent) if head.setup == "in_hand" else (head.parent, head.carrier)


def _posture(
    known: list[tuple[tuple[str, str], dict[str, float]]], links: tuple[str, str], joints: dict[str, float]
) -> int:
    """Number of a posture, a new one if need be."""
    for number, (other, at) in enumerate(known):
        if other == links and all(abs(at[name] - value) <= _SAME_POSTURE for name, value in joints.items()):
            return number
    known.append((links, joints))
    return len(known) - 1


def calibrate_together(
    sessions: Sequence[SampleSet],
    *,
    config: SolveConfig | None = None,
    limits: Limits | None = None,
    hashes: Sequence[str] = (),
    created: str = "",
    stored: Sequence[StoredCalibration | None] = (),
    one_board: bool = True,
) -> tuple[Result, ...]:
    """Solve sessions of several cameras at once, and judge each camera.

    Args:
        sessions: One for each camera.
        config: Parameters of the solver; without extras.
        limits: Limits of the verdicts.
        hashes: Hashes of the sessions, for the record; none, or one for each.
        created: When, as ISO 8601, for the record.
        stored: The calibrations in use until now, for the drift; none, or one for each.
        one_board: See `join`.

    Returns:
        In the order of the sessions.

    Raises:
        OpenArmError: Same as `join`; DEGENERATE, with cause and advice; INVALID_ARGUMENT, for extras.
    """
    if config is not None and config.extras:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"extras {', '.join(config.extras)} in a solve of several cameras; free them for one camera at a time",
        )
    joint, own = join(sessions, one_board=one_board)
    solution = solve(joint, config)
    hashes = hashes or [""] * len(sessions)
    stored = stored or [None] * len(sessions)
    parts = [part_of(solution, solution.problem.camera == camera, problem) for camera, problem in enumerate(own)]
    return tuple(
        judged(samples, part, limits=limits, session=digest, created=created, stored=before)
        for samples, part, digest, before in zip(sessions, parts, hashes, stored, strict=True)
    )


def part_of(joint: Solution, mine: Mask, own: Problem) -> Solution:
    """Extract the solution of one camera and one board; of zeros of the joints it takes what was found for known.

    Args:
        joint: Joint solution of several cameras or boards.
        mine: (n,) views of that camera and board.
        own: The problem of these views alone.
    """
    problem, estimate = joint.problem, joint.estimate
    rows = np.flatnonzero(mine)
    camera, board = int(problem.camera[rows[0]]), int(problem.board[rows[0]])
    first = 6 * camera, 6 * (problem.cameras + board)
    columns = np.concatenate([np.arange(start, start + 6) for start in first])
    whole = estimate.covariance()
    covariance = whole[np.ix_(columns, columns)]
    if "zeros" in estimate.extras:
        zeros = layout(problem, estimate.extras)["zeros"]
        across = whole[columns, zeros]
        covariance = covariance - across @ np.linalg.solve(whole[zeros, zeros], across.T)
    information = invert_scaled(covariance)
    # corrections are numbered among the poses that were used
    numbers = np.unique(problem.pose[joint.used])
    used = np.unique(problem.pose[rows][joint.used[rows]])
    part = Estimate(
        estimate.X[camera : camera + 1], estimate.Z[board : board + 1],
        estimate.correction[np.searchsorted(numbers, used)], np.zeros((1, 4)), noise=estimate.noise,
        information=information, spread=None if estimate.spread is None else covariance,
    )  # fmt: skip
    places = {int(row): k for k, row in enumerate(rows)}
    outliers = tuple(
        Outlier(own.views[places[o.index]].name, places[o.index], o.reason) for o in joint.outliers if o.index in places
    )
    tests = [joint.tests[0]] * (int(own.pose.max()) + 1)
    for k, row in enumerate(rows):
        tests[int(own.pose[k])] = joint.tests[int(problem.pose[row])]
    return Solution(own, joint.used[rows], part, outliers, tuple(tests), condition_number(own, information))
