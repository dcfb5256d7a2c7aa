# SPDX-License-Identifier: Apache-2.0
"""Jerk-limited timing of joint paths.

A path is followed exactly; only its speed is chosen, as pieces of constant jerk (`speed_kernels`). Samples lie at the
ends of those pieces and between, with velocities and accelerations, so that a follower's quintic interpolation is the
profile itself on a straight joint line. Times are whole nanoseconds, as messages have them. s, rad, rad/s, rad/s²,
rad/s³.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicHermiteSpline, make_interp_spline

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.timing import speed_kernels as kernels

#: Samples of a path at which limits are checked first.
_FINE = 400
#: A path shorter than this, rad or m, is none.
_NOTHING = 1e-9
#: Share of the jerk that the rounding of times to nanoseconds may add.
_ROUNDING = 1e-4
#: Points of an interval between two samples at which its velocity is taken.
_POINTS = 8


class JointLimits(NamedTuple):
    """Velocity, acceleration and jerk limits of the joints, (n,) each."""

    velocity: Array
    acceleration: Array
    jerk: Array

    def scaled(self, velocity: float, acceleration: float | None = None) -> JointLimits:
        """The limits times a scale; another one for acceleration and jerk where it is given.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when one is not in (0, 1].
        """
        changes = velocity if acceleration is None else acceleration
        for scale, what in ((velocity, "velocity"), (changes, "acceleration")):
            if not 0.0 < scale <= 1.0:
                raise OpenArmError(Code.INVALID_ARGUMENT, f"{what}_scale is {scale}, expected 0 < scale <= 1")
        return JointLimits(self.velocity * velocity, self.acceleration * changes, self.jerk * changes)


@dataclass(frozen=True, eq=False)
class Motion:
    """Positions (m, n) of the joints `names` at times (m,), in between as a controller interpolates.

    With velocities and accelerations (m, n) that is quintic, with velocities alone cubic, without either linear.
    """

    names: tuple[str, ...]
    t: Array
    q: Array
    v: Array | None = None
    a: Array | None = None

    @property
    def duration(self) -> float:
        """Time of the last point, s."""
        return float(self.t[-1])

    def joints_at(self, t: float) -> dict[str, float]:
        """Positions by joint name; held beyond the ends."""
        return dict(zip(self.names, self.states(np.array([t]))[0].tolist(), strict=True))

    def states(self, times: Array) -> Array:
        """Positions (k, n) at times (k,); held beyond the ends."""
        if self.t.size == 1:
            return np.repeat(self.q, times.size, axis=0)
        if self.v is not None and self.a is not None:
            return Trajectory(self.names, self.t, self.q, self.v, self.a).at(times)[0]
        if self.v is not None:
            return np.asarray(CubicHermiteSpline(self.t, self.q, self.v)(np.clip(times, self.t[0], self.t[-1])))
        return np.stack([np.interp(times, self.t, column) for column in self.q.T], axis=1)

    def of(self, names: tuple[str, ...]) -> Self:
        """The motion of some of its joints."""
        k = [self.names.index(name) for name in names]
        v, a = (None if x is None else x[:, k] for x in (self.v, self.a))
        return replace(self, names=names, q=self.q[:, k], v=v, a=a)

    def later(self, seconds: float) -> Motion:
        """The same, begun later; the arm rests before."""
        return replace(self, t=self.t + seconds)


@dataclass(frozen=True, eq=False)
class Trajectory(Motion):
    """A motion that is planned: with velocities and accelerations (m, n), its times begin at 0."""

    v: Array = field()
    a: Array = field()

    def at(self, t: ArrayLike) -> tuple[Array, Array, Array]:
        """Positions, velocities, accelerations (k, n) at times (k,), by quintic interpolation; held beyond the ends."""
        times = np.clip(np.atleast_1d(np.asarray(t, dtype=np.float64)), self.t[0], self.t[-1])
        if self.t.size == 1:
            q, v, a = (np.repeat(x, times.size, axis=0) for x in (self.q, self.v, self.a))
            return q, v, a
        i = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, self.t.size - 2)
        h = (self.t[i + 1] - self.t[i])[:, None]
        u = (times - self.t[i])[:, None] / h
        q0, v0, a0, c3, c4, c5 = self.coefficients(i)
        q = q0 + u * (v0 + u * (0.5 * a0 + u * (c3 + u * (c4 + u * c5))))
        v = (v0 + u * (a0 + u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5)))) / h
        a = (a0 + u * (6.0 * c3 + u * (12.0 * c4 + u * 20.0 * c5))) / (h * h)
        return q, v, a

    def between(self, first: int, last: int) -> Trajectory:
        """The part from one sample to another, at the same times."""
        k = slice(first, last + 1)
        return replace(self, t=self.t[k], q=self.q[k], v=self.v[k], a=self.a[k])

    def coefficients(self, i: NDArray[np.int64]) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Of the intervals that begin at samples `i` (k,), by the share u of each that has passed; (k, n) each.

        Returns:
            Position, velocity, acceleration at the begin, and the factors of u³, u⁴ and u⁵ in the position.
        """
        h = (self.t[i + 1] - self.t[i])[:, None]
        q0, v0, a0 = self.q[i], self.v[i] * h, self.a[i] * h * h
        dq, v1, a1 = self.q[i + 1] - q0, self.v[i + 1] * h, self.a[i + 1] * h * h
        c3 = 10.0 * dq - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1
        c4 = -15.0 * dq + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1
        c5 = 6.0 * dq - 3.0 * (v0 + v1) - 0.5 * (a0 - a1)
        return q0, v0, a0, c3, c4, c5


