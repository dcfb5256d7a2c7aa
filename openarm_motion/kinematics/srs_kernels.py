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
from numba import njit
from numpy.typing import NDArray

from openarm_common.types import Array

#: Why no configuration exists; 0 when one does.
TOO_FAR, TOO_NEAR = 1, 2
#: Why a line could not be followed.
LIMIT, JUMP = 3, 4
BRANCHES = 8


@njit(cache=True, nogil=True)
def _cross(a: Array, b: Array) -> Array:
    out = np.empty(3)
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


@njit(cache=True, nogil=True)
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def _turn(w: Array, angle: float, v: Array) -> Array:
    """Turn vector `v` about the unit axis `w` (Rodrigues)."""
    c, s = math.cos(angle), math.sin(angle)
    k = _dot(w, v) * (1.0 - c)
    out = np.empty(3)
    out[0] = c * v[0] + s * (w[1] * v[2] - w[2] * v[1]) + k * w[0]
    out[1] = c * v[1] + s * (w[2] * v[0] - w[0] * v[2]) + k * w[1]
    out[2] = c * v[2] + s * (w[0] * v[1] - w[1] * v[0]) + k * w[2]
    return out


@njit(cache=True, nogil=True)
def _angle_about(w: Array, a: Array, b: Array) -> float:
    """Angle that turns `a` to `b` about `w`, seen along `w`; 0 when either is parallel to it."""
    wa, wb = _dot(w, a), _dot(w, b)
    s = _dot(w, _cross(a, b))
    c = _dot(a, b) - wa * wb
    if s * s + c * c < 1e-20:
        return 0.0
    return math.atan2(s, c)


@njit(cache=True, nogil=True)
def _apply(r: Array, v: Array) -> Array:
    out = np.empty(3)
    for i in range(3):
        out[i] = r[i, 0] * v[0] + r[i, 1] * v[1] + r[i, 2] * v[2]
    return out


@njit(cache=True, nogil=True)
def _three_angles(r: Array, w1: Array, w2: Array, w3: Array, other: bool, out: Array) -> None:
    """Angles of ``R = exp(w1 a) exp(w2 b) exp(w3 c)``, consecutive axes perpendicular; `other` picks the second b."""
    v = _apply(r, w3)
    target = _dot(w1, v)
    p, q = _dot(w1, w3), _dot(w1, _cross(w2, w3))
    size = math.sqrt(p * p + q * q)
    half = math.acos(min(1.0, max(-1.0, target / size)))
    b = math.atan2(q, p) + (half if other else -half)
    a = _angle_about(w1, _turn(w2, b, w3), v)
    # any vector perpendicular to w3 shows the last angle
    x = _cross(w3, w1) if abs(p) < 0.9 else _cross(w3, w2)
    y = _turn(w2, -b, _turn(w1, -a, _apply(r, x)))
    out[0], out[1], out[2] = a, b, _angle_about(w3, x, y)


