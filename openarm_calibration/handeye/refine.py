# SPDX-License-Identifier: Apache-2.0
"""Joint maximum-likelihood refinement over reprojection, with the robot's own errors as unknowns with a prior.

Each robot pose has a correction of six numbers (see `problem`) that costs `|d|²/translation² + |w|²/rotation²`, and is
eliminated from the normal equations by its Schur complement. What remains is Gauss-Newton on the mounts (and extras),
whose information matrix is at once the inverse covariance of the answer. The spread of the robot's errors, when not
given, is that of the largest restricted likelihood: minus twice its logarithm, the criterion, is that of the residuals
with the unknowns integrated out, so that their freedom is not counted as accuracy. m and rad.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from openarm_calibration.handeye.problem import Extra, Problem, chain, design, layout, moved
from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

#: Below these a robot counts as exact: far less than a mark moves by, and the arithmetic stays well conditioned.
FLOOR = 1e-7  # m, rad
#: Chance, before anything is seen, that the robot is exact; the factor within which others are like a typical one.
_EXACT = 0.4
_FACTOR = 3.0
#: How much the logarithm of the likelihood counts: with five poses it is itself a matter of luck, and an answer that
#: believes it fully is now and then far too sure.
_TRUST = 0.7
#: Where the average over spreads is taken: their size against a typical robot's, and translation against rotation.
_LEVELS = np.geomspace(0.015, 30.0, 12)
_BALANCES = np.geomspace(1.0 / 8.0, 8.0, 5)


@njit(cache=True, nogil=True)
def _cholesky(S: Array, L: Array) -> bool:  # pragma: no cover - compiled
    n = len(S)
    for i in range(n):
        for j in range(i + 1):
            total = S[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                L[i, i] = np.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return True


@njit(cache=True, nogil=True)
def criterion(
    full: Array, KMK: Array, both: Array, translation: float, rotation: float
) -> float:  # pragma: no cover - compiled
    """Return minus twice the log restricted likelihood, up to a constant; infinite where it does not exist.

    Args:
        full: (p + 1, p + 1) [[GMG, GMy], [GMyᵀ, yMy]].
        KMK: (poses, 6, 6).
        both: (poses, 6, p + 1) [KMG, KMy].
        translation: Spread, m.
        rotation: Spread, rad.
    """
    size = len(full)
    left = full.copy()
    V = np.empty((6, 6))
    L = np.zeros((6, 6))
    solved = np.empty((6, size))
    t, r = translation**-2.0, rotation**-2.0
    logs = -len(KMK) * 3.0 * (np.log(t) + np.log(r))
    for g in range(len(KMK)):
        for i in range(6):
            for j in range(6):
                V[i, j] = KMK[g, i, j]
            V[i, i] += t if i < 3 else r
        if not _cholesky(V, L):
            return np.inf
        for i in range(6):
            logs += 2.0 * np.log(L[i, i])
            for c in range(size):
                total = both[g, i, c]
                for k in range(i):
                    total -= L[i, k] * solved[k, c]
                solved[i, c] = total / L[i, i]
        for a in range(size):
            for b in range(a + 1):
                total = 0.0
                for k in range(6):
                    total += solved[k, a] * solved[k, b]
                left[a, b] -= total
    # columns of metres, radians and pixels: scaled alike before the factorisation
    scale = np.ones(size)
    for a in range(size - 1):
        scale[a] = 1.0 / np.sqrt(full[a, a]) if full[a, a] > 0.0 else 1.0
    for a in range(size):
        for b in range(a + 1):
            left[a, b] *= scale[a] * scale[b]
    root = np.zeros((size, size))
    if not _cholesky(left, root):
        return np.inf
    for a in range(size - 1):
        logs += 2.0 * np.log(root[a, a])
    return logs + root[size - 1, size - 1] ** 2


@njit(cache=True, nogil=True)
def _search(
    full: Array, KMK: Array, both: Array, start_t: float, start_r: float, whole: bool
) -> tuple[float, float]:  # pragma: no cover - compiled
    best_t, best_r = max(start_t, 1e-7), max(start_r, 1e-7)
    best = criterion(full, KMK, both, best_t, best_r)
    if whole:
        for i in range(8):
            for j in range(8):
                t = 1e-7 if i == 0 else 4e-6 * 4.0 ** (i - 1)
                r = 1e-7 if j == 0 else 8e-6 * 4.0 ** (j - 1)
                value = criterion(full, KMK, both, t, r)
                if value < best:
                    best, best_t, best_r = value, t, r
    span = 2.0 if whole else 1.2
    for _ in range(40):
        if span < 1.01:
            break
        better = False
        around_t, around_r = best_t, best_r
        for i in range(-1, 2):
            for j in range(-1, 2):
                if i == 0 and j == 0:
                    continue
                t = max(around_t * span**i, 1e-7)
                r = max(around_r * span**j, 1e-7)
                value = criterion(full, KMK, both, t, r)
                if value < best:
                    best, best_t, best_r, better = value, t, r, True
        if not better:
            span = span**0.5
    return best_t, best_r


@njit(cache=True, nogil=True)
def _answers(
    full: Array, KMK: Array, both: Array, spreads: Array, values: Array, answers: Array, covariances: Array
) -> None:  # pragma: no cover - compiled
    size = len(full) - 1
    scale = np.empty(size)
    for a in range(size):
        scale[a] = 1.0 / np.sqrt(full[a, a]) if full[a, a] > 0.0 else 1.0
    for k in range(len(spreads)):
        values[k] = criterion(full, KMK, both, spreads[k, 0], spreads[k, 1])
        if not np.isfinite(values[k]):
            continue
        left = full.copy()
        for g in range(len(KMK)):
            V = KMK[g].copy()
            for i in range(6):
                V[i, i] += spreads[k, 0 if i < 3 else 1] ** -2.0
            left -= both[g].T @ np.linalg.solve(V, both[g])
        H = left[:size, :size].copy()
        for a in range(size):
            for b in range(size):
                H[a, b] *= scale[a] * scale[b]
        C = np.linalg.inv(H)
        for a in range(size):
            for b in range(size):
                covariances[k, a, b] = C[a, b] * scale[a] * scale[b]
        answers[k] = covariances[k] @ np.ascontiguousarray(left[:size, size])


_LOWEST_PX = 1e-3
#: Errors of a small arm, m and rad: only the centre of a wide prior.
TYPICAL_ROBOT = (4e-4, 8e-4)
_ITERATIONS = 30


@dataclass(frozen=True)
class Noise:
    """Standard deviations by axis.

    Args:
        px: Of a detected mark, pixels.
        translation: Of the robot's pose, m; 0 is an exact robot.
        rotation: Of the robot's pose, rad.
    """

    px: float
    translation: float = 0.0
    rotation: float = 0.0

    @property
    def prior(self) -> Array:
        """(6, 6) inverse covariance of a correction of A."""
        return np.diag(np.repeat(np.maximum((self.translation, self.rotation), FLOOR), 3) ** -2.0)


@dataclass(frozen=True, eq=False)
class State:
    """The unknowns.

    Args:
        X: (cameras, 4, 4) mounts of the cameras (optical frames).
        Z: (boards, 4, 4) mounts of the boards.
        correction: (poses, 6) of the robot's poses.
        intrinsics: (cameras, 4) changes of fx, fy, cx, cy, px.
        scale: Of the board.
        delay: Of the images, s.
    """

    X: Array
    Z: Array
    correction: Array
    intrinsics: Array
    scale: float = 1.0
    delay: float = 0.0

    @classmethod
    def start(cls, problem: Problem, X: Array, Z: Array) -> State:
        """Return mounts with nothing corrected."""
        return cls(X, Z, np.zeros((int(problem.pose.max()) + 1, 6)), np.zeros((problem.cameras, 4)))


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate(State):
    """Where the refinement ended.

    Args:
        noise: That was used, or found.
        information: (parameters, parameters), columns as `problem.design`.
        extras: Which of the unknowns besides the mounts were free.
        spread: (parameters, parameters) covariance where the robot's spread was estimated.
    """

    noise: Noise
    information: Array
    extras: tuple[Extra, ...] = ()
    spread: Array | None = None

    def covariance(self) -> Array:
        """(parameters, parameters) of the unknowns; with an estimated robot it counts the doubt about its spread too.

        Raises:
            OpenArmError: DEGENERATE, when it does not exist.
        """
        return invert_scaled(self.information) if self.spread is None else self.spread


@dataclass(frozen=True, eq=False)
class Linear:
    """The problem linearised: sums over the robot poses, with the corrections not yet eliminated.

    `y` is the residual of the views with all corrections taken out, seen as a twist; `M` weighs it.
    """

    full: Array  # (p + 1, p + 1) [[GMG, GMy], [GMyᵀ, yMy]]
    KMK: Array  # (poses, 6, 6)
    both: Array  # (poses, 6, p + 1) [KMG, KMy]
    cost: float  # of the views alone, in units of the pixel noise


def linearise(problem: Problem, state: State, px: float, extras: Sequence[Extra]) -> Linear:
    """Return the normal equations at a state.

    Args:
        problem: The views.
        state: The unknowns.
        px: Spread of a mark, px.
        extras: More unknowns.
    """
    correction = state.correction[problem.pose]
    shifted = correction - state.delay * problem.rate if state.delay else correction
    T, B = chain(problem, state.X, state.Z, shifted)
    squares, slopes, costs = problem.equations(T, state.intrinsics, state.scale)
    weight = px**-2.0
    M, b = squares * weight, slopes * weight
    G, K = design(problem, state.X, state.Z, T, B, extras)
    K = np.where((problem.kind == 2)[:, None, None], 0.0, K)
    Mk = M[:, :, :6] @ K
    My = b + (Mk @ correction[:, :, None])[:, :, 0]
    poses = int(problem.pose.max()) + 1
    Kt = K.swapaxes(1, 2)
    KMK, both = np.zeros((poses, 6, 6)), np.zeros((poses, 6, G.shape[2] + 1))
    np.add.at(KMK, problem.pose, Kt @ Mk[:, :6])
    np.add.at(both, problem.pose, np.concatenate([Mk.swapaxes(1, 2) @ G, Kt @ My[:, :6, None]], axis=2))
    GMG = np.einsum("nip,niq->pq", G, M @ G, optimize=False)
    GMy = np.einsum("nip,ni->p", G, My)
    Kd = (K @ correction[:, :, None])[:, :, 0]
    # b = M y - M K d, and |r|² changes by the same quadratic, so yMy follows from the residual at d
    cost = float(costs.sum() * weight)
    yMy = cost + float(np.sum(Kd * (2.0 * b[:, :6] + (M[:, :6, :6] @ Kd[:, :, None])[:, :, 0])))
    full = np.block([[GMG, GMy[:, None]], [GMy[None, :], np.array([[yMy]])]])
    return Linear(full, KMK, both, cost)


def eliminate(linear: Linear, prior: Array) -> tuple[Array, Array, Array]:
    """Return the information (p, p), right-hand side (p,), and (poses, 6, 6) inverse of the corrections' block."""
    V: Array = np.linalg.inv(linear.KMK + prior).astype(np.float64)
    reduced = linear.full - np.einsum("gip,giq->pq", linear.both, V @ linear.both)
    information = reduced[:-1, :-1]
    return (information + information.T) / 2.0, reduced[:-1, -1], V


