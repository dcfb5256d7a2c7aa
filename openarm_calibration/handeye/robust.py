# SPDX-License-Identifier: Apache-2.0
"""From views to mounts: start, outliers, refinement, refusals.

The order: refuse motions that determine nothing; a quick closed form; the refinement; a test of each robot pose
against what the others predict for it. Where a pose fails, or the start is spoiled, small random subsets vote for a
clean one, and poses are taken out and let in again until the set does not change. Several wrong poses of a few hide in
the spread that they make; where that is large, they are left out if two kinds of poses are likelier than one.

One linear step takes a pose out: with `h` its share of the information and `g` its share of the right-hand side, the
answer without it moves by `-(H - h)⁻¹ g`. The prediction for the pose then has the spread of its own noise plus that
of the answer without it. m, rad, px.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from pydantic import Field
from scipy import stats

from openarm_calibration.handeye.closed_form import closed_form
from openarm_calibration.handeye.observability import FEWEST, condition_number, require_accuracy, require_motion
from openarm_calibration.handeye.problem import Extra, Problem, chain, design
from openarm_calibration.handeye.refine import linearise, mark_evidence, pixel_noise, refine
from openarm_calibration.handeye.spread import criterion, search
from openarm_calibration.handeye.unknowns import (
    FREE,
    Estimate,
    Noise,
    Outlier,
    PoseTest,
    Priors,
    Solution,
    Unknowns,
    at_zeros,
)
from openarm_common import se3
from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array, Mask

#: Eigenvalues of scaled information below this are a direction that is not known at all.
_UNKNOWN = 1e-10


def pose_tests(problem: Problem, used: Mask, estimate: Estimate, limit: float, usable: Mask) -> tuple[PoseTest, ...]:
    """Test every robot pose of a problem; views that are not used are tested against all that are.

    Args:
        problem: All views.
        used: (n,) which views the estimate rests on.
        estimate: Estimate from those views.
        limit: Largest distance that is usual.
        usable: (n,) views whose marks lie on a board; the others are not tested, their distance is infinite.

    Returns:
        By number of the pose, as `problem.pose` counts.
    """
    problem = at_zeros(problem, estimate)
    T, B = chain(problem, estimate.X, estimate.Z)
    squares, _, _ = problem.equations(problem.free, estimate.optics, estimate.scale)
    M = squares[:, :6, :6] * estimate.noise.view_px**-2.0
    G, K = design(problem, estimate.X, estimate.Z, T, B, estimate.extras)
    extra = 6 * (problem.cameras + problem.boards)
    # extras act in addition to the twist; their effect on it is what a view's own fit would make of them
    G6 = G[:, :6].copy()
    M[~usable] = np.eye(6)
    if estimate.extras:
        through = np.linalg.solve(M, squares[:, :6, 6:] * estimate.noise.view_px**-2.0)
        G6[:, :, extra:] += through @ G[:, 6:, extra:]
    y = np.array([_twist(T[i], problem.free[i]) for i in range(len(problem))])
    robot = np.linalg.inv(estimate.noise.prior)
    H = estimate.information
    scale = np.sqrt(np.maximum(np.diag(H), 1e-30))
    out: list[PoseTest] = []
    for pose in range(int(problem.pose.max()) + 1):
        rows = np.flatnonzero(problem.pose == pose)
        k = len(rows)
        if not usable[rows].all():
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
    """Return the camera-frame twist (6,) from one pose of the board to another, to first order in the translation."""
    w = se3.log_so3(T_to[:3, :3] @ T_from[:3, :3].T)
    half = T_from[:3, 3] + (T_to[:3, 3] - T_from[:3, 3]) / 2.0
    return np.concatenate([T_to[:3, 3] - T_from[:3, 3] - np.cross(w, half), w])


#: A robot with such a spread from pose to pose may hide wrong poses, m and rad.
GOOD_ARM = (1e-3, math.radians(0.1))
#: Spread of wrong poses to start from, m and rad.
_LOOSE = (0.02, 0.05)
#: Drop of minus twice the log likelihood from which there are wrong poses.
_EVIDENT = 10.0
#: With fewer poses it can't be determined which one is wrong; a clean set would lose poses by chance.
_FEWEST_TO_REJECT = 7


class SolveConfig(Config):
    """How a calibration is solved."""

    px: float | None = Field(default=None, gt=0.0, description="spread of a mark, px; None: estimated")
    robot_translation: float | None = Field(
        default=None, ge=0.0, description="of the robot's position, m; None: estimated"
    )
    robot_rotation: float | None = Field(
        default=None, ge=0.0, description="of the robot's rotation, rad; None: estimated"
    )
    misfit: bool = Field(
        default=True, description="estimate what the marks of a view have in common; not with a given robot"
    )
    extras: tuple[Extra, ...] = Field(
        default=(), description="more unknowns: scale, delay, intrinsics, distortion, zeros"
    )
    reject_outliers: bool = Field(default=True, description="leave poses out that the others contradict")
    false_alarm: float = Field(default=1e-3, gt=0.0, lt=0.5, description="chance that a clean set loses a pose")
    most_translation: float = Field(default=0.003, gt=0.0, description="largest predicted error that is an answer, m")
    most_rotation: float = Field(default=math.radians(0.5), gt=0.0, description="the same of the rotation, rad")
    seed: int = Field(default=0, ge=0, description="of the subsets that vote")


def solve_robustly(
    problem: Problem, config: SolveConfig | None = None, priors: Priors = FREE, start: Solution | None = None
) -> Solution:
    """Solve for all mounts of a problem, or refuse it; `solve.solve` also says what is wrong with the input.

    Args:
        problem: Problem with at least three robot poses that differ in rotation about two axes.
        config: Settings of the solver.
        priors: Priors of the extras.
        start: A solution of nearly the same problem, to start from; None: a closed form.

    Raises:
        OpenArmError: DEGENERATE, when the views do not determine the mounts to the accuracy asked for;
            INVALID_ARGUMENT, for numbers that are not finite.
    """
    config = config or SolveConfig()
    require_motion(problem)
    px = config.px or pixel_noise(problem)
    usable, blurred = _sharp(problem, px)
    try:
        used, estimate, tests = _robust(problem, usable, px, config, priors, None if start is None else start.estimate)
    except np.linalg.LinAlgError as error:
        raise OpenArmError(Code.DEGENERATE, f"the {len(problem)} views leave an unknown free; add poses") from error
    require_motion(problem.subset(used))
    require_accuracy(problem.subset(used), estimate, config.most_translation, config.most_rotation)
    contradicted = [
        Outlier(problem.views[i].name or str(i), int(i), _reason(tests[int(problem.pose[i])]))
        for i in np.flatnonzero(usable & ~used)
    ]
    outliers = tuple(sorted((*blurred, *contradicted), key=lambda outlier: outlier.index))
    return Solution(problem, used, estimate, outliers, tests, condition_number(problem, estimate.information))


def _sharp(problem: Problem, px: float) -> tuple[Mask, list[Outlier]]:
    """Return views whose marks fit a board by themselves."""
    freedom = np.maximum(2.0 * problem.marks - 6.0, 1.0)
    rms = np.sqrt(problem.free_cost / freedom)
    usable = np.isfinite(rms) & (rms < 4.0 * max(px, float(np.median(rms))) + 0.05)
    bad = [
        Outlier(
            problem.views[i].name or str(i), int(i),
            f"its marks do not lie on the board: {rms[i]:.2f} px, the usual is {float(np.median(rms)):.2f} px",
        )
        for i in np.flatnonzero(~usable)
    ]  # fmt: skip
    return usable, bad


def _reason(test: PoseTest) -> str:
    return (
        f"the other samples contradict it by {test.translation * 1e3:.1f} mm and {math.degrees(test.rotation):.2f}°"
        f" (distance {test.distance:.1f}, expected below {test.limit:.1f}):"
        " a wrong robot pose, a moved board or a late stamp"
    )


def _robust(
    problem: Problem, usable: Mask, px: float, config: SolveConfig, priors: Priors, start: Estimate | None
) -> tuple[Mask, Estimate, tuple[PoseTest, ...]]:
    used = usable.copy()
    estimate = _refine(problem, used, px, config, priors, start)
    limit = _limit(problem, used, config)
    tests = pose_tests(problem, used, estimate, limit, usable)
    if not config.reject_outliers or _poses(problem, used) < _FEWEST_TO_REJECT:
        return used, estimate, tests
    suspect = any(tests[p].distance > limit for p in problem.pose[usable]) or _spoiled(problem, used, estimate)
    noise = estimate.noise
    hidden = estimate.spread is not None and (noise.translation > GOOD_ARM[0] or noise.rotation > GOOD_ARM[1])
    if not suspect and not hidden:
        return used, estimate, tests
    whole = used, estimate, tests
    used = _consensus(at_zeros(problem, estimate), usable, config)
    start = None
    seen: set[bytes] = set()
    for _ in range(8):
        estimate = _refine(problem, used, px, config, priors, start)
        tests = pose_tests(problem, used, estimate, _limit(problem, used, config), usable)
        passing = np.array([tests[p].distance <= tests[p].limit for p in problem.pose])
        wanted = usable & passing
        if np.array_equal(wanted, used) or wanted.tobytes() in seen or _poses(problem, wanted) < FEWEST:
            break
        seen.add(wanted.tobytes())
        used, start = wanted, estimate
    if not suspect and not _two_kinds(problem, usable & ~used, estimate) < whole[1].evidence - _EVIDENT:
        return whole
    return used, estimate, tests


def _two_kinds(problem: Problem, out: Mask, estimate: Estimate) -> float:
    """Return minus twice the log marginal likelihood of all views when some poses have a spread of their own.

    Comparable to the evidence of an answer that all poses have a part in; any share of them is as likely.

    Args:
        problem: All views.
        out: (n,) views that the answer does not rest on.
        estimate: The answer by the others.
    """
    if not out.any():
        return math.inf
    part = at_zeros(problem, estimate).subset(out)
    state, noise = Unknowns.start(part, estimate.X, estimate.Z), estimate.noise
    state = replace(state, intrinsics=estimate.intrinsics, scale=estimate.scale, distortion=estimate.distortion)
    value = math.inf
    for _ in range(5):
        full, KMK, both = linearise(part, state, ()).weighed(noise)
        given = np.ascontiguousarray(full[-1:, -1:]), KMK, np.ascontiguousarray(both[:, :, -1:])
        translation, rotation = search(*given, *_LOOSE, True)
        value = criterion(*given, translation, rotation)
        prior = replace(noise, translation=translation, rotation=rotation).prior
        state = replace(state, correction=np.linalg.solve(KMK + prior, given[2])[:, :, 0])
    poses, wrong = int(problem.pose.max()) + 1, len(np.unique(part.pose))
    ways = 2.0 * math.log((poses + 1) * math.comb(poses, wrong))
    return estimate.evidence + value + mark_evidence(part, noise) + ways


def _refine(
    problem: Problem, used: Mask, px: float, config: SolveConfig, priors: Priors, start: Estimate | None
) -> Estimate:
    part = problem.subset(used)
    zeros = None if start is None else start.zeros
    given = config.robot_translation is not None and config.robot_rotation is not None
    noise = Noise(px, config.robot_translation or 0.0, config.robot_rotation or 0.0) if given else Noise(px, 1e-4, 1e-4)
    X, Z = (start.X, start.Z) if start is not None else starting_mounts(part)
    return refine(
        part, X, Z, noise, zeros=zeros, extras=config.extras, priors=priors, estimate_robot=not given,
        estimate_px=config.px is None and bool({"intrinsics", "distortion", "scale"} & set(config.extras)),
        estimate_misfit=config.misfit,
    )  # fmt: skip


def _limit(problem: Problem, used: Mask, config: SolveConfig) -> float:
    """Return the largest squared distance by number that a clean pose of this set has."""
    poses = _poses(problem, used)
    chance = 1.0 - config.false_alarm / max(poses, 1)
    if config.robot_translation is not None and config.robot_rotation is not None:
        return float(stats.chi2.ppf(chance, 6)) / 6.0
    # the spread itself was estimated from so many numbers
    return float(stats.f.ppf(chance, 6, max(6 * poses - 18, 4)))


def _poses(problem: Problem, used: Mask) -> int:
    return len(np.unique(problem.pose[used]))


def _spoiled(problem: Problem, used: Mask, estimate: Estimate) -> bool:
    """Return whether a few views carry most of the residual that the robot's estimated spread explains away."""
    rms = _reprojection(at_zeros(problem, estimate), estimate.X, estimate.Z)[used]
    return bool(rms.max() > 4.0 * np.median(rms) and rms.max() > 3.0 * estimate.noise.px)