@dataclass(frozen=True, eq=False)
class Profile:
    """Pieces of constant jerk that begin at `t` (k,) with positions, velocities, accelerations and jerks (k, n)."""

    t: Array
    q: Array
    v: Array
    a: Array
    j: Array
    duration: float

    @classmethod
    def of(cls, q: Array, pieces: Sequence[tuple[float, Array]]) -> Profile:
        """From rest at `q` (n,) by pieces: their duration, s, and jerk (n,)."""
        state = np.zeros((len(pieces) + 1, 3, q.size))
        state[0, 0] = q
        for k, (h, j) in enumerate(pieces):
            q, v, a = state[k]
            state[k + 1] = q + h * (v + h * (0.5 * a + h * j / 6.0)), v + h * (a + 0.5 * h * j), a + h * j
        t = np.concatenate([[0.0], np.cumsum([h for h, _ in pieces])])
        q, v, a = (state[:-1, k] for k in range(3))
        return cls(t[:-1], q, v, a, np.array([j for _, j in pieces]), float(t[-1]))

    def at(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """Positions, velocities, accelerations, jerks (k, n) at times (k,)."""
        i = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, self.t.size - 1)
        h = (np.clip(t, 0.0, self.duration) - self.t[i])[:, None]
        q, v, a, j = self.q[i], self.v[i], self.a[i], self.j[i]
        return (
            q + h * (v + h * (0.5 * a + h * j / 6.0)),
            v + h * (a + 0.5 * h * j),
            a + h * j,
            j,
        )

    def slower(self, factor: float) -> Profile:
        """The same way in `factor` times the time."""
        k = factor
        return Profile(self.t * k, self.q, self.v / k, self.a / k**2, self.j / k**3, self.duration * k)

    def times(self, period: float) -> Array:
        """The borders of the pieces and times between them, no further than `period` apart, in whole nanoseconds."""
        return split(np.append(self.t, self.duration), period)


def profile(length: float, velocity: float, acceleration: float, jerk: float) -> Profile:
    """Fastest way (n = 1) from rest to rest over `length` within the limits.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when a limit is not positive.
    """
    if not min(length, velocity, acceleration, jerk) > 0.0:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"length {length:g}, velocity {velocity:g}, acceleration {acceleration:g}, jerk {jerk:g}: expected all > 0",
        )
    limits = JointLimits(*(np.array([limit]) for limit in (velocity, acceleration, jerk)))
    return polyline_profile(np.array([[0.0], [length]]), limits, np.empty(0))[0]


