# SPDX-License-Identifier: Apache-2.0
"""Hand-eye from pairs of poses, where no pixels are left: of the robot, and of the board in the camera.

A pair says `T_camera_board = X⁻¹ B Z` as a view does (see `problem`). What is off is taken as independent from pair to
pair, with one variance of translations and one of rotations; both are estimated with the mounts by their redundancies
(Förstner's variance components). That is less than pixels give: how sure each direction of a board's pose is, a pair
does not say. m, rad.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from openarm_calibration.handeye.closed_form import METHODS, REFINED, closed_form
from openarm_calibration.handeye.consensus import Consensus, agreed
from openarm_calibration.handeye.observability import FEWEST, axis_name, motion, motion_fault
from openarm_calibration.handeye.problem import Setup, inverses, moved, skews
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.unknowns import invert_scaled
from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array, Mask

_ROUNDS = 30
#: Least deviations that are estimated: numbers in a file have as many digits, m and rad.
_LEAST = (1e-7, 1e-7)
#: With fewer pairs none is left out; and never more than this share.
_FEWEST_TO_REJECT, _MOST_REJECTED = 7, 0.25
_FALSE_ALARM = 1e-3
#: Pairs that are left out in turn to see which of them the others contradict most, and to compare methods.
_SUSPECTS, _MOST_FOLDS = 6, 40
#: Most pairs of a closed form that is compared.
_MOST_CLOSED = 40
#: Of the deviation by medians: farther pairs are left out at first.
_FAR = 5.0
#: No answer about one axis is as unsure, rad.
_UNSURE = 0.2
#: A position that is given counts as sure to this, m; it must lie within so much of the free direction (cosine).
_GIVEN, _ALONG = 1e-6, 0.3
#: By how much a closed form must predict left-out pairs better to be taken instead.
_BETTER = 0.95


@dataclass(frozen=True, eq=False)
class PosePairs:
    """Pairs of poses of one camera and board.

    Args:
        setup: in_hand or to_hand.
        A: (n, 4, 4) T_base_gripper.
        C: (n, 4, 4) T_camera_board.
        names: (n,).
    """

    setup: Setup
    A: Array
    C: Array
    names: tuple[str, ...]

    @property
    def B(self) -> Array:
        """(n, 4, 4) from the board's to the camera's carrier."""
        return inverses(self.A) if self.setup == "in_hand" else self.A

    def subset(self, keep: Mask) -> PosePairs:
        """Return some of the pairs."""
        names = tuple(name for name, kept in zip(self.names, keep, strict=True) if kept)
        return PosePairs(self.setup, self.A[keep], self.C[keep], names)


@dataclass(frozen=True)
class LeftOut:
    """How a method predicts pairs that it did not see: rms at the board, m, and rad."""

    translation: float
    rotation: float


@dataclass(frozen=True, eq=False)
class PairSolution:
    """Mounts from pairs.

    Args:
        X: (4, 4) of the camera.
        Z: (4, 4) of the board.
        covariance: (12, 12) of X, then Z, six numbers each as in `problem`.
        noise: Estimated deviations of a pair by axis, m and rad.
        used: (n,) pairs that it rests on.
        left_out: Prediction of left-out pairs by method; what a method fails with is its message.
        method: Method of X and Z: the refinement unless a closed form predicts better.
        distance: (n,) squared distance of each pair over its expectation.
        free: (3,) direction along which the camera may be anywhere; zero where the pairs determine it.
    """

    X: Array
    Z: Array
    covariance: Array
    noise: tuple[float, float]
    used: Mask
    left_out: dict[str, LeftOut | str]
    method: str
    distance: Array
    free: Array

    @property
    def sigma(self) -> tuple[float, float]:
        """Predicted error of the camera's mount: standard deviation of position (m) and rotation (rad) as vectors."""
        return math.sqrt(np.trace(self.covariance[:3, :3])), math.sqrt(np.trace(self.covariance[3:6, 3:6]))


@dataclass(frozen=True, eq=False)
class _Fit:
    X: Array
    Z: Array
    covariance: Array
    noise: tuple[float, float]


@dataclass(frozen=True, eq=False)
class _Held:
    """A position of the camera along a direction (3,), m, that the pairs do not determine."""

    along: Array
    at: float


def residuals(pairs: PosePairs, X: Array, Z: Array) -> Array:
    """Return (n, 6): how far each board is from where X and Z predict it, m at the board and rad."""
    T = se3.inverse(X) @ pairs.B @ Z
    turned = np.swapaxes(T[:, :3, :3], 1, 2) @ pairs.C[:, :3, :3]
    return np.hstack([pairs.C[:, :3, 3] - T[:, :3, 3], Rotation.from_matrix(turned).as_rotvec()])