def _reprojection(problem: Problem, X: Array, Z: Array) -> Array:
    """Return (n,) rms of each view without corrections, px."""
    T, _ = chain(problem, X, Z)
    _, _, cost = problem.equations(T)
    return np.sqrt(cost / (2.0 * problem.marks))


def starting_mounts(problem: Problem) -> tuple[Array, Array]:
    """Return the closed-form mounts of all cameras and boards, (cameras, 4, 4) and (boards, 4, 4).

    Raises:
        OpenArmError: DEGENERATE, when a camera or board is tied to nothing, or the closed form has no answer.
    """
    X: dict[int, Array] = {}
    Z: dict[int, Array] = {}
    pairs, counts = np.unique(
        np.stack([problem.camera, problem.board], axis=1)[problem.kind < 2], axis=0, return_counts=True
    )
    for camera, board in pairs[np.argsort(-counts)]:
        if camera in X and board in Z:
            continue
        part = problem.subset((problem.camera == camera) & (problem.board == board) & (problem.kind < 2))
        mounts = closed_form("SHAH", part.views[0].setup, part.A, part.free)
        X.setdefault(int(camera), mounts.X)
        Z.setdefault(int(board), mounts.Z)
    for _ in range(problem.cameras + problem.boards):  # fixed views hand a mount on
        for i in np.flatnonzero(problem.kind == 2):
            camera, board = int(problem.camera[i]), int(problem.board[i])
            if camera in X and board not in Z:
                Z[board] = X[camera] @ problem.free[i]
            elif board in Z and camera not in X:
                X[camera] = Z[board] @ se3.inverse(problem.free[i])
    missing = [f"camera {k}" for k in range(problem.cameras) if k not in X]
    missing += [f"board {k}" for k in range(problem.boards) if k not in Z]
    if missing:
        raise OpenArmError(Code.DEGENERATE, f"too few poses: no view ties {', '.join(missing)} to the robot")
    return np.array([X[k] for k in range(problem.cameras)]), np.array([Z[k] for k in range(problem.boards)])