def polyline_profile(waypoints: Array, limits: JointLimits, caps: Array) -> tuple[Profile, Array]:
    """Fast way from rest to rest along straight joint segments, its corners rounded within their triangles.

    Args:
        waypoints: (m, n) rad, each at another place than the one before, m >= 2.
        limits: Limits that no joint exceeds.
        caps: (m - 2,) share of the greatest speed that is allowed in each corner; 0 is a stop.

    Returns:
        The profile, and the moments (m - 2,) at which it is in the corners, s.
    """
    segments, stacked = np.diff(waypoints, axis=0), np.stack(limits)
    most = np.min(stacked / np.maximum(np.abs(segments), 1e-12)[:, None, :], axis=2)
    speeds = kernels.choose(segments, most, caps, stacked)[0]
    rest = np.zeros(waypoints.shape[1])
    pieces: list[tuple[float, Array]] = []
    corners: list[float] = []

    def change(difference: Array, until: float, rise: float) -> None:
        if until > 0.0:
            jerk = difference / (until * rise)
            pieces.extend([(rise, jerk), (until - rise, rest), (rise, -jerk)])

    first, head = 0.0, 0.0  # the speed after the last corner, and half of its time
    for k, segment in enumerate(segments):
        rounded = k < len(speeds)
        around = kernels.corner(segment, segments[k + 1], speeds[k], stacked) if rounded else (0.0, 0.0)
        last, tail = float(speeds[k, 0]) if rounded else 0.0, 0.5 * sum(around)
        time, peak = kernels.segment(first, last, 1.0 - head * first - tail * last, most[k])
        rise, fall = (kernels.change(abs(peak - r) / most[k, 1], abs(peak - r) / most[k, 2]) for r in (first, last))
        change((peak - first) * segment, *rise)
        pieces.append((time - sum(rise) - sum(fall), rest))
        change((last - peak) * segment, *fall)
        if rounded:
            corners.append(sum(h for h, _ in pieces) + tail)
            first, head = float(speeds[k, 1]), tail
            change(first * segments[k + 1] - last * segment, *around)
    return Profile.of(waypoints[0], [piece for piece in pieces if piece[0] > 0.0]), np.array(corners)


def time_polyline(names: Sequence[str], waypoints: Array, limits: JointLimits, period: float = 0.02) -> Trajectory:
    """Time straight joint segments, each from rest to rest.

    Args:
        names: Joints.
        waypoints: (m, n) rad.
        limits: Limits that no joint exceeds.
        period: Greatest time between two samples, s.
    """
    return time_rounded(names, waypoints, limits, np.zeros(len(waypoints)), period)[0]


def time_rounded(
    names: Sequence[str], waypoints: Array, limits: JointLimits, caps: Array, period: float = 0.02
) -> tuple[Trajectory, Array]:
    """Time straight joint segments, corners rounded.

    Args:
        names: Joints.
        waypoints: (m, n) rad.
        limits: Limits that no joint exceeds.
        caps: (m,) share of the greatest speed that is allowed in each way point between the ends; 0 is a stop.
        period: Greatest time between two samples, s.

    Returns:
        The trajectory, and the moments (m,) at which it is in the way points, s.
    """
    real = distinct(waypoints)
    if not real[1:].any():
        return resting(names, waypoints[0], period), np.zeros(len(waypoints))
    path = waypoints[real]
    way, corners = polyline_profile(path, limits._replace(jerk=limits.jerk * (1.0 - _ROUNDING)), caps[real][1:-1])
    t = way.times(period)
    q, v, a, _ = way.at(t)
    q += (waypoints[-1] - q[-1]) * (t / t[-1])[:, None]  # what rounding has added up to
    times = np.concatenate([[0.0], corners, [way.duration]])
    return at_rest(names, t, q, v, a), times[np.cumsum(real) - 1]


def time_path(
    names: Sequence[str], path: Array, s: Array, limits: JointLimits, speed: float, period: float = 0.02
) -> Trajectory:
    """Time a smooth joint path from rest to rest.

    The limits hold at every moment: a first profile is made from the path's steepest parts, and then slowed down as a
    whole by what curvature and the interpolation between samples add, which scales velocity, acceleration and jerk by
    known powers.

    Args:
        names: Joints.
        path: (m, n) rad, smooth and dense, m >= 6.
        s: (m,) way along the path that rises from 0, for example of the tool, m.
        limits: Limits that no joint exceeds.
        speed: Greatest ds/dt.
        period: Greatest time between two samples, s.
    """
    if s[-1] < _NOTHING:
        return resting(names, path[0], period)
    curve = make_interp_spline(s, path, k=5)
    d1, d2, d3 = (curve.derivative(k) for k in (1, 2, 3))
    fine = np.linspace(0.0, float(s[-1]), _FINE)
    steepest = np.maximum(np.abs(d1(fine)).max(axis=0), 1e-9)
    v, a, j = (float(np.min(limit / steepest)) for limit in limits)
    way = profile(float(s[-1]), min(speed, v), a, j)
    t = np.union1d(np.linspace(0.0, way.duration, _FINE), np.concatenate([way.t, way.t + 1e-9]))
    x, dx, ddx, dddx = way.at(t)
    q1, q2, q3 = d1(x[:, 0]), d2(x[:, 0]), d3(x[:, 0])
    # at the border of two pieces the jerk jumps: the grid holds both sides of it
    peaks = q1 * dx, q2 * dx**2 + q1 * ddx, q3 * dx**3 + 3.0 * q2 * dx * ddx + q1 * dddx
    factor = _slowdown(JointLimits(*(np.abs(peak).max(axis=0) for peak in peaks)), limits)
    while True:
        way = way.slower(factor * (1.0 + 1e-6))
        t = way.times(period)
        x, dx, ddx, _ = way.at(t)
        q1, q2 = d1(x[:, 0]), d2(x[:, 0])
        q = np.asarray(curve(x[:, 0]))
        q[0], q[-1] = path[0], path[-1]
        trajectory = at_rest(names, t, q, q1 * dx, q2 * dx**2 + q1 * ddx)
        factor = _slowdown(greatest(trajectory), limits)
        if factor <= 1.0:
            return trajectory


