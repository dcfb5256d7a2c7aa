# SPDX-License-Identifier: Apache-2.0
"""Joint maximum-likelihood refinement over reprojection, with the robot's own errors as unknowns with a prior.

Each robot pose has a correction of six numbers (see `problem`) that costs `|d|²/translation² + |w|²/rotation²`, and is
eliminated from the normal equations by its Schur complement. What remains is Gauss-Newton on the mounts (and extras),
whose information matrix is at once the inverse covariance of the answer.

Residuals of a view have two parts. What no pose of the board takes away is the noise of the marks, and counts with
`px`. What a pose would take away contradicts the other views, and is shared by all marks of the view: bent boards,
lenses and detectors do that as well as robots, so it counts with `px² (1 + misfit²)`. Spreads of robot and misfit, when
not given, are those of the largest restricted likelihood (see `spread`); a misfit only where the data demand one. m
and rad.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from openarm_calibration.handeye.problem import Extra, Problem, chain, design, layout
from openarm_calibration.handeye.spread import FLOOR, averaged, criterion, search, search_misfit
from openarm_calibration.handeye.transforms import moved
from openarm_calibration.handeye.unknowns import FREE, ZERO_SCALES, Estimate, Noise, Priors, Unknowns, values
from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

_LOWEST_PX = 1e-3
_ITERATIONS = 30
#: Drop of minus twice the log likelihood from which a misfit is accepted: one clean set in two hundred has it.
_EVIDENT = 6.6


@dataclass(frozen=True, eq=False)
class Linear:
    """The problem linearised, in px²: sums over the robot poses, with the corrections not yet eliminated.

    `within` is of the part of the residuals that no pose of a board takes away, `twist` of the rest. `y` is the
    residual with all corrections taken out.
    """

    within: Array  # (p + 1, p + 1) [[GMG, GMy], [GMyᵀ, yMy]]
    twist: Array  # (p + 1, p + 1)
    prior: Array  # (p + 1, p + 1), without unit
    KMK: Array  # (poses, 6, 6)
    both: Array  # (poses, 6, p + 1) [KMG, KMy]
    within_cost: Array  # (n,) of each view, px²
    twist_cost: float  # of all views, px²

    def weighed(self, noise: Noise) -> tuple[Array, Array, Array]:
        """Return `full` (p + 1, p + 1), KMK and `both` in units of the noise."""
        twist = noise.view_px**-2.0
        return self.within * noise.px**-2.0 + self.twist * twist + self.prior, self.KMK * twist, self.both * twist

    def cost(self, noise: Noise) -> float:
        """Return the cost of the residuals and of the priors, in units of the noise."""
        return float(
            self.within_cost.sum() * noise.px**-2.0 + self.twist_cost * noise.view_px**-2.0 + self.prior[-1, -1]
        )


def linearise(problem: Problem, state: Unknowns, extras: Sequence[Extra], priors: Priors = FREE) -> Linear:
    """Return the normal equations at a state.

    Args:
        problem: The views.
        state: The unknowns.
        extras: More unknowns.
        priors: Priors of these.
    """
    if "zeros" in extras:
        problem = problem.posed(state.zeros)
    correction = state.correction[problem.pose]
    shift = state.at_poses(problem)
    T, B = chain(problem, state.X, state.Z, correction if shift is None else correction + shift)
    M, b, costs = problem.equations(T, state.optics, state.scale)
    G, K = design(problem, state.X, state.Z, T, B, extras)
    K = np.where((problem.kind == 2)[:, None, None], 0.0, K)
    size = G.shape[2]
    own, across, slope = M[:, :6, :6], M[:, :6, 6:], b[:, :6]
    if not np.isfinite(costs).all():
        poses, empty = int(problem.pose.max()) + 1, np.zeros((size + 1, size + 1))
        return Linear(
            empty, empty, empty, np.zeros((poses, 6, 6)), np.zeros((poses, 6, size + 1)), costs, math.inf,
        )  # fmt: skip
    solved = np.linalg.solve(own, np.concatenate([across, slope[:, :, None]], axis=2))
    taken = np.einsum("ni,ni->n", slope, solved[:, :, -1])
    within_cost = np.maximum(costs - taken, 0.0)
    within = np.zeros((size + 1, size + 1))
    within[-1, -1] = within_cost.sum()
    beyond = G[:, 6:]
    if beyond.any():
        inside = M[:, 6:, 6:] - across.swapaxes(1, 2) @ solved[:, :, :-1]
        right = b[:, 6:] - (across.swapaxes(1, 2) @ solved[:, :, -1:])[:, :, 0]
        within[:-1, :-1] = np.einsum("nip,niq->pq", beyond, inside @ beyond, optimize=False)
        within[:-1, -1] = within[-1, :-1] = np.einsum("nip,ni->p", beyond, right)
    Mk = M[:, :, :6] @ K
    My = b + (Mk @ correction[:, :, None])[:, :, 0]
    poses = int(problem.pose.max()) + 1
    Kt = K.swapaxes(1, 2)
    KMK, both = np.zeros((poses, 6, 6)), np.zeros((poses, 6, size + 1))
    np.add.at(KMK, problem.pose, Kt @ Mk[:, :6])
    np.add.at(both, problem.pose, np.concatenate([Mk.swapaxes(1, 2) @ G, Kt @ My[:, :6, None]], axis=2))
    GMG = np.einsum("nip,niq->pq", G, M @ G, optimize=False)
    GMy = np.einsum("nip,ni->p", G, My)
    Kd = (K @ correction[:, :, None])[:, :, 0]
    # b = M y - M K d, and |r|² changes by the same quadratic, so yMy follows from the residual at d
    yMy = costs.sum() + float(np.sum(Kd * (2.0 * slope + (own @ Kd[:, :, None])[:, :, 0])))
    whole = np.block([[GMG, GMy[:, None]], [GMy[None, :], np.array([[yMy]])]])
    sigma, expected = priors.of(problem, extras)
    weight = sigma**-2.0
    left = expected - values(problem, state, extras)
    prior = np.diag(np.append(weight, np.sum(weight * left**2)))
    prior[:-1, -1] = prior[-1, :-1] = weight * left
    tilt, by_turn = priors.tilts(problem, state.Z, size)
    levelled = np.concatenate([by_turn, -tilt[:, None]], axis=1)
    prior += levelled.T @ levelled
    return Linear(within, whole - within, prior, KMK, both, within_cost, float((costs - within_cost).sum()))


def eliminate(linear: Linear, noise: Noise) -> tuple[Array, Array, Array, Array]:
    """Return the information (p, p), right-hand side (p,), (poses, 6, 6) inverse of the corrections' block, `both`."""
    full, KMK, both = linear.weighed(noise)
    V: Array = np.linalg.inv(KMK + noise.prior).astype(np.float64)
    reduced = full - np.einsum("gip,giq->pq", both, V @ both)
    information = reduced[:-1, :-1]
    return (information + information.T) / 2.0, reduced[:-1, -1], V, both