def averaged(linear: Linear) -> Array:
    """Return the covariance (p, p) about the present answer, averaged over the spreads that the data allow.

    With few poses the spread itself is uncertain, and an answer that takes its best value for true is too sure of
    itself. The weight is the restricted likelihood times a prior: either the robot is exact, as in a simulation, or
    its spread is near that of a typical one, with translation and rotation more or less in proportion.
    """
    level, balance = (grid.ravel() for grid in np.meshgrid(_LEVELS, _BALANCES, indexing="ij"))
    spreads = np.stack(
        [level * np.sqrt(balance) * TYPICAL_ROBOT[0], level / np.sqrt(balance) * TYPICAL_ROBOT[1]], axis=1
    )
    spreads = np.concatenate([[[FLOOR, FLOOR]], spreads])
    near = np.exp(-0.5 * (np.log(level) ** 2 + np.log(balance) ** 2) / math.log(_FACTOR) ** 2)
    prior = np.concatenate([[_EXACT], (1.0 - _EXACT) * near / near.sum()])
    size, count = len(linear.full) - 1, len(spreads)
    values, answers, covariances = np.full(count, np.inf), np.zeros((count, size)), np.zeros((count, size, size))
    _answers(linear.full, linear.KMK, linear.both, spreads, values, answers, covariances)
    weight = prior * np.exp(-0.5 * _TRUST * (values - np.min(values)))
    weight[~np.isfinite(values)] = 0.0
    weight /= weight.sum()
    return np.einsum("k,kpq->pq", weight, covariances) + np.einsum("k,kp,kq->pq", weight, answers, answers)


