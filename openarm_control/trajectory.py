# SPDX-License-Identifier: Apache-2.0
"""Joint trajectories as a controller takes them: checked against the joints they are for, and a spline through them.

Times are seconds from the start of the trajectory; positions rad (m), velocities rad/s (m/s), accelerations rad/s²
(m/s²), all (n points, k joints).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

#: A limit that was rounded in a file or a message is still kept, rad or m.
LIMIT_SLACK = 1e-4
#: A trajectory ends at rest; what a planner leaves as rounding is allowed, rad/s.
_END_VELOCITY = 1e-2


class TrajectoryResult(IntEnum):
    """How a trajectory ended; numbers as in control_msgs/FollowJointTrajectory."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5
    #: The emergency stop; the number is of this suite, control_msgs has none.
    STOPPED = -100


class TrajectoryError(OpenArmError):
    """A trajectory that will not be followed, with the result that the controller reports."""

    def __init__(
        self,
        message: str,
        result: TrajectoryResult = TrajectoryResult.INVALID_GOAL,
        *,
        code: Code = Code.INVALID_ARGUMENT,
    ) -> None:
        super().__init__(code, message)
        self.result = result


@dataclass(frozen=True, eq=False)
class JointGroup:
    """The joints of one controller; arrays (k,), rad or m, rad/s or m/s.

    Attributes:
        lever: Motion of a finger for that of the gripper's joint, m/m or m/rad; negative where it opens downwards.
    """

    names: tuple[str, ...]
    lower: Array
    upper: Array
    max_velocity: Array
    lever: float = 1.0


def limits_of(*groups: JointGroup) -> dict[str, tuple[float, float]]:
    """Return the lower and upper limit of each joint of groups."""
    return {
        name: (float(lower), float(upper))
        for group in groups
        for name, lower, upper in zip(group.names, group.lower, group.upper, strict=True)
    }


@dataclass(frozen=True)
class Trajectory:
    """Points to pass, and how closely: tolerances by joint, rad or m; 0 is the controller's default, below 0 no bound.

    Args:
        names: Joints, in any order.
        t: (n,) times.
        q: (n, k) positions.
        v: (n, k) velocities, or None.
        a: (n, k) accelerations, or None; used with velocities only.
        start_ns: Simulated time of the start; 0 is as soon as possible.
        path_tolerance: While moving.
        goal_tolerance: Tolerance at the end.
        goal_time_s: Time after the end in which it must be reached; 0: the controller's default, negative: no limit.
    """

    names: tuple[str, ...]
    t: Array
    q: Array
    v: Array | None = None
    a: Array | None = None
    start_ns: int = 0
    path_tolerance: Mapping[str, float] = field(default_factory=dict[str, float])
    goal_tolerance: Mapping[str, float] = field(default_factory=dict[str, float])
    goal_time_s: float = 0.0


def checked(trajectory: Trajectory, group: JointGroup) -> Trajectory:
    """Return the trajectory with its columns in the order of `group`.

    Raises:
        TrajectoryError: INVALID_JOINTS for missing, unknown or duplicate joints; INVALID_GOAL for no points, times
            that do not increase, values that are not finite, positions out of limits, speeds beyond the limits, and a
            trajectory that does not end at rest. The message names the joint and the value.
    """
    order = _order(trajectory.names, group)
    t = np.asarray(trajectory.t, dtype=np.float64)
    if t.size == 0:
        raise TrajectoryError("the trajectory has no points, expected at least one")
    q = _column(trajectory.q, t.size, order, group, "position")
    v = None if trajectory.v is None else _column(trajectory.v, t.size, order, group, "velocity")
    a = None if trajectory.a is None or v is None else _column(trajectory.a, t.size, order, group, "acceleration")
    _check_times(t)
    _check_limits(q, group)
    check_speed(t, q, v, group.max_velocity, group)
    for what, tolerances in (("path", trajectory.path_tolerance), ("goal", trajectory.goal_tolerance)):
        for name, tolerance in tolerances.items():
            if name not in group.names or not np.isfinite(tolerance):
                raise TrajectoryError(
                    f"{what} tolerance {tolerance} of joint {name!r}: expected a number for one of"
                    f" {', '.join(group.names)}",
                )
    return replace(trajectory, names=group.names, t=t, q=q, v=v, a=a)


def _order(names: Sequence[str], group: JointGroup) -> list[int]:
    duplicate = [name for name, n in Counter(names).items() if n > 1]
    unknown = [name for name in names if name not in group.names]
    missing = [name for name in group.names if name not in names]
    for fault, which in (("unknown", unknown), ("duplicate", duplicate), ("missing", missing)):
        if which:
            raise TrajectoryError(
                f"{fault} joint {', '.join(repr(name) for name in which)} in the trajectory; expected each of"
                f" {', '.join(group.names)} once",
                TrajectoryResult.INVALID_JOINTS,
            )
    return [list(names).index(name) for name in group.names]