def evidence(problem: Problem, linear: Linear, noise: Noise, extras: Sequence[Extra], priors: Priors) -> float:
    """Return minus twice the log marginal likelihood of the pixels, up to a constant that is the same for all answers.

    Args:
        problem: The views.
        linear: Linear system at the answer.
        noise: Standard deviations.
        extras: Further unknowns that are free.
        priors: Priors of these; a constant is missing where one is infinite.
    """
    value = criterion(*linear.weighed(noise), max(noise.translation, FLOOR), max(noise.rotation, FLOOR))
    sigma, _ = priors.of(problem, extras)
    return value + mark_evidence(problem, noise) + 2.0 * float(np.log(sigma[np.isfinite(sigma)]).sum())


def mark_evidence(problem: Problem, noise: Noise) -> float:
    """Return the part of minus twice the log likelihood that the spread of the marks has in it.

    Args:
        problem: The views.
        noise: Standard deviations.
    """
    own = 2.0 * math.log(noise.px) * float(np.sum(2 * problem.marks - 6))
    return own + 12.0 * len(problem) * math.log(noise.view_px)


def refine(
    problem: Problem,
    X: Array,
    Z: Array,
    noise: Noise,
    *,
    zeros: Array | None = None,
    extras: Sequence[Extra] = (),
    priors: Priors = FREE,
    estimate_robot: bool = False,
    estimate_px: bool = False,
    estimate_misfit: bool = True,
    iterations: int = _ITERATIONS,
) -> Estimate:
    """Refine mounts to the maximum of the likelihood.

    Args:
        problem: The views.
        X: (cameras, 4, 4) to start from.
        Z: (boards, 4, 4) to start from.
        noise: Standard deviations; those of the robot are a starting point when they are to be estimated.
        zeros: (joints,) to start from; None: 0.
        extras: More unknowns: scale, delay, intrinsics, distortion, zeros.
        priors: Priors of these.
        estimate_robot: Whether the spread of the robot's errors is found from the data.
        estimate_px: Whether that of the marks follows the extras.
        estimate_misfit: Whether a misfit may be found, where the robot is.
        iterations: Most iterations.

    Raises:
        OpenArmError: INTERNAL, when the start is no description of the views (a mark behind the camera).
    """
    state = Unknowns.start(problem, X, Z)
    if zeros is not None and "zeros" in extras:
        state = replace(state, zeros=zeros)
    linear = linearise(problem, state, extras, priors)
    if not np.isfinite(linear.twist_cost):
        raise OpenArmError(
            Code.INTERNAL, "the refinement starts with a mark behind the camera; the closed form it came from is wrong"
        )
    damping, settled, tried = 0.0, 0, False
    for count in range(iterations):
        if estimate_px and count >= 2:
            noise = replace(noise, px=_pooled(problem, linear.within_cost))
        if estimate_robot and count >= 2 and settled < 4:
            spreads = search(*linear.weighed(noise), noise.translation, noise.rotation, count == 2)
            found = replace(noise, translation=spreads[0], rotation=spreads[1])
            settled = settled + 1 if _near(found, noise) else 0
            noise = found
        cost = linear.cost(noise) + _prior_cost(state.correction, noise.prior)
        while True:
            information, right, V, both = eliminate(linear, noise)
            scale = np.sqrt(np.maximum(np.diag(information), 1e-30))
            normed = information / np.outer(scale, scale) + damping * np.eye(len(scale))
            step = np.linalg.lstsq(normed, right / scale, rcond=1e-14)[0] / scale
            correction = (V @ (both @ np.append(-step, 1.0))[:, :, None])[:, :, 0]
            trial = _stepped(problem, state, step, correction, extras)
            ahead = linearise(problem, trial, extras, priors)
            reached = ahead.cost(noise) + _prior_cost(correction, noise.prior)
            if reached <= cost * (1.0 + 1e-9) + 1e-9 or damping > 1e3:
                break
            damping = max(10.0 * damping, 1e-4)
        if damping > 1e3:
            break
        state, linear = trial, ahead
        damping = damping * 0.1 if damping > 1e-6 else 0.0
        small = float(np.abs(step[: 6 * (problem.cameras + problem.boards)]).max()) < 1e-9
        if (small or cost - reached < 1e-9 * max(reached, 1.0)) and (not estimate_robot or settled >= 1):
            if tried or not (estimate_robot and estimate_misfit):
                break
            found, tried = _with_misfit(linear, noise), True
            if found == noise:
                break
            noise, settled = found, 0
    spread = averaged(*linear.weighed(noise)) if estimate_robot else None
    information, _, _, _ = eliminate(linear, noise)
    known = evidence(problem, linear, noise, extras, priors)
    return Estimate(
        **vars(state), noise=noise, information=information, extras=tuple(extras), spread=spread, evidence=known
    )


