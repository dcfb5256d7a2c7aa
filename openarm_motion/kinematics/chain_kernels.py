# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the inverse kinematics of a serial chain by damped least squares.

A chain is a tree (`tree_kernels.place_bodies`) in which joint i hangs on joint i - 1, and `tip` (4, 4), the tool in the
frame of the last joint. Angles rad, lengths m, everything expressed in the base frame. The kernels release the GIL.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from openarm_common.kernels import kernel
from openarm_common.robot.tree_kernels import forward, jacobian, unplaced
from openarm_common.types import Array, Ints

#: Turns a rotation error (rad) into a length (m) so that both can be minimised together: about the size of a hand.
ROTATION_LENGTH = 0.2
#: No joint moves further than this in one iteration: beyond it the linearisation says nothing.
_MAX_STEP = 0.6
#: Iterations of a guess, and strength of the pull of redundant motion towards the first guess.
_ITERATIONS = 100
_PULL = 0.05
#: An attempt is given up after this many iterations that hardly improve.
_STALL = 5


@kernel
def _pose_error(target: Array, pose: Array, out: Array) -> None:
    """Position error and rotation vector (6,) that take `pose` to `target`, base frame."""
    e = np.empty((3, 3))
    for row in range(3):
        out[row] = target[row, 3] - pose[row, 3]
        for col in range(3):
            e[row, col] = target[row, 0] * pose[col, 0] + target[row, 1] * pose[col, 1] + target[row, 2] * pose[col, 2]
    x, y, z = e[2, 1] - e[1, 2], e[0, 2] - e[2, 0], e[1, 0] - e[0, 1]
    sine = math.sqrt(x * x + y * y + z * z)
    trace = e[0, 0] + e[1, 1] + e[2, 2]
    if sine < 1e-9 and trace < 0.0:  # half a turn: any axis gets the iteration off the saddle
        out[3], out[4], out[5] = math.pi, 0.0, 0.0
        return
    k = math.atan2(sine, trace - 1.0) / sine if sine > 1e-9 else 0.5
    out[3], out[4], out[5] = k * x, k * y, k * z


@kernel
def _solve_spd(h: Array, g: Array, x: Array) -> None:
    """Solve ``h x = g`` in place for a small symmetric positive definite `h` (lower triangle), by Cholesky."""
    n = g.shape[0]
    for i in range(n):
        for j in range(i + 1):
            s = h[i, j]
            for k in range(j):
                s -= h[i, k] * h[j, k]
            h[i, j] = math.sqrt(s) if i == j else s / h[j, j]
    for i in range(n):
        s = g[i]
        for k in range(i):
            s -= h[i, k] * x[k]
        x[i] = s / h[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= h[k, i] * x[k]
        x[i] = s / h[i, i]


@kernel
def _draw(lower: Array, upper: Array, at_limits: bool, x: Array) -> None:
    """Draw a guess, uniform within the limits; `at_limits` puts about two joints of three on one of theirs."""
    for i in range(x.shape[0]):
        u = np.random.random()
        if math.isinf(upper[i]):
            x[i] = math.pi * (2.0 * u - 1.0)
            continue
        if at_limits:
            u = min(1.0, max(0.0, 3.0 * u - 1.0))
        x[i] = lower[i] + (upper[i] - lower[i]) * u


@kernel
def solve_ik(
    target: Array,
    start: Array,
    position_only: bool,
    tolerance: tuple[float, float],
    restarts: int,
    lower: Array,
    upper: Array,
    parents: Ints,
    placements: Array,
    axes: Array,
    prismatic: NDArray[np.bool_],
    tip: Array,
    best: Array,
) -> tuple[bool, float, float]:
    """Levenberg-Marquardt with damping by the squared error (Sugihara 2011), joints held at limits they push into.

    Args:
        target: (4, 4) tool pose.
        start: (n,) first guess, which redundant motion is pulled towards; the pull vanishes with the error, so the
            solution stays exact. Further guesses are uniform within the limits, the same each time.
        position_only: Ignore the rotation.
        tolerance: Position (m) and rotation (rad).
        restarts: Further guesses after the first.
        lower: (n,) limits; infinite ones for a joint that turns without end.
        upper: (n,) limits.
        parents: Chain, see the module's head.
        placements: Chain.
        axes: Chain.
        prismatic: Chain.
        tip: Chain.
        best: (n,) output: the solution, or the configuration with the smallest error found.

    Returns:
        Solved, position error (m) and rotation error (rad) of `best`.
    """
    n = start.shape[0]
    x = np.empty(n)
    pose = np.empty((4, 4))
    frames, levers = unplaced(n), np.empty((n, 6))
    jac = np.empty((6, n))
    e = np.empty(6)
    h = np.empty((n, n))
    g = np.empty(n)
    dx = np.empty(n)
    held = np.zeros(n, np.bool_)
    w = 0.0 if position_only else ROTATION_LENGTH
    best_cost, best_p, best_r = np.inf, np.inf, np.inf
    for i in range(n):
        x[i] = min(upper[i], max(lower[i], start[i]))
        best[i] = x[i]
    for attempt in range(restarts + 1):
        if attempt == 1:
            np.random.seed(0)
        if attempt > 0:
            _draw(lower, upper, attempt % 2 == 0, x)
        least, stall = np.inf, 0
        for _ in range(_ITERATIONS):
            forward(x, parents, placements, axes, prismatic, n, tip, frames, levers, pose)
            _pose_error(target, pose, e)
            error_p = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
            error_r = math.sqrt(e[3] * e[3] + e[4] * e[4] + e[5] * e[5])
            cost = error_p * error_p + w * w * error_r * error_r
            solved = error_p < tolerance[0] and (position_only or error_r < tolerance[1])
            if solved or cost < best_cost:
                best_cost, best_p, best_r = cost, error_p, error_r
                for i in range(n):
                    best[i] = x[i]
            if solved:
                return True, error_p, error_r
            if cost < 0.98 * least:
                least, stall = cost, 0
            else:
                stall += 1
                if stall > _STALL:
                    break
            jacobian(levers, prismatic, pose[:3, 3], jac)
            for row in range(3, 6):
                e[row] *= w
                for i in range(n):
                    jac[row, i] *= w
            damping = 0.5 * cost + 1e-7
            pull = _PULL * cost if attempt == 0 else 0.0
            for i in range(n):
                s = pull * (start[i] - x[i])
                for row in range(6):
                    s += jac[row, i] * e[row]
                g[i] = s
                held[i] = (x[i] <= lower[i] + 1e-9 and s < 0.0) or (x[i] >= upper[i] - 1e-9 and s > 0.0)
            for i in range(n):
                for j in range(i + 1):
                    s = 0.0
                    if not (held[i] or held[j]):
                        for row in range(6):
                            s += jac[row, i] * jac[row, j]
                    h[i, j] = s
                h[i, i] += damping + pull
                if held[i]:
                    h[i, i] = 1.0
                    g[i] = 0.0
            _solve_spd(h, g, dx)
            largest = 0.0
            for i in range(n):
                largest = max(largest, abs(dx[i]))
            scale = _MAX_STEP / largest if largest > _MAX_STEP else 1.0
            for i in range(n):
                x[i] = min(upper[i], max(lower[i], x[i] + scale * dx[i]))
    return False, best_p, best_r