def solve_pairs(pairs: PosePairs, fixed: Mapping[str, float] | None = None) -> PairSolution:
    """Solve for the mounts, leave out pairs that the others contradict, and compare with closed forms.

    Where all rotations are about one axis (an arm of four axes) five numbers of the camera's mount are determined.

    Args:
        pairs: Pairs of one camera and board.
        fixed: Position of the camera along an axis of its parent, `x`, `y` or `z`, m, where the pairs leave it free.

    Raises:
        OpenArmError: DEGENERATE, when the poses do not determine the mounts, with the cause and what to add;
            INVALID_ARGUMENT, for numbers that are not finite, or what is fixed and must not be.
    """
    if not (np.isfinite(pairs.A).all() and np.isfinite(pairs.C).all()):
        raise OpenArmError(Code.INVALID_ARGUMENT, "a pose has numbers that are not finite; remove that sample")
    if len(pairs.A) < FEWEST:
        raise OpenArmError(Code.DEGENERATE, motion_fault(motion(pairs.A)) if len(pairs.A) else "too few poses: none")
    seen = motion(pairs.A)
    if (fault := motion_fault(seen)) and not seen.one_axis:
        raise OpenArmError(Code.DEGENERATE, fault)
    common = agreed(pairs.B, pairs.C)
    about_one = bool(common.free.any())
    if fault and not about_one:  # it turned a little about a second axis: enough to be seen, too little to be used
        raise OpenArmError(Code.DEGENERATE, fault)
    held, free = _held(common, fixed or {})
    noise = max(common.spread[0], _LEAST[0]), max(common.spread[1], _LEAST[1])
    start = _Fit(common.X, common.Z, np.eye(12), noise)
    far = np.maximum(common.translations / noise[0], common.rotations / noise[1]) > _FAR
    used = ~far if _may_go(far) else np.ones(len(pairs.A), dtype=bool)
    fit = _fit(pairs, used, start, held)
    while _may_go(~used, 1):
        away = np.where(used, np.sum((residuals(pairs, fit.X, fit.Z) / _sigmas(fit)) ** 2, axis=1), 0.0)
        distances = {int(k): _distance(pairs, used, int(k), fit, held) for k in np.argsort(-away)[:_SUSPECTS]}
        one = max(distances, key=distances.__getitem__)
        if distances[one] <= _limit(used):
            break
        used[one] = False
        fit = _fit(pairs, used, fit, held)
    for k in np.flatnonzero(~used):  # what was left out for the sake of another comes back
        if _distance(pairs, used, int(k), fit, held) <= _limit(used):
            used[k] = True
            fit = _fit(pairs, used, fit, held)
    # about one axis, and without a motion across it, the rotation about that axis is not determined either
    unsure = math.sqrt(np.trace(fit.covariance[3:6, 3:6])) > _UNSURE
    if (fault := motion_fault(motion(pairs.A[used]))) and (unsure or not about_one):
        raise OpenArmError(Code.DEGENERATE, fault)
    distance = np.mean((residuals(pairs, fit.X, fit.Z) / _sigmas(fit)) ** 2, axis=1)
    inside = pairs.subset(used)
    left_out = _left_out(inside, fit, held)
    method = _best(left_out, fit)
    X, Z, covariance = fit.X, fit.Z, fit.covariance
    if method != REFINED:
        mounts = closed_form(method, pairs.setup, inside.A, inside.C)
        X, Z = mounts.X, mounts.Z
        offset, angle = mount_error(X, fit.X)  # its own error is not known; the distance is the better part of it
        covariance = covariance.copy()
        covariance[:6, :6] += np.diag([offset**2 / 3.0] * 3 + [angle**2 / 3.0] * 3)
    return PairSolution(X, Z, covariance, fit.noise, used, left_out, method, distance, free)


def _held(common: Consensus, fixed: Mapping[str, float]) -> tuple[_Held | None, Array]:
    """Return which position of the camera is held, and the direction that stays free."""
    if not common.free.any():
        if fixed:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"--fix {next(iter(fixed))}: the poses turn about two axes and determine all six numbers",
            )
        return None, common.free
    if not fixed:
        return _Held(common.free, float(common.free @ common.X[:3, 3])), common.free
    axis, at = next(iter(fixed.items()))
    along = np.eye(3)["xyz".index(axis)]
    if abs(float(along @ common.free)) < _ALONG or len(fixed) > 1:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"--fix {' '.join(fixed)}: what the poses do not determine is the camera's place along its parent's"
            f" {axis_name(common.free)}; give that one, m",
        )
    return _Held(along, at), np.zeros(3)


def _may_go(out: Mask, more: int = 0) -> bool:
    """Return whether so many pairs may be left out."""
    count = int(np.count_nonzero(out)) + more
    return len(out) - count >= max(_FEWEST_TO_REJECT - 1, math.ceil((1.0 - _MOST_REJECTED) * len(out)))


def _distance(pairs: PosePairs, used: Mask, k: int, fit: _Fit, held: _Held | None) -> float:
    """Return the squared distance of a pair from the answer of the others, over what is expected of them."""
    rest = used.copy()
    rest[k] = False
    other = _fit(pairs, rest, fit, held)
    alone = np.zeros(len(used), dtype=bool)
    alone[k] = True
    return float(np.sum((residuals(pairs.subset(alone), other.X, other.Z) / _sigmas(other)) ** 2)) / 6.0


def _limit(used: Mask) -> float:
    count = int(np.count_nonzero(used))
    return float(stats.f.ppf(1.0 - _FALSE_ALARM / count, 6, max(6 * (count - 1) - 12, 1)))