def _with_misfit(linear: Linear, noise: Noise) -> Noise:
    """Return the noise with the most likely misfit, where that is far more likely than none."""
    parts = linear.within, linear.twist, linear.prior, linear.KMK, linear.both
    views = len(linear.within_cost)
    translation, rotation, misfit, drop = search_misfit(parts, views, noise.px, noise.translation, noise.rotation)
    if not (np.isfinite(drop) and drop > _EVIDENT):
        return noise
    return replace(noise, translation=translation, rotation=rotation, misfit=misfit)


def information_at(
    problem: Problem, X: Array, Z: Array, noise: Noise, extras: Sequence[Extra] = (), priors: Priors = FREE
) -> Array:
    """Information (parameters, parameters) on the unknowns at given mounts: its inverse is the Cramér-Rao bound.

    Args:
        problem: The views.
        X: (cameras, 4, 4).
        Z: (boards, 4, 4).
        noise: Standard deviations.
        extras: More unknowns, at their usual values.
        priors: Priors of these.
    """
    return eliminate(linearise(problem, Unknowns.start(problem, X, Z), extras, priors), noise)[0]


def _stepped(problem: Problem, state: Unknowns, step: Array, correction: Array, extras: Sequence[Extra]) -> Unknowns:
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
    return _pooled(problem, problem.free_cost)