@njit(cache=True, nogil=True)
def _into(angle: float, lower: float, upper: float) -> float:
    """The turn of `angle` that lies nearest to the middle of a range."""
    middle = 0.5 * (lower + upper)
    return angle - 2.0 * math.pi * math.floor((angle - middle) / (2.0 * math.pi) + 0.5)


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def solve(
    pose: Array, swivel: float, branch: int, geometry: Array, tool: Array, lower: Array, upper: Array, q: Array
) -> int:
    """Configuration `q` (7,) of one branch, whatever the limits; returns 0, TOO_FAR or TOO_NEAR.

    Each angle is given in the turn nearest to the middle of its limits.
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
        return TOO_FAR
    if ratio < -1.0:
        return TOO_NEAR
    half = math.acos(min(1.0, ratio))
    q[3] = _into(math.atan2(s, c) + (-half if branch & 1 else half), lower[3], upper[3])
    fore = _turn(w4, q[3], fore_arm)
    v = upper_arm + fore
    length = math.sqrt(_dot(v, v))
    if length < 1e-9:
        return TOO_NEAR
    size = math.sqrt(nn)
    for i in range(3):
        v[i] /= length
        n[i] /= size
    side = _cross(w4, v)
    bend = _dot(upper_arm, side)
    if abs(bend) < 1e-9:  # a straight elbow bends where this branch would bend it
        bend = -geometry[11, 0] if branch & 1 else geometry[11, 0]
    down, across = _swivel_frame(n)
    cs, sn = math.cos(swivel), math.sin(swivel)
    elbow = np.empty(3)
    for i in range(3):
        elbow[i] = cs * down[i] + sn * across[i]
        if bend < 0.0:
            elbow[i] = -elbow[i]
    # R123 takes (v, side, w4) to (n, elbow, n x elbow)
    normal = _cross(n, elbow)
    r = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            r[i, j] = n[i] * v[j] + elbow[i] * side[j] + normal[i] * w4[j]
    angles = np.empty(3)
    _three_angles(r, geometry[0], geometry[1], geometry[2], (branch & 2) != 0, angles)
    for i in range(3):
        q[i] = _into(angles[i], lower[i], upper[i])
    wrist = np.empty((3, 3))
    for j in range(3):
        column = np.empty(3)
        for i in range(3):
            column[i] = r[0, i] * m[0, j] + r[1, i] * m[1, j] + r[2, i] * m[2, j]
        column = _turn(w4, -q[3], column)
        for i in range(3):
            wrist[i, j] = column[i]
    _three_angles(wrist, geometry[4], geometry[5], geometry[6], (branch & 4) != 0, angles)
    for i in range(3):
        q[4 + i] = _into(angles[i], lower[4 + i], upper[4 + i])
    return 0


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _excess(q: Array, lower: Array, upper: Array) -> tuple[float, int]:
    """How far the worst joint is outside its limits (negative inside), and which joint."""
    worst, joint = -np.inf, 0
    for i in range(q.shape[0]):
        e = max(lower[i] - q[i], q[i] - upper[i])
        if e > worst:
            worst, joint = e, i
    return worst, joint


@njit(cache=True, nogil=True)
def sweep(
    pose: Array,
    swivels: Array,
    geometry: Array,
    tool: Array,
    lower: Array,
    upper: Array,
    margin: float,
    found: Array,
    found_swivel: Array,
    found_branch: NDArray[np.int64],
    nearest: Array,
) -> tuple[int, int, float]:
    """All branches at all swivel angles.

    Args:
        pose: (4, 4) of the tool.
        swivels: (k,) rad.
        geometry: See the module's head.
        tool: See the module's head.
        lower: (7,) joint limits.
        upper: (7,) joint limits.
        margin: Kept from the limits, rad.
        found: (8 k, 7) output: configurations within the limits.
        found_swivel: (8 k,) output.
        found_branch: (8 k,) output.
        nearest: (7,) output: the configuration that exceeds its limits the least.

    Returns:
        Number of configurations found; 0, TOO_FAR or TOO_NEAR; by how much the joint that binds exceeds its limit
        in `nearest`, rad.
    """
    count, status, least = 0, 0, np.inf
    q = np.empty(7)
    for k in range(swivels.shape[0]):
        for branch in range(BRANCHES):
            status = solve(pose, swivels[k], branch, geometry, tool, lower, upper, q)
            if status != 0:
                return count, status, least
            worst, _ = _excess(q, lower, upper)
            if worst < least:
                least = worst
                for i in range(7):
                    nearest[i] = q[i]
            if worst <= -margin:
                for i in range(7):
                    found[count, i] = q[i]
                found_swivel[count] = swivels[k]
                found_branch[count] = branch
                count += 1
    return count, 0, least


@njit(cache=True, nogil=True)
def follow(
    poses: Array,
    swivels: Array,
    branch: int,
    geometry: Array,
    tool: Array,
    lower: Array,
    upper: Array,
    max_step: float,
    path: Array,
) -> tuple[int, int, int]:
    """Solve a path of poses (m, 4, 4) on one branch at the swivel angles (m,); fills `path` (m, 7).

    Returns:
        Index of the first pose that fails (m when none does), why (0, TOO_FAR, TOO_NEAR, LIMIT, JUMP), and the joint.
    """
    for k in range(poses.shape[0]):
        status = solve(poses[k], swivels[k], branch, geometry, tool, lower, upper, path[k])
        if status != 0:
            return k, status, 0
        worst, joint = _excess(path[k], lower, upper)
        if worst > 1e-9:
            return k, LIMIT, joint
        if k > 0:
            for i in range(7):
                if abs(path[k, i] - path[k - 1, i]) > max_step:
                    return k, JUMP, i
    return poses.shape[0], 0, 0
