# SPDX-License-Identifier: Apache-2.0
"""Variance components: how much of the residuals is the robot's, and how much is misfit of the views.

All are read off the problem linearised at the answer. The restricted likelihood is that of the residuals with the
mounts and the corrections of the robot integrated out, so that their freedom is not counted as accuracy (Patterson
and Thompson 1971, "Recovery of inter-block information when block sizes are unequal"). m and rad.
"""

from __future__ import annotations

import math

import numpy as np

from openarm_common.kernels import kernel
from openarm_common.types import Array

#: Below these a robot counts as exact: far less than a mark moves by, and the arithmetic stays well conditioned.
FLOOR = 1e-7  # m, rad
#: Errors of a small arm, m and rad: only the centre of a wide prior.
TYPICAL_ROBOT = (4e-4, 8e-4)
#: Chance, before anything is seen, that the robot is exact; the factor within which others are like a typical one.
_EXACT = 0.4
_FACTOR = 3.0
#: How much the logarithm of the likelihood counts: with five poses it is itself a matter of luck, and an answer that
#: believes it fully is now and then far too sure.
_TRUST = 0.7
#: Where the average over spreads is taken: their size against a typical robot's, and translation against rotation.
_LEVELS = np.geomspace(0.015, 240.0, 15)
_BALANCES = np.geomspace(1.0 / 8.0, 8.0, 5)


@kernel
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


@kernel
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
        logs -= 2.0 * np.log(scale[a])
    for a in range(size):
        for b in range(a + 1):
            left[a, b] *= scale[a] * scale[b]
    root = np.zeros((size, size))
    if not _cholesky(left, root):
        return np.inf
    for a in range(size - 1):
        logs += 2.0 * np.log(root[a, a])
    return logs + root[size - 1, size - 1] ** 2


@kernel
def search(
    full: Array, KMK: Array, both: Array, start_t: float, start_r: float, whole: bool
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Search for the most likely spread of the robot, m and rad.

    Args:
        full: Same as for `criterion`.
        KMK: Same as for `criterion`.
        both: Same as for `criterion`.
        start_t: Translation to start from, m.
        start_r: The same, rad.
        whole: Whether to look everywhere, instead of near the start.
    """
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


@kernel
def _with_misfit(
    parts: tuple[Array, Array, Array, Array, Array], views: int, px: float, t: float, r: float, misfit: float
) -> float:  # pragma: no cover - compiled
    within, twist, prior, KMK, both = parts
    level = 1.0 + misfit * misfit
    weight = 1.0 / (px * px * level)
    full = within / (px * px) + twist * weight + prior
    return 6.0 * views * np.log(level) + criterion(full, KMK * weight, both * weight, max(t, 1e-7), max(r, 1e-7))


@kernel
def search_misfit(
    parts: tuple[Array, Array, Array, Array, Array], views: int, px: float, start_t: float, start_r: float
) -> tuple[float, float, float, float]:  # pragma: no cover - compiled
    """Search for the most likely spreads of the robot, m and rad, and misfit.

    Args:
        parts: within, twist and prior (p + 1, p + 1), KMK (poses, 6, 6) and both (poses, 6, p + 1), see `Linear`.
        views: Number.
        px: Spread of a mark, px.
        start_t: Spread of the robot without misfit, m.
        start_r: The same, rad.

    Returns:
        Translation, rotation, misfit, and by how much the criterion is lower than without misfit.
    """
    first = _with_misfit(parts, views, px, start_t, start_r, 0.0)
    best, at_t, at_r, at_m = first, start_t, start_r, 0.0
    for k in range(5):
        for i in range(4):
            for j in range(4):
                t = start_t * 0.25**i if i < 3 else 1e-7
                r = start_r * 0.25**j if j < 3 else 1e-7
                value = _with_misfit(parts, views, px, t, r, 4.0**k)
                if value < best:
                    best, at_t, at_r, at_m = value, t, r, 4.0**k
    span = 2.0
    for _ in range(60):
        if at_m == 0.0 or span < 1.03:
            break
        better = False
        for axis in range(3):
            for factor in (span, 1.0 / span):
                t = max(at_t * (factor if axis == 0 else 1.0), 1e-7)
                r = max(at_r * (factor if axis == 1 else 1.0), 1e-7)
                m = at_m * (factor if axis == 2 else 1.0)
                value = _with_misfit(parts, views, px, t, r, m)
                if value < best - 1e-6:
                    best, at_t, at_r, at_m, better = value, t, r, m, True
        if not better:
            span = span**0.5
    return at_t, at_r, at_m, first - best


@kernel
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


def averaged(full: Array, KMK: Array, both: Array) -> Array:
    """Return the covariance (p, p) about the present answer, averaged over the spreads that the data allow.

    With few poses the spread itself is uncertain, and an answer that takes its best value for true is too sure of
    itself. The weight is the restricted likelihood times a prior: either the robot is exact, as in a simulation, or
    its spread is near that of a typical one, with translation and rotation more or less in proportion.

    Args:
        full: (p + 1, p + 1) as `criterion`.
        KMK: (poses, 6, 6).
        both: (poses, 6, p + 1).
    """
    level, balance = (grid.ravel() for grid in np.meshgrid(_LEVELS, _BALANCES, indexing="ij"))
    spreads = np.stack(
        [level * np.sqrt(balance) * TYPICAL_ROBOT[0], level / np.sqrt(balance) * TYPICAL_ROBOT[1]], axis=1
    )
    spreads = np.concatenate([[[FLOOR, FLOOR]], spreads])
    near = np.exp(-0.5 * (np.log(level) ** 2 + np.log(balance) ** 2) / math.log(_FACTOR) ** 2)
    prior = np.concatenate([[_EXACT], (1.0 - _EXACT) * near / near.sum()])
    size, count = len(full) - 1, len(spreads)
    values, answers, covariances = np.full(count, np.inf), np.zeros((count, size)), np.zeros((count, size, size))
    _answers(full, KMK, both, spreads, values, answers, covariances)
    weight = prior * np.exp(-0.5 * _TRUST * (values - np.min(values)))
    weight[~np.isfinite(values)] = 0.0
    weight /= weight.sum()
    return np.einsum("k,kpq->pq", weight, covariances) + np.einsum("k,kp,kq->pq", weight, answers, answers)
