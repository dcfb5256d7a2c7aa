# SPDX-License-Identifier: Apache-2.0
"""Numba kernels: the swivel angles at which a spherical-revolute-spherical arm keeps its joint limits, exactly.

At a pose the swivel angle s turns the rotations of shoulder and wrist about a fixed axis (`srs_kernels.reduce_pose`),
so each condition "this joint is at this limit" has the form ``c + a cos s + b sin s = 0`` with at most two roots. The
roots of all limits, and the angles at which a shoulder or wrist is singular, cut the turn into arcs; a branch keeps all
limits in the whole of an arc or nowhere in it, so one swivel angle in each tells. No interval is too narrow.

Sources: M. Shimizu, H. Kakuya, W.-K. Yoon, K. Kitagaki, K. Kosuge, "Analytical inverse kinematic computation for 7-DOF
redundant manipulators with joint limits and its application to redundancy resolution", IEEE Trans. Robotics 24(5),
2008; C. Faria, F. Ferreira, W. Erlhagen, S. Monteiro, E. Bicho, "Position-based kinematics for 7-DoF serial
manipulators with global configuration control, joint limit and singularity avoidance", Mech. Mach. Theory 121, 2018.

`geometry` and `tool` are those of `srs_kernels`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from openarm_common.kernels import kernel
from openarm_common.types import Array
from openarm_motion.kinematics.srs_kernels import fold, middle_zero, reduce_pose

#: Angles that part the arcs: two roots for two limits of six joints, two singular angles of shoulder and wrist each.
MOST = 28
#: A joint that rounding puts outside its limit by less is put on it, rad.
ROUNDING = 1e-9
_FOLDS = 4
_TURN = 2.0 * math.pi


@kernel
def _roots(c: float, a: float, b: float, at: Array, count: int) -> int:
    """Append the angles s with ``c + a cos s + b sin s = 0`` to `at`; returns the new count."""
    size = math.sqrt(a * a + b * b)
    # a touching root that rounding has lost is one still
    if size < 1e-12 or abs(c) > size * (1.0 + 1e-9):
        return count
    middle, half = math.atan2(b, a), math.acos(min(1.0, max(-1.0, -c / size)))
    at[count], at[count + 1] = middle - half, middle + half
    return count + 2


@kernel
def _outer(sine: Array, cosine: Array, angle: float, at: Array, count: int) -> int:
    """Append the angles at which a joint is at `angle` or opposite; coefficients (3,) of its sine and cosine."""
    cs, sn = math.cos(angle), math.sin(angle)
    return _roots(
        sine[0] * cs - cosine[0] * sn, sine[1] * cs - cosine[1] * sn, sine[2] * cs - cosine[2] * sn, at, count
    )


@kernel
def _arcs(turnings: Array, geometry: Array, lower: Array, upper: Array, at: Array) -> int:
    """Fill `at` (MOST + 1,) with the ends of the arcs, rising from one in [-pi, pi), the first again a turn later.

    Returns:
        The number of arcs.
    """
    count = 0
    for group in range(2):
        t, first = turnings[group], 4 * group
        zero = middle_zero(geometry[first], geometry[first + 1], geometry[first + 2])
        for k in range(2):
            limits = lower if k == 0 else upper
            count = _outer(t[1], -t[2], limits[first], at, count)
            count = _roots(t[0, 0] - math.cos(limits[first + 1] - zero), t[0, 1], t[0, 2], at, count)
            count = _outer(t[3], -t[4], limits[first + 2], at, count)
        if abs(t[0, 1]) + abs(t[0, 2]) > 1e-12:
            at[count] = math.atan2(t[0, 2], t[0, 1])
            at[count + 1] = at[count] + math.pi
            count += 2
    if count == 0:
        at[0], count = -math.pi, 1
    for i in range(count):
        s = at[i] - _TURN * math.floor((at[i] + math.pi) / _TURN)
        j = i
        while j > 0 and at[j - 1] > s:
            at[j] = at[j - 1]
            j -= 1
        at[j] = s
    at[count] = at[0] + _TURN
    return count


@kernel
def _all_folds(
    turnings: Array, s: float, geometry: Array, lower: Array, upper: Array, whole: bool, q: Array, over: Array
) -> None:
    """Fill the configurations `q` (4, 7) of the folds of shoulder (bit 0) and wrist (bit 1), joint 4 left out.

    Args:
        turnings: See `reduce_pose`.
        s: Swivel angle, rad.
        geometry: See `srs_kernels`.
        lower: (7,) limits.
        upper: (7,) limits.
        whole: Also the wrist of a shoulder that is outside its limits.
        q: Output.
        over: (4,) output: how far each is outside its limits, rad.
    """
    a = fold(turnings[0], s, 0, False, geometry, lower, upper, q[0])
    b = fold(turnings[0], s, 0, True, geometry, lower, upper, q[1])
    over[0], over[1], over[2], over[3] = a, b, a, b
    if not whole and min(a, b) > ROUNDING:
        return
    a = fold(turnings[1], s, 4, False, geometry, lower, upper, q[0])
    b = fold(turnings[1], s, 4, True, geometry, lower, upper, q[2])
    for i in range(3):
        q[2, i], q[3, i] = q[0, i], q[1, i]
        q[1, 4 + i], q[3, 4 + i] = q[0, 4 + i], q[2, 4 + i]
    for k in range(_FOLDS):
        over[k] = max(over[k], a if k < 2 else b)


@kernel
def _keep(
    q: Array,
    q4: float,
    s: float,
    branch: int,
    lower: Array,
    upper: Array,
    found: Array,
    at: Array,
    branches: NDArray[np.int64],
    count: int,
) -> int:
    """Append a configuration; returns the new count."""
    for i in range(7):
        found[count, i] = min(upper[i], max(lower[i], q4 if i == 3 else q[i]))
    at[count], branches[count] = s, branch
    return count + 1


@kernel
def _missed(inside: NDArray[np.bool_], met: NDArray[np.bool_], ends: Array, arcs: int, middles: Array) -> int:
    """Fill `middles` with that of each run of arcs `inside` of which none is `met`; returns how many there are."""
    first, count, begin = 0, 0, 0.0
    while first < arcs and inside[first]:
        first += 1
    if first == arcs:  # all around: what is met lies in it
        return 0
    length, seen = 0.0, True
    for i in range(first + 1, first + arcs + 1):
        k = i % arcs
        if inside[k]:
            if length == 0.0:
                begin, seen = ends[k], False
            length += ends[k + 1] - ends[k]
            seen = seen or met[k]
        elif length > 0.0:
            if not seen:
                middles[count] = begin + 0.5 * length
                count += 1
            length = 0.0
    return count


@kernel
def sweep(
    pose: Array,
    swivels: Array,
    geometry: Array,
    tool: Array,
    lower: Array,
    upper: Array,
    found: Array,
    found_swivel: Array,
    found_branch: NDArray[np.int64],
) -> tuple[int, int]:
    """All branches at swivel angles, and in the middle of every interval that none of these is in.

    Args:
        pose: (4, 4) of the tool.
        swivels: (k,) rad.
        geometry: See `srs_kernels`.
        tool: See `srs_kernels`.
        lower: (7,) joint limits.
        upper: (7,) joint limits.
        found: (8 (k + MOST), 7) output: configurations within the limits.
        found_swivel: (8 (k + MOST),) output.
        found_branch: (8 (k + MOST),) output.

    Returns:
        Number of configurations found; 0, TOO_FAR or TOO_NEAR.
    """
    count = 0
    q, over = np.empty((_FOLDS, 7)), np.empty(_FOLDS)
    ends, middles, turnings = np.empty(MOST + 1), np.empty(MOST), np.empty((2, 9, 3))
    inside, met = np.empty((MOST, _FOLDS), np.bool_), np.empty((MOST, _FOLDS), np.bool_)
    for elbow in range(2):
        status, q4 = reduce_pose(pose, elbow == 1, geometry, tool, lower, upper, turnings)
        if status != 0:
            return 0, status
        if max(lower[3] - q4, q4 - upper[3]) > ROUNDING:
            continue
        arcs = _arcs(turnings, geometry, lower, upper, ends)
        for k in range(arcs):
            middle = 0.5 * (ends[k] + ends[k + 1])
            _all_folds(turnings, middle, geometry, lower, upper, False, q, over)
            for f in range(_FOLDS):
                inside[k, f], met[k, f] = over[f] <= ROUNDING, False
        for s in swivels:
            k = arcs - 1
            along = ends[0] + (s - ends[0]) % _TURN
            while k > 0 and ends[k] > along:
                k -= 1
            if not inside[k].any():
                continue
            _all_folds(turnings, s, geometry, lower, upper, False, q, over)
            for f in range(_FOLDS):
                if over[f] <= ROUNDING:
                    count = _keep(q[f], q4, s, elbow + 2 * f, lower, upper, found, found_swivel, found_branch, count)
                    met[k, f] = True
        for f in range(_FOLDS):
            for s in middles[: _missed(inside[:, f], met[:, f], ends, arcs, middles)]:
                _all_folds(turnings, s, geometry, lower, upper, False, q, over)
                if over[f] <= ROUNDING:
                    count = _keep(q[f], q4, s, elbow + 2 * f, lower, upper, found, found_swivel, found_branch, count)
    return count, 0


@kernel
def nearest(
    pose: Array,
    swivels: Array,
    geometry: Array,
    tool: Array,
    lower: Array,
    upper: Array,
    best: Array,
    best_swivel: Array,
    least: Array,
) -> int:
    """Of each branch the configuration that exceeds its limits the least, at swivel angles and at the ends of arcs.

    Args:
        pose: (4, 4) of the tool.
        swivels: (k,) rad.
        geometry: See `srs_kernels`.
        tool: See `srs_kernels`.
        lower: (7,) joint limits.
        upper: (7,) joint limits.
        best: (8, 7) output.
        best_swivel: (8,) output.
        least: (8,) output: by how much it exceeds them, rad.

    Returns:
        0, TOO_FAR or TOO_NEAR.
    """
    q, over = np.empty((_FOLDS, 7)), np.empty(_FOLDS)
    ends, turnings = np.empty(MOST + 1), np.empty((2, 9, 3))
    least[:] = np.inf
    for elbow in range(2):
        status, q4 = reduce_pose(pose, elbow == 1, geometry, tool, lower, upper, turnings)
        if status != 0:
            return status
        bent = max(lower[3] - q4, q4 - upper[3])
        arcs = _arcs(turnings, geometry, lower, upper, ends)
        for k in range(arcs + swivels.size):
            s = ends[k] if k < arcs else swivels[k - arcs]
            _all_folds(turnings, s, geometry, lower, upper, True, q, over)
            for f in range(_FOLDS):
                branch, e = elbow + 2 * f, max(over[f], bent)
                if e < least[branch]:
                    least[branch], best_swivel[branch] = e, s
                    for i in range(7):
                        best[branch, i] = q4 if i == 3 else q[f, i]
    return 0