def _column(values: Array, points: int, order: list[int], group: JointGroup, what: str) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (points, len(order)):
        raise TrajectoryError(f"{what} array of shape {array.shape}, expected ({points}, {len(order)})")
    array = array[:, order]
    bad = np.argwhere(~np.isfinite(array))
    if bad.size:
        i, j = bad[0]
        raise TrajectoryError(
            f"{what} of {group.names[j]} at point {i} is {array[i, j]}, expected a finite number",
        )
    return array


def _check_times(t: Array) -> None:
    if not np.all(np.isfinite(t)) or t[0] < 0.0:
        raise TrajectoryError(f"time of point 0 is {t[0]} s, expected 0 or more")
    late = np.flatnonzero(np.diff(t) <= 0.0)
    if late.size:
        i = int(late[0])
        raise TrajectoryError(
            f"time of point {i + 1} is {t[i + 1]:.6f} s after {t[i]:.6f} s of point {i}, expected strictly increasing"
            " times",
        )


def _check_limits(q: Array, group: JointGroup) -> None:
    out = np.argwhere((q < group.lower - LIMIT_SLACK) | (q > group.upper + LIMIT_SLACK))
    if out.size:
        i, j = out[0]
        raise TrajectoryError(
            f"position of {group.names[j]} at point {i} is {q[i, j]:.4f}, out of its limits {group.lower[j]:.4f} to"
            f" {group.upper[j]:.4f}",
            code=Code.LIMITS,
        )


def check_speed(t: Array, q: Array, v: Array | None, fastest: Array, group: JointGroup, why: str = "") -> None:
    """Refuse a trajectory that is too fast or does not end at rest; `why` follows the limit in the message.

    Raises:
        TrajectoryError: INVALID_GOAL, naming joint, place and speed.
    """
    between = np.abs(np.diff(q, axis=0)) / np.diff(t)[:, None]
    at = np.zeros_like(q) if v is None else np.abs(v)
    for speeds, where in ((between, "between point {0} and the next"), (at, "at point {0}")):
        fast = np.argwhere(speeds > fastest * (1.0 + 1e-6))
        if fast.size:
            i, j = fast[0]
            raise TrajectoryError(
                f"{group.names[j]} would have to move at {speeds[i, j]:.2f} rad/s {where.format(i)}, its limit is"
                f" {fastest[j]:.2f}{why}",
                code=Code.LIMITS,
            )
    moving = np.flatnonzero(at[-1] > _END_VELOCITY)
    if moving.size:
        j = int(moving[0])
        raise TrajectoryError(
            f"velocity of {group.names[j]} at the last point is {at[-1, j]:.3f} rad/s, expected 0: a trajectory ends at"
            " rest",
        )


class JointSpline:
    """Curve through points: quintic where accelerations are given, cubic with velocities, else straight pieces.

    Args:
        t: (n,) times, strictly increasing.
        q: (n, k) positions.
        v: (n, k) velocities, or None.
        a: (n, k) accelerations, or None.
    """

    def __init__(self, t: Array, q: Array, v: Array | None = None, a: Array | None = None) -> None:
        self._t = t
        self._last = q[-1].copy()
        self._first = q[0].copy()
        self._c = _coefficients(t, q, v, a)
        self._powers = np.arange(self._c.shape[1])

    @property
    def end_s(self) -> float:
        """Time of the last point."""
        return float(self._t[-1])

    def sample(self, t: float) -> tuple[Array, Array]:
        """Return the position and velocity (k,) at a time; at rest before the first and after the last point."""
        if t >= self._t[-1]:
            return self._last.copy(), np.zeros_like(self._last)
        i = int(np.searchsorted(self._t, t, side="right")) - 1
        if i < 0:
            return self._first.copy(), np.zeros_like(self._first)
        s = (t - self._t[i]) ** self._powers
        c = self._c[i]
        return s @ c, (s[:-1] * self._powers[1:]) @ c[1:]


def _coefficients(t: Array, q: Array, v: Array | None, a: Array | None) -> Array:
    """Polynomials (n - 1, degree + 1, k) in the time since the beginning of each piece."""
    T = np.diff(t)[:, None]
    d = np.diff(q, axis=0)
    if v is None:
        return np.stack([q[:-1], d / T], axis=1)
    v0, v1 = v[:-1], v[1:]
    if a is None:
        return np.stack([q[:-1], v0, (3 * d / T - 2 * v0 - v1) / T, (v0 + v1 - 2 * d / T) / T**2], axis=1)
    a0, a1 = a[:-1], a[1:]
    c3 = (20 * d - (8 * v1 + 12 * v0) * T - (3 * a0 - a1) * T**2) / (2 * T**3)
    c4 = (-30 * d + (14 * v1 + 16 * v0) * T + (3 * a0 - 2 * a1) * T**2) / (2 * T**4)
    c5 = (12 * d - 6 * (v1 + v0) * T + (a1 - a0) * T**2) / (2 * T**5)
    return np.stack([q[:-1], v0, a0 / 2, c3, c4, c5], axis=1)