def refine(
    problem: Problem,
    X: Array,
    Z: Array,
    noise: Noise,
    *,
    extras: Sequence[Extra] = (),
    estimate_robot: bool = False,
    iterations: int = _ITERATIONS,
) -> Estimate:
    """Refine mounts to the maximum of the likelihood.

    Args:
        problem: The views.
        X: (cameras, 4, 4) to start from.
        Z: (boards, 4, 4) to start from.
        noise: Standard deviations; those of the robot are a starting point when they are to be estimated.
        extras: More unknowns: scale, delay, intrinsics.
        estimate_robot: Whether the spread of the robot's errors is found from the data.
        iterations: At most.

    Raises:
        OpenArmError: INTERNAL, when the start is no description of the views (a mark behind the camera).
    """
    state = State.start(problem, X, Z)
    linear = linearise(problem, state, noise.px, extras)
    if not np.isfinite(linear.cost):
        raise OpenArmError(
            Code.INTERNAL, "the refinement starts with a mark behind the camera; the closed form it came from is wrong"
        )
    damping, settled = 0.0, 0
    for count in range(iterations):
        if estimate_robot and count >= 2 and settled < 4:
            spreads = _search(linear.full, linear.KMK, linear.both, noise.translation, noise.rotation, count == 2)
            found = Noise(noise.px, *spreads)
            settled = settled + 1 if _near(found, noise) else 0
            noise = found
        prior = noise.prior
        cost = linear.cost + _prior_cost(state.correction, prior)
        while True:
            information, right, V = eliminate(linear, prior)
            scale = np.sqrt(np.maximum(np.diag(information), 1e-30))
            normed = information / np.outer(scale, scale) + damping * np.eye(len(scale))
            step = np.linalg.lstsq(normed, right / scale, rcond=1e-14)[0] / scale
            correction = (V @ (linear.both @ np.append(-step, 1.0))[:, :, None])[:, :, 0]
            trial = _stepped(problem, state, step, correction, extras)
            ahead = linearise(problem, trial, noise.px, extras)
            reached = ahead.cost + _prior_cost(correction, prior)
            if reached <= cost * (1.0 + 1e-9) + 1e-9 or damping > 1e3:
                break
            damping = max(10.0 * damping, 1e-4)
        if damping > 1e3:
            break
        state, linear = trial, ahead
        damping = damping * 0.1 if damping > 1e-6 else 0.0
        small = float(np.abs(step[: 6 * (problem.cameras + problem.boards)]).max()) < 1e-9
        if (small or cost - reached < 1e-9 * max(reached, 1.0)) and (not estimate_robot or settled >= 1):
            break
    spread = averaged(linear) if estimate_robot else None
    information, _, _ = eliminate(linear, noise.prior)
    return Estimate(**vars(state), noise=noise, information=information, extras=tuple(extras), spread=spread)