def _pooled(problem: Problem, cost: Array) -> float:
    """Return the spread of the marks, px by axis, from what no pose takes away (n,), px²."""
    freedom = 2.0 * problem.marks - 6.0
    usable = freedom > 0
    if not usable.any():
        return 0.3
    variance = cost[usable] / freedom[usable]
    good = variance <= 6.0 * np.median(variance)
    pooled = cost[usable][good].sum() / freedom[usable][good].sum()
    return max(float(np.sqrt(pooled)), _LOWEST_PX)


def mount_error(T_estimated: Array, T_true: Array) -> tuple[float, float]:
    """Return the distance of the origins, m, and angle, rad, between two mounts."""
    offset = float(np.linalg.norm(T_estimated[:3, 3] - T_true[:3, 3]))
    return offset, se3.angle_between(T_true[:3, :3], T_estimated[:3, :3])


def fit_all(
    problem: Problem, X: Array, Z: Array, noise: Noise, extras: tuple[Extra, ...] = (), priors: Priors = FREE
) -> Estimate:
    """Return the likeliest answer with the noise as the data have it, and zeros of the joints as the robot has them.

    Args:
        problem: The views.
        X: (cameras, 4, 4) to start from.
        Z: (boards, 4, 4) to start from.
        noise: Noise to start from.
        extras: More unknowns.
        priors: Priors of these.

    Raises:
        OpenArmError: Same as `refine`.
    """
    start = replace(noise, translation=max(noise.translation, 1e-4), rotation=max(noise.rotation, 1e-4), misfit=0.0)
    return refine(problem, X, Z, start, extras=extras, priors=priors, estimate_robot=True, estimate_px=True)


def with_zeros(problem: Problem, known: Estimate, priors: Priors = FREE) -> Estimate:
    """Return the likelier of an answer and the best one in which the zeros of the joints are off too.

    Zeros that are off pass for a board of another size or a longer lens, since a few views of an arm in like postures
    tell them badly apart. They are a nuisance parameter: a prior of zero mean, whose deviation is the likeliest one
    (empirical Bayes).

    Args:
        problem: The views; without joint positions the answer is returned as it is.
        known: Answer with zeros as the robot reports them.
        priors: Priors of its extras.
    """
    best = start = known
    worse = 0
    for scale in ZERO_SCALES[1:] if problem.joints else ():
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
