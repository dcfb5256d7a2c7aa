# SPDX-License-Identifier: Apache-2.0
"""Several cameras in one solve, which share what they share.

Sessions of different cameras have in common the spread of the robot's errors, the error itself where the arm stood in
the same posture, and the mount of the board where both carry out the same set-up with the same one. m and rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from openarm_calibration.handeye.observability import condition_number
from openarm_calibration.handeye.offline import Result, judged
from openarm_calibration.handeye.problem import Problem, View, assemble
from openarm_calibration.handeye.refine import Estimate, invert_scaled
from openarm_calibration.handeye.solve import Outlier, Solution, SolveConfig, solve
from openarm_calibration.handeye.verdict import Limits
from openarm_calibration.sampling.samples import SampleSet
from openarm_calibration.store.store import StoredCalibration
from openarm_common.errors import Code, OpenArmError

#: Postures within this of each other have the same error of the robot, rad or m.
_SAME_POSTURE = 1e-3


def join(sessions: Sequence[SampleSet], *, one_board: bool = True) -> tuple[Problem, tuple[Problem, ...]]:
    """The problem of all sessions, and those of each.

    Args:
        sessions: Of different cameras.
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
    views: list[View] = []
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
    """What the arm's pose is measured from, and the link that moves."""
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
        config: Of the solver; without extras.
        limits: Of the verdicts.
        hashes: Of the sessions, for the record; none, or one for each.
        created: When, as ISO 8601, for the record.
        stored: The calibrations in use until now, for the drift; none, or one for each.
        one_board: See `join`.

    Returns:
        In the order of the sessions.

    Raises:
        OpenArmError: As `join`; DEGENERATE, with cause and advice; INVALID_ARGUMENT, for extras.
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
    parts = [_part(solution, camera, problem) for camera, problem in enumerate(own)]
    return tuple(
        judged(samples, part, limits=limits, session=digest, created=created, stored=before)
        for samples, part, digest, before in zip(sessions, parts, hashes, stored, strict=True)
    )


def _part(joint: Solution, camera: int, own: Problem) -> Solution:
    """What the solution of all says of one camera and its board."""
    problem, estimate = joint.problem, joint.estimate
    rows = np.flatnonzero(problem.camera == camera)
    board = int(problem.board[rows[0]])
    first = 6 * camera, 6 * (problem.cameras + board)
    columns = np.concatenate([np.arange(start, start + 6) for start in first])
    covariance = estimate.covariance()[np.ix_(columns, columns)]
    information = invert_scaled(covariance)
    # corrections are numbered among the poses that were used
    numbers = np.unique(problem.pose[joint.used])
    mine = np.unique(problem.pose[rows][joint.used[rows]])
    part = Estimate(
        estimate.X[camera : camera + 1], estimate.Z[board : board + 1],
        estimate.correction[np.searchsorted(numbers, mine)], estimate.noise, information, estimate.cost,
        estimate.converged, spread=None if estimate.spread is None else covariance,
    )  # fmt: skip
    places = {int(row): k for k, row in enumerate(rows)}
    outliers = tuple(
        Outlier(own.views[places[o.index]].name, places[o.index], o.reason) for o in joint.outliers if o.index in places
    )
    tests = [joint.tests[0]] * (int(own.pose.max()) + 1)
    for k, row in enumerate(rows):
        tests[int(own.pose[k])] = joint.tests[int(problem.pose[row])]
    return Solution(own, joint.used[rows], part, outliers, tuple(tests), condition_number(own, information))
