# SPDX-License-Identifier: Apache-2.0
"""Errors of poses that an answer did not see: of the refinement, and of the closed forms.

The refinement is started from the answer of all poses and keeps its noise. A closed form is solved without each pose in
turn, where its answer for all is not already worse than the refinement's predictions. px in the image, m at the board.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from openarm_calibration.handeye.closed_form import METHODS, closed_form
from openarm_calibration.handeye.marks import project
from openarm_calibration.handeye.problem import Problem, chain, residuals
from openarm_calibration.handeye.refine import mount_error, refine
from openarm_calibration.handeye.unknowns import Solution, at_zeros
from openarm_common import se3
from openarm_common.errors import OpenArmError
from openarm_common.types import Array

#: Below so many standard deviations of a mark nothing can predict much better.
_AT_NOISE = 2.0
#: Standard errors by which a closed form must be better, view by view.
_BETTER = 2.0


@dataclass(frozen=True)
class HeldOut:
    """Error of poses that the answer did not see.

    Args:
        px: Rms distance in the image.
        metres: The same at the board's distance.
        by_name: Both by view.
        marks: Mean squared distance of the marks in space, against the view's own pose of the board, by view, m².
        twists: (views, 6) see `board_twists`.
        columns: (3,) rms errors by column, see `column_squares`.
    """

    px: float
    metres: float
    by_name: dict[str, tuple[float, float]]
    marks: dict[str, float] = field(default_factory=dict)
    twists: Array = field(default_factory=lambda: np.zeros((0, 6)))
    columns: Array = field(default_factory=lambda: np.full(3, math.nan))


@dataclass(frozen=True)
class Rival:
    """A closed form that predicts left-out views better than the refinement.

    Args:
        method: Its name.
        metres: Rms distance of the marks in space.
        refined: The same of the refinement.
    """

    method: str
    metres: float
    refined: float

    @property
    def sentence(self) -> str:
        """What it means."""
        return (
            f"{self.method} predicts left-out poses better than the refinement ({self.metres * 1e3:.1f} against"
            f" {self.refined * 1e3:.1f} mm), so its answer is used; find out what is wrong with the samples"
        )


def held_out(problem: Problem, solution: Solution, folds: int) -> HeldOut:
    """Leave poses out in turn (`folds` groups; as many as poses is leave-one-out) and predict them.

    Poses whose absence leaves too few to solve are not counted.

    Args:
        problem: All views.
        solution: Solution of them.
        folds: Number of groups.
    """
    used = np.flatnonzero(solution.used)
    poses = np.unique(problem.pose[used])
    folds = max(2, min(folds, len(poses)))
    squares: dict[str, tuple[float, float]] = {}
    marks: dict[str, float] = {}
    twists: list[Array] = []
    for fold in range(folds):
        out = np.isin(problem.pose[used], poses[fold::folds])
        if len(np.unique(problem.pose[used[~out]])) < 3:
            continue
        estimate = refine(
            problem.subset(used[~out]), solution.estimate.X, solution.estimate.Z, solution.estimate.noise,
            extras=solution.estimate.extras,
        )  # fmt: skip
        left = at_zeros(problem.subset(used[out]), estimate)
        T, _ = chain(left, estimate.X, estimate.Z)
        rows = left.camera_rows(estimate.optics)
        in_space = in_space_squares(left, T)
        twists.append(board_twists(left, T))
        for k, view in enumerate(left.views):
            away = project(view.points, view.radius, T[k], rows[k]) - view.pixels
            px = float(np.mean(np.sum(away**2, axis=1)))
            name = view.name or str(used[out][k])
            squares[name] = px, px * float(T[k, 2, 3] / rows[k, 0]) ** 2
            marks[name] = float(in_space[k])
    if not squares:
        return HeldOut(math.nan, math.nan, {})
    px2, m2 = np.mean(list(squares.values()), axis=0)
    by_name = {name: (math.sqrt(a), math.sqrt(b)) for name, (a, b) in squares.items()}
    errors = np.concatenate(twists)
    columns = np.sqrt([px2, np.mean(np.sum(errors[:, :3] ** 2, axis=1)), np.mean(np.sum(errors[:, 3:] ** 2, axis=1))])
    return HeldOut(math.sqrt(px2), math.sqrt(m2), by_name, marks, errors, columns)


def board_twists(problem: Problem, T: Array) -> Array:
    """Return (n, 6) errors of poses T (n, 4, 4): of the board's centre, m, and rotation vector, rad; optical axes.

    Args:
        problem: The views, whose own poses of the board the errors are against.
        T: Predicted T_camera_board.
    """
    out = np.zeros((len(problem), 6))
    for k, view in enumerate(problem.views):
        centre, own = np.append(view.points.mean(axis=0), 1.0), problem.free[k]
        out[k, :3] = ((T[k] - own) @ centre)[:3]
        out[k, 3:] = se3.log_so3(T[k, :3, :3] @ own[:3, :3].T)
    return out


def column_squares(problem: Problem, T: Array) -> Array:
    """Return (n, 3) squared errors of poses T (n, 4, 4): marks in the image, px; board's centre, m; angle, rad.

    Args:
        problem: The views; the last two are against their own poses of the board.
        T: Predicted T_camera_board.
    """
    twists, rows = board_twists(problem, T), problem.camera_rows()
    px = [
        np.mean(np.sum((project(view.points, view.radius, T[k], rows[k]) - view.pixels) ** 2, axis=1))
        for k, view in enumerate(problem.views)
    ]
    return np.stack([px, np.sum(twists[:, :3] ** 2, axis=1), np.sum(twists[:, 3:] ** 2, axis=1)], axis=1)


def closed_columns(problem: Problem, method: str) -> Array:
    """Return the rms errors (3,) of poses that a closed form did not see: px, m, rad; NaN where it has no answer.

    Args:
        problem: Problem with one camera and one board.
        method: Name of the closed form.
    """
    squares: list[Array] = []
    for pose in np.unique(problem.pose):
        left, known = problem.subset(problem.pose == pose), problem.subset(problem.pose != pose)
        try:
            mounts = closed_form(method, known.views[0].setup, known.A, known.free)
        except OpenArmError:
            return np.full(3, math.nan)
        T, _ = chain(left, mounts.X[None], mounts.Z[None])
        squares.append(column_squares(left, T))
    return np.sqrt(np.concatenate(squares).mean(axis=0))


def in_space_squares(problem: Problem, T: Array) -> Array:
    """Return (n,) mean squared distances of the marks at poses T (n, 4, 4) from those at each view's own pose, m²."""
    out = np.zeros(len(problem))
    for k, view in enumerate(problem.views):
        away = view.points @ (T[k, :3, :3] - problem.free[k, :3, :3]).T + T[k, :3, 3] - problem.free[k, :3, 3]
        out[k] = np.mean(np.sum(away**2, axis=1))
    return out