def greatest(trajectory: Trajectory) -> JointLimits:
    """Bounds of the velocity, acceleration and jerk of each joint as interpolated, which are hardly above them."""
    h = np.diff(trajectory.t)[:, None]
    _, v0, a0, c3, c4, c5 = trajectory.coefficients(np.arange(h.size))
    turn = np.clip(-c4 / np.where(c5 == 0.0, 1.0, 5.0 * c5), 0.0, 1.0)
    u = np.linspace(0.0, 1.0, _POINTS + 1)[:, None, None]
    v = v0 + u * (a0 + u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5)))
    a = a0 + u * (6.0 * c3 + u * (12.0 * c4 + u * 20.0 * c5))
    j = np.max([np.abs(6.0 * c3 + x * (24.0 * c4 + x * 60.0 * c5)) for x in (0.0, 1.0, turn)], axis=0)
    # between two points values are this much further from zero than at the points, at most
    v, a = np.abs(v).max(axis=0) + j / (8.0 * _POINTS**2), np.abs(a).max(axis=0) + 15.0 * np.abs(c5) / _POINTS**2
    return JointLimits(*((x / h**k).max(axis=0) for k, x in enumerate((v, a, j), 1)))


def _slowdown(used: JointLimits, limits: JointLimits) -> float:
    """In how many times the time a trajectory with these peaks holds the limits; at least 1."""
    ratios = (
        float(np.max(peak / limit)) ** (1.0 / k) for k, (peak, limit) in enumerate(zip(used, limits, strict=True), 1)
    )
    return max(1.0, *ratios)


def distinct(waypoints: Array) -> NDArray[np.bool_]:
    """Which way points (m, n) are at another place than the one before."""
    return np.append(True, np.abs(np.diff(waypoints, axis=0)).max(axis=1) >= _NOTHING)


def split(borders: Array, period: float) -> Array:
    """Borders (m,) and times between them, as few as keep neighbours within `period`; in whole nanoseconds, s."""
    h = np.diff(borders)
    counts = np.maximum(np.ceil(h / period), 1).astype(np.int64)
    passed = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    t = np.repeat(borders[:-1], counts) + passed * np.repeat(h / counts, counts)
    return np.append(t, borders[-1]).round(9)


def joined(first: Trajectory, second: Trajectory) -> Trajectory:
    """One trajectory, and another that begins at rest where that ends."""
    t = np.append(first.t, (first.t[-1] + second.t[1:]).round(9))
    q, v, a = (np.vstack([getattr(first, x), getattr(second, x)[1:]]) for x in "qva")
    return Trajectory(first.names, t, q, v, a)


def resting(names: Sequence[str], q: Array, period: float) -> Trajectory:
    """A rest of one period at `q` (n,)."""
    rest = np.zeros((2, q.size))
    return Trajectory(tuple(names), np.array([0.0, period]), np.stack([q, q]), rest, rest)


def at_rest(names: Sequence[str], t: Array, q: Array, v: Array, a: Array) -> Trajectory:
    """A trajectory whose ends are at rest to the last bit: controllers refuse one that ends with a velocity."""
    v[[0, -1]] = 0.0
    a[[0, -1]] = 0.0
    return Trajectory(tuple(names), t, q, v, a)