def information_at(problem: Problem, X: Array, Z: Array, noise: Noise) -> Array:
    """Information (parameters, parameters) on the mounts at given mounts: its inverse is the Cramér-Rao bound.

    Args:
        problem: The views.
        X: (cameras, 4, 4).
        Z: (boards, 4, 4).
        noise: Standard deviations.
    """
    return eliminate(linearise(problem, State.start(problem, X, Z), noise.px, ()), noise.prior)[0]


def _stepped(problem: Problem, state: State, step: Array, correction: Array, extras: Sequence[Extra]) -> State:
    part = {name: step[columns] for name, columns in layout(problem, extras).items()}
    return replace(
        state,
        X=moved(state.X, part["X"].reshape(-1, 6)),
        Z=moved(state.Z, part["Z"].reshape(-1, 6)),
        correction=correction,
        **{extra: getattr(state, extra) + part[extra].reshape(np.shape(getattr(state, extra))) for extra in extras},
    )


def _prior_cost(correction: Array, prior: Array) -> float:
    return float(np.sum((correction @ prior) * correction))


def _near(a: Noise, b: Noise) -> bool:
    return np.allclose((a.translation, a.rotation), (b.translation, b.rotation), rtol=0.02, atol=10 * FLOOR)


def pixel_noise(problem: Problem) -> float:
    """Return the spread of the marks, px by axis: from fits of each view by itself, so that no robot error enters.

    Views whose own fit is far worse than the usual one are left out.
    """
    freedom = 2.0 * problem.marks - 6.0
    usable = freedom > 0
    if not usable.any():
        return 0.3
    variance = problem.free_cost[usable] / freedom[usable]
    good = variance <= 6.0 * np.median(variance)
    pooled = problem.free_cost[usable][good].sum() / freedom[usable][good].sum()
    return max(float(np.sqrt(pooled)), _LOWEST_PX)


def invert_scaled(information: Array) -> Array:
    """Return the inverse of a symmetric positive matrix whose columns differ in unit.

    Raises:
        OpenArmError: DEGENERATE, when it is singular.
    """
    diagonal = np.diag(information)
    if not (np.isfinite(information).all() and (diagonal > 0.0).all()):
        raise OpenArmError(Code.DEGENERATE, "some unknown is not determined; add poses that differ in rotation")
    scale = np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if values[0] <= 1e-14 * values[-1]:
        raise OpenArmError(Code.DEGENERATE, "the views leave an unknown free; add poses that differ in rotation")
    return (vectors / values) @ vectors.T / np.outer(scale, scale)


def mount_error(T_estimated: Array, T_true: Array) -> tuple[float, float]:
    """Return the distance of the origins, m, and angle, rad, between two mounts."""
    offset = float(np.linalg.norm(T_estimated[:3, 3] - T_true[:3, 3]))
    return offset, se3.angle_between(T_true[:3, :3], T_estimated[:3, :3])