def rival(problem: Problem, solution: Solution, one_out: HeldOut) -> Rival | None:
    """Return the closed form that predicts left-out poses better than the refinement; None where there is none.

    Args:
        problem: All views.
        solution: Solution of them; of one camera and one board.
        one_out: Its errors, each pose left out.
    """
    part = problem.subset(solution.used)
    single = part.cameras == 1 and part.boards == 1 and bool((part.kind < 2).all())
    if not single or not one_out.marks or one_out.px < _AT_NOISE * math.sqrt(2.0) * solution.estimate.noise.px:
        return None
    numbers = np.flatnonzero(solution.used)
    names = [view.name or str(number) for view, number in zip(part.views, numbers, strict=True)]
    if any(name not in one_out.marks for name in names):
        return None
    ours = np.array([one_out.marks[name] for name in names])
    best: Rival | None = None
    for method in METHODS:
        if not np.mean(_closed_squares(part, method, part)) < np.mean(ours):
            continue  # as an answer for all poses it is worse already
        theirs = np.array(
            [_closed_squares(part.subset(part.pose != pose), method, part.subset(part.pose == pose)).mean()
             for pose in part.pose]
        )  # fmt: skip
        gain = ours - theirs
        error = float(np.std(gain, ddof=1)) / math.sqrt(len(gain))
        reached = math.sqrt(float(np.mean(theirs)))
        if np.isfinite(reached) and gain.mean() > _BETTER * error and (best is None or reached < best.metres):
            best = Rival(method, reached, math.sqrt(float(np.mean(ours))))
    return best


def _closed_squares(known: Problem, method: str, asked: Problem) -> Array:
    try:
        mounts = closed_form(method, known.views[0].setup, known.A, known.free)
    except OpenArmError:
        return np.full(len(asked), np.inf)
    return in_space_squares(asked, chain(asked, mounts.X[None], mounts.Z[None])[0])


def side_by_side(problem: Problem, solution: Solution) -> dict[str, dict[str, float] | str]:
    """Compare every closed form with the refinement: distance from it (m, rad) and rms reprojection (px)."""
    part = problem.subset(solution.used)
    out: dict[str, dict[str, float] | str] = {}
    for method in METHODS:
        try:
            mounts = closed_form(method, part.views[0].setup, part.A, part.free)
        except OpenArmError as error:
            out[method] = error.message
            continue
        offset, angle = mount_error(mounts.X, solution.estimate.X[0])
        px = reprojection_rms(part, mounts.X[None], mounts.Z[None])
        out[method] = {"translation": offset, "rotation": angle, "px": px}
    px = reprojection_rms(part, solution.estimate.X, solution.estimate.Z)
    out["REFINED"] = {"translation": 0.0, "rotation": 0.0, "px": px}
    return out


def reprojection_rms(problem: Problem, X: Array, Z: Array) -> float:
    """Return the rms distance of the marks from where the mounts have them, px by axis.

    Args:
        problem: The views.
        X: (cameras, 4, 4).
        Z: (boards, 4, 4).
    """
    return float(np.sqrt(np.mean(np.concatenate(residuals(problem, X, Z)) ** 2)))