def _sigmas(fit: _Fit) -> Array:
    return np.array([fit.noise[0]] * 3 + [fit.noise[1]] * 3)


def _fit(pairs: PosePairs, used: Mask, start: _Fit, held: _Held | None) -> _Fit:
    """Return the mounts of least squares and the deviations that fit them."""
    part = pairs.subset(used)
    X, Z, noise = start.X, start.Z, start.noise
    row = np.zeros(12)
    if held is not None:
        row[:3] = held.along / _GIVEN
    information = np.eye(12)
    for _ in range(_ROUNDS):
        error = residuals(part, X, Z)
        J = _derivative(part, X, Z)
        weight = np.array([noise[0] ** -2.0] * 3 + [noise[1] ** -2.0] * 3)
        information = np.einsum("nia,i,nib->ab", J, weight, J) + np.outer(row, row)
        covariance = invert_scaled(information)
        beyond = 0.0 if held is None else (float(held.along @ X[:3, 3]) - held.at) / _GIVEN
        step = -covariance @ (np.einsum("nia,i,ni->a", J, weight, error) + row * beyond)
        X, Z = moved(X, step[:6]), moved(Z, step[6:])
        error = residuals(part, X, Z)
        spent = np.einsum("nia,ab,nib->i", J, covariance, J) * weight
        before = noise
        noise = tuple(
            max(math.sqrt(float(np.sum(error[:, s] ** 2)) / max(3.0 * len(error) - float(spent[s].sum()), 1.0)), least)
            for s, least in zip((slice(0, 3), slice(3, 6)), _LEAST, strict=True)
        )
        settled = all(abs(a - b) <= 1e-3 * b for a, b in zip(noise, before, strict=True))
        if settled and float(np.sqrt(step @ information @ step)) < 1e-3:
            break
    return _Fit(X, Z, invert_scaled(information), (noise[0], noise[1]))


def _derivative(pairs: PosePairs, X: Array, Z: Array) -> Array:
    """Return (n, 6, 12) how the residuals change with the six numbers of X and those of Z, for small residuals."""
    T = se3.inverse(X) @ pairs.B @ Z
    out = np.zeros((len(pairs.A), 6, 12))
    out[:, :3, :3] = X[:3, :3].T
    out[:, :3, 3:6] = -skews(T[:, :3, 3])
    out[:, 3:, 3:6] = np.swapaxes(pairs.C[:, :3, :3], 1, 2)
    out[:, :3, 6:9] = -X[:3, :3].T @ pairs.B[:, :3, :3]
    out[:, 3:, 9:] = -np.eye(3)
    return out


def _left_out(pairs: PosePairs, fit: _Fit, held: _Held | None) -> dict[str, LeftOut | str]:
    """Return how each method predicts each pair from the others; with one axis there are no closed forms."""
    n = len(pairs.A)
    every = ~np.eye(n, dtype=bool)[np.unique(np.linspace(0, n - 1, min(n, _MOST_FOLDS)).astype(int))]
    methods = (REFINED,) if held else (REFINED, *METHODS)
    kept = [keep for keep in every if keep.sum() >= FEWEST and (held or not motion_fault(motion(pairs.A[keep])))]
    return {method: _predicted(pairs, method, fit, kept, held) for method in methods}


def _predicted(pairs: PosePairs, method: str, fit: _Fit, kept: list[Mask], held: _Held | None) -> LeftOut | str:
    """Return how a method predicts the pair that each of some masks (n,) leaves out."""
    errors: list[Array] = []
    for keep in kept:
        part = pairs.subset(_thinned(keep))
        try:
            solved = (
                _fit(pairs, keep, fit, held) if method == REFINED else closed_form(method, part.setup, part.A, part.C)
            )
            errors.append(residuals(pairs.subset(~keep), solved.X, solved.Z)[0])
        except (OpenArmError, ValueError) as error:  # a closed form may return a reflection
            return error.message if isinstance(error, OpenArmError) else "no rotation for some of the pairs"
    if not errors:
        return "too few pairs to leave one out"
    mean = np.mean(np.square(errors), axis=0)
    return LeftOut(math.sqrt(float(mean[:3].sum())), math.sqrt(float(mean[3:].sum())))


def _thinned(keep: Mask) -> Mask:
    """Return at most `_MOST_CLOSED` of those that are kept: closed forms look at each pair of pairs."""
    places = np.flatnonzero(keep)
    out = np.zeros_like(keep)
    out[places[np.unique(np.linspace(0, len(places) - 1, min(len(places), _MOST_CLOSED)).astype(int))]] = True
    return out


def _best(left_out: dict[str, LeftOut | str], fit: _Fit) -> str:
    """Return the refinement, or the closed form that predicts left-out pairs clearly better."""

    def score(method: str) -> float:
        found = left_out[method]
        if isinstance(found, str):
            return math.inf
        return math.hypot(found.translation / fit.noise[0], found.rotation / fit.noise[1])

    best = min(left_out, key=score)
    return best if score(best) < _BETTER * score(REFINED) else REFINED