def _consensus(problem: Problem, usable: Mask, config: SolveConfig) -> Mask:
    """Return views that agree with the best of many small subsets, for each camera and board."""
    rng = np.random.default_rng(config.seed)
    keep = usable.copy()
    moving = usable & (problem.kind < 2)
    for camera, board in np.unique(np.stack([problem.camera, problem.board], axis=1)[moving], axis=0):
        mine = np.flatnonzero(moving & (problem.camera == camera) & (problem.board == board))
        if len(mine) <= FEWEST + 1:
            continue
        part = problem.subset(mine)
        best, agreement = math.inf, np.zeros(len(mine))
        for _ in range(80):
            picked = rng.choice(len(mine), size=4 if len(mine) > 6 else 3, replace=False)
            try:
                mounts = closed_form("SHAH", part.views[0].setup, part.A[picked], part.free[picked])
            except OpenArmError:
                continue  # a subset may be degenerate; another one is drawn
            X = np.broadcast_to(mounts.X, (problem.cameras, 4, 4))
            Z = np.broadcast_to(mounts.Z, (part.boards, 4, 4))
            rms = np.where(np.isfinite(r := _reprojection(part, X, Z)), r, 1e6)
            score = float(np.quantile(rms, 0.7))
            if score < best:
                best, agreement = score, rms
        inside = agreement <= 2.5 * best
        if inside.sum() >= FEWEST:
            keep[mine] = inside
    return keep
