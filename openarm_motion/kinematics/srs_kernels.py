# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the closed-form inverse kinematics of a spherical-revolute-spherical arm.

The arm is described at its zero configuration in the base frame: `geometry` holds, row by row (12, 3),

- 0 to 6: the joint axes w1 to w7,
- 7: the shoulder centre S, where axes 1 to 3 meet,
- 8: from S to the elbow (the point of axis 4 nearest to S),
- 9: from the elbow to the wrist centre W, where axes 5 to 7 meet,
- 10: from W to the tool origin,
- 11: x is the sign of the bend (which side the elbow lies on in the middle of joint 4's range),

and `tool` (3, 3) is the rotation of the tool at zero. With rotations R_i(q_i) about w_i the tool is at
``S + R123 (upper + R4 (fore + R567 tool_offset))`` with rotation ``R123 R4 R567 tool``.

The one free parameter is the swivel angle: the elbow turned about the line from shoulder to wrist, right-handed, 0
where the elbow is lowest (base -z). For each swivel there are eight branches: bit 0 bends the elbow the other way, bits
1 and 2 fold the middle joint of the shoulder and of the wrist to the other side.
"""

from __future__ import annotations

import math

import numpy as np

from openarm_common.kernels import kernel
from openarm_common.types import Array

#: Why no configuration exists; 0 when one does.
TOO_FAR, TOO_NEAR = 1, 2
#: Why a line could not be followed.
LIMIT, JUMP = 3, 4
BRANCHES = 8


@kernel
def _cross(a: Array, b: Array) -> Array:
    out = np.empty(3)
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


@kernel
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _turn(w: Array, angle: float, v: Array) -> Array:
    """Turn vector `v` about the unit axis `w` (Rodrigues)."""
    c, s = math.cos(angle), math.sin(angle)
    k = _dot(w, v) * (1.0 - c)
    out = np.empty(3)
    out[0] = c * v[0] + s * (w[1] * v[2] - w[2] * v[1]) + k * w[0]
    out[1] = c * v[1] + s * (w[2] * v[0] - w[0] * v[2]) + k * w[1]
    out[2] = c * v[2] + s * (w[0] * v[1] - w[1] * v[0]) + k * w[2]
    return out


@kernel
def _apply(r: Array, v: Array) -> Array:
    out = np.empty(3)
    for i in range(3):
        out[i] = r[i, 0] * v[0] + r[i, 1] * v[1] + r[i, 2] * v[2]
    return out


@kernel
def _into(angle: float, lower: float, upper: float) -> float:
    """The turn of `angle` that lies nearest to the middle of a range."""
    middle = 0.5 * (lower + upper)
    return angle - 2.0 * math.pi * math.floor((angle - middle) / (2.0 * math.pi) + 0.5)


@kernel
def _swivel_frame(n: Array) -> tuple[Array, Array]:
    """Directions of the elbow at swivel 0 (lowest) and at a quarter turn, both perpendicular to `n`."""
    e = np.empty(3)
    e[0], e[1], e[2] = n[2] * n[0], n[2] * n[1], n[2] * n[2] - 1.0
    size = math.sqrt(_dot(e, e))
    if size < 1e-6:  # the wrist straight above or below the shoulder: base x takes the place of down
        e[0], e[1], e[2] = 1.0 - n[0] * n[0], -n[0] * n[1], -n[0] * n[2]
        size = math.sqrt(_dot(e, e))
    for i in range(3):
        e[i] /= size
    return e, _cross(n, e)


@kernel
def _turning(u: Array, n: Array, x: Array, out: Array) -> None:
    """Fill `out` (3,) with the c, a, b of ``u . exp(n s) x = c + a cos s + b sin s``."""
    out[0] = _dot(u, n) * _dot(n, x)
    out[1] = _dot(u, x) - out[0]
    out[2] = _dot(u, _cross(n, x))


@kernel
def _turnings(n: Array, r: Array, w1: Array, w2: Array, w3: Array, out: Array) -> None:
    """Fill `out` (9, 3) with the coefficients of all that the angles of three joints with ``R = exp(n s) r`` need."""
    across, after = _cross(w1, w2), _cross(w2, w3)
    second, third, normal = _apply(r, w2), _apply(r, w3), _apply(r, after)
    _turning(w1, n, third, out[0])
    _turning(w2, n, third, out[1])
    _turning(across, n, third, out[2])
    _turning(w1, n, second, out[3])
    _turning(w1, n, normal, out[4])
    _turning(w2, n, second, out[5])
    _turning(across, n, second, out[6])
    _turning(w2, n, normal, out[7])
    _turning(across, n, normal, out[8])


@kernel
def reduce_pose(
    pose: Array, bent: bool, geometry: Array, tool: Array, lower: Array, upper: Array, turnings: Array
) -> tuple[int, float]:
    """Solve a pose for joint 4, and for what tells the other angles at a swivel angle s (Shimizu et al. 2008).

    With axes w1, w2, w3 of shoulder or wrist and its rotation R, a row of `turnings` holds the c, a, b of
    ``c + a cos s + b sin s``, which is: 0 to 2, w1, w2 and w1 x w2 times R w3; 3 and 4, w1 times R w2 and R (w2 x w3);
    5 and 6, w2 and w1 x w2 times R w2; 7 and 8, the same times R (w2 x w3).

    Args:
        pose: (4, 4) of the tool.
        bent: The elbow bends the other way.
        geometry: See the module's head.
        tool: See the module's head.
        lower: (7,) joint limits.
        upper: (7,) joint limits.
        turnings: (2, 9, 3) output: of shoulder and wrist.

    Returns:
        0, TOO_FAR or TOO_NEAR; joint 4, whatever its limits.
    """
    m = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            m[i, j] = pose[i, 0] * tool[j, 0] + pose[i, 1] * tool[j, 1] + pose[i, 2] * tool[j, 2]
    reach = _apply(m, geometry[10])
    n = np.empty(3)
    for i in range(3):
        n[i] = pose[i, 3] - reach[i] - geometry[7, i]
    upper_arm, fore_arm, w4 = geometry[8], geometry[9], geometry[3]
    uu, ff, nn = _dot(upper_arm, upper_arm), _dot(fore_arm, fore_arm), _dot(n, n)
    # |upper + R4 fore|^2 = uu + ff + 2 (c cos q4 + s sin q4), both perpendicular to w4
    c, s = _dot(upper_arm, fore_arm), _dot(upper_arm, _cross(w4, fore_arm))
    size = math.sqrt(c * c + s * s)
    ratio = (nn - uu - ff) / (2.0 * size)
    if ratio > 1.0 + 1e-12:
        return TOO_FAR, 0.0
    if ratio < -1.0 - 1e-12:
        return TOO_NEAR, 0.0
    half = math.acos(min(1.0, max(-1.0, ratio)))
    q4 = _into(math.atan2(s, c) + (-half if bent else half), lower[3], upper[3])
    v = upper_arm + _turn(w4, q4, fore_arm)
    length = math.sqrt(_dot(v, v))
    if length < 1e-9:
        return TOO_NEAR, 0.0
    size = math.sqrt(nn)
    for i in range(3):
        v[i] /= length
        n[i] /= size
    side = _cross(w4, v)
    bend = _dot(upper_arm, side)
    if abs(bend) < 1e-9:  # a straight elbow bends where this branch would bend it
        bend = -geometry[11, 0] if bent else geometry[11, 0]
    elbow, _ = _swivel_frame(n)
    if bend < 0.0:
        elbow = -elbow
    # at swivel 0 R123 takes (v, side, w4) to (n, elbow, n x elbow)
    normal = _cross(n, elbow)
    r, wrist, column = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for i in range(3):
        for j in range(3):
            r[i, j] = n[i] * v[j] + elbow[i] * side[j] + normal[i] * w4[j]
    for j in range(3):
        for i in range(3):
            column[i] = r[0, i] * m[0, j] + r[1, i] * m[1, j] + r[2, i] * m[2, j]
        turned = _turn(w4, -q4, column)
        for i in range(3):
            wrist[i, j] = turned[i]
    _turnings(n, r, geometry[0], geometry[1], geometry[2], turnings[0])
    # seen from the forearm the hand turns the other way about the same line
    _turnings(-_turn(w4, -q4, v), wrist, geometry[4], geometry[5], geometry[6], turnings[1])
    return 0, q4


@kernel
def middle_zero(w1: Array, w2: Array, w3: Array) -> float:
    """Angle of the middle joint of three at which the outer axes w1 and w3 are parallel, rad."""
    return math.atan2(_dot(w1, _cross(w2, w3)), _dot(w1, w3))


@kernel
def _at(row: Array, cs: float, sn: float) -> float:
    return row[0] + row[1] * cs + row[2] * sn


@kernel
def fold(
    turnings: Array,
    swivel: float,
    first: int,
    other: bool,
    geometry: Array,
    lower: Array,
    upper: Array,
    q: Array,
) -> float:
    """Fill three joints of `q` (7,) at a swivel angle: R is ``exp(w1 a) exp(w2 b) exp(w3 c)``, of which there are two.

    Args:
        turnings: (9, 3), see `reduce_pose`.
        swivel: rad.
        first: 0 for the shoulder, 4 for the wrist.
        other: The middle joint is folded to the other side.
        geometry: See the module's head.
        lower: (7,) limits.
        upper: (7,) limits.
        q: Output; each angle in the turn nearest to the middle of its limits.

    Returns:
        How far the worst of the three is outside its limits, rad; negative inside.
    """
    cs, sn = math.cos(swivel), math.sin(swivel)
    sign = 1.0 if other else -1.0
    y, x = sign * _at(turnings[1], cs, sn), -sign * _at(turnings[2], cs, sn)
    size = math.sqrt(x * x + y * y)
    half = math.atan2(size, _at(turnings[0], cs, sn))
    # a is free where the outer axes are parallel; c makes up for whatever it is
    if size > 1e-14:
        x, y = x / size, y / size
    else:
        x, y = 1.0, 0.0
    q[first] = math.atan2(y, x)
    q[first + 1] = middle_zero(geometry[first], geometry[first + 1], geometry[first + 2]) + sign * half
    q[first + 2] = math.atan2(
        x * _at(turnings[7], cs, sn) + y * _at(turnings[8], cs, sn),
        x * _at(turnings[5], cs, sn) + y * _at(turnings[6], cs, sn),
    )
    worst = -np.inf
    for i in range(first, first + 3):
        q[i] = _into(q[i], lower[i], upper[i])
        worst = max(worst, lower[i] - q[i], q[i] - upper[i])
    return worst


@kernel
def solve(
    pose: Array, swivel: float, branch: int, geometry: Array, tool: Array, lower: Array, upper: Array, q: Array
) -> int:
    """Configuration `q` (7,) of one branch, whatever the limits; returns 0, TOO_FAR or TOO_NEAR.

    Each angle is given in the turn nearest to the middle of its limits.
    """
    turnings = np.empty((2, 9, 3))
    status, q4 = reduce_pose(pose, (branch & 1) != 0, geometry, tool, lower, upper, turnings)
    if status == 0:
        q[3] = q4
        fold(turnings[0], swivel, 0, (branch & 2) != 0, geometry, lower, upper, q)
        fold(turnings[1], swivel, 4, (branch & 4) != 0, geometry, lower, upper, q)
    return status


@kernel
def swivel_of(q: Array, geometry: Array) -> float:
    """Swivel angle of a configuration, rad in (-pi, pi]."""
    w4 = geometry[3]
    v = geometry[8] + _turn(w4, q[3], geometry[9])
    side = _cross(w4, v)
    bend = _dot(geometry[8], side)
    if abs(bend) < 1e-9:
        bend = geometry[11, 0]
    for i in range(2, -1, -1):
        v = _turn(geometry[i], q[i], v)
        side = _turn(geometry[i], q[i], side)
    length = math.sqrt(_dot(v, v))
    for i in range(3):
        v[i] /= length
        if bend < 0.0:
            side[i] = -side[i]
    down, across = _swivel_frame(v)
    return math.atan2(_dot(across, side), _dot(down, side))


@kernel
def _excess(q: Array, lower: Array, upper: Array) -> tuple[float, int]:
    """How far the worst joint is outside its limits (negative inside), and which joint."""
    worst, joint = -np.inf, 0
    for i in range(q.shape[0]):
        e = max(lower[i] - q[i], q[i] - upper[i])
        if e > worst:
            worst, joint = e, i
    return worst, joint


@kernel
def follow(
    poses: Array,
    swivels: Array,
    start: Array,
    branch: int,
    geometry: Array,
    tool: Array,
    lower: Array,
    upper: Array,
    max_step: float,
    path: Array,
) -> tuple[int, int, int]:
    """Solve a path of poses (m, 4, 4) on one branch at the swivel angles (m,); fills `path` (m, 7).

    Each angle is given in the turn nearest to the one before, the first to that of `start` (7,), where limits let it.

    Returns:
        Index of the first pose that fails (m when none does), why (0, TOO_FAR, TOO_NEAR, LIMIT, JUMP), and the joint.
    """
    for k in range(poses.shape[0]):
        status = solve(poses[k], swivels[k], branch, geometry, tool, lower, upper, path[k])
        if status != 0:
            return k, status, 0
        before = path[k - 1] if k > 0 else start
        for i in range(7):
            q = path[k, i] - 2.0 * math.pi * math.floor((path[k, i] - before[i]) / (2.0 * math.pi) + 0.5)
            if lower[i] <= q <= upper[i]:
                path[k, i] = q
        worst, joint = _excess(path[k], lower, upper)
        if worst > 1e-9:
            return k, LIMIT, joint
        if k > 0:
            for i in range(7):
                if abs(path[k, i] - path[k - 1, i]) > max_step:
                    return k, JUMP, i
    return poses.shape[0], 0, 0
