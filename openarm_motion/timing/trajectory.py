# SPDX-License-Identifier: Apache-2.0
"""Jerk-limited timing of joint paths.

A path is followed exactly; only its speed is chosen. Ruckig gives the profile of one number, the way along a path from
rest to rest, of seven pieces of constant jerk (never its `intermediate_positions`: in the wheels they call a service on
the network). Samples lie on a grid and at the ends of those pieces, with velocities and accelerations, so that a
follower's quintic interpolation is the profile itself on a straight joint line. s, rad, rad/s, rad/s², rad/s³.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import ruckig
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline, make_interp_spline

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

#: Samples of a path at which limits are checked, and the excess over them that rounding may leave.
_FINE = 400
#: A path shorter than this, rad or m, is none.
_NOTHING = 1e-9
#: Two samples are at least this far apart, s.
SPACING = 1e-3


class JointLimits(NamedTuple):
    """Velocity, acceleration and jerk limits of the joints, (n,) each."""

    velocity: Array
    acceleration: Array
    jerk: Array

    def scaled(self, scale: float) -> JointLimits:
        """The limits times `scale`.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when `scale` is not in (0, 1].
        """
        if not 0.0 < scale <= 1.0:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"velocity_scale is {scale}, expected 0 < scale <= 1")
        return JointLimits(*(limit * scale for limit in self))


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
        q0, v0, a0 = self.q[i], self.v[i] * h, self.a[i] * h * h
        dq, v1, a1 = self.q[i + 1] - q0, self.v[i + 1] * h, self.a[i + 1] * h * h
        c3 = 10.0 * dq - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1
        c4 = -15.0 * dq + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1
        c5 = 6.0 * dq - 3.0 * (v0 + v1) - 0.5 * (a0 - a1)
        q = q0 + u * (v0 + u * (0.5 * a0 + u * (c3 + u * (c4 + u * c5))))
        v = (v0 + u * (a0 + u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5)))) / h
        a = (a0 + u * (6.0 * c3 + u * (12.0 * c4 + u * 20.0 * c5))) / (h * h)
        return q, v, a


@dataclass(frozen=True, eq=False)
class Profile:
    """Way along a path over time: pieces of constant jerk that begin at `t` (k,) with the values `s`, `v`, `a`, `j`."""

    t: Array
    s: Array
    v: Array
    a: Array
    j: Array
    duration: float

    def at(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """Way, speed, acceleration, jerk at times (k,)."""
        i = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, self.t.size - 1)
        h = np.clip(t, 0.0, self.duration) - self.t[i]
        s, v, a, j = self.s[i], self.v[i], self.a[i], self.j[i]
        return (
            s + h * (v + h * (0.5 * a + h * j / 6.0)),
            v + h * (a + 0.5 * h * j),
            a + h * j,
            j,
        )

    def slower(self, factor: float) -> Profile:
        """The same way in `factor` times the time."""
        k = factor
        return Profile(self.t * k, self.s, self.v / k, self.a / k**2, self.j / k**3, self.duration * k)


def profile(length: float, velocity: float, acceleration: float, jerk: float) -> Profile:
    """Fastest way from rest to rest over `length` within the limits.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when a limit is not positive.
    """
    if not min(length, velocity, acceleration, jerk) > 0.0:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"length {length:g}, velocity {velocity:g}, acceleration {acceleration:g}, jerk {jerk:g}: expected all > 0",
        )
    generator, query, answer = ruckig.Ruckig(1), ruckig.InputParameter(1), ruckig.Trajectory(1)
    query.current_position, query.target_position = [0.0], [length]
    query.max_velocity, query.max_acceleration, query.max_jerk = [velocity], [acceleration], [jerk]
    result = generator.calculate(query, answer)
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise OpenArmError(Code.INTERNAL, f"ruckig answered {result} for a way of {length:g} from rest to rest")
    pieces = answer.profiles[0][0]
    h = np.array(pieces.t)
    t, real = np.concatenate([[0.0], np.cumsum(h)]), h > 1e-12
    s, v, a, j = (np.array(values)[: h.size][real] for values in (pieces.p, pieces.v, pieces.a, pieces.j))
    return Profile(t[:-1][real], s, v, a, j, float(t[-1]))


def straight_profile(difference: Array, limits: JointLimits) -> Profile:
    """Fastest way from 0 to 1 of a straight segment (n,), from rest to rest, on which no joint exceeds a limit."""
    size = np.maximum(np.abs(difference), 1e-12)
    v, a, j = (float(np.min(limit / size)) for limit in limits)
    return profile(1.0, v, a, j)


def time_polyline(names: Sequence[str], waypoints: Array, limits: JointLimits, period: float = 0.02) -> Trajectory:
    """Time straight joint segments, each from rest to rest.

    Args:
        names: Joints.
        waypoints: (m, n) rad.
        limits: What no joint exceeds.
        period: Greatest time between two samples, s.
    """
    parts: list[Trajectory] = []
    for start, end, difference in segments(waypoints):
        way = straight_profile(difference, limits)
        t = _sample_times(way, period)
        s, ds, dds, _ = way.at(t)
        q = start + s[:, None] * difference
        q[-1] = end
        parts.append(at_rest(tuple(names), t, q, ds[:, None] * difference, dds[:, None] * difference))
    return joined(tuple(names), parts, waypoints[0], period)


def time_path(
    names: Sequence[str], path: Array, s: Array, limits: JointLimits, speed: float, period: float = 0.02
) -> Trajectory:
    """Time a smooth joint path from rest to rest.

    The limits hold at every moment: a first profile is made from the path's steepest parts, and then slowed down as a
    whole by what curvature adds, which scales velocity, acceleration and jerk by known powers.

    Args:
        names: Joints.
        path: (m, n) rad, smooth and dense, m >= 6.
        s: (m,) way along the path that rises from 0, for example of the tool, m.
        limits: What no joint exceeds.
        speed: Greatest ds/dt.
        period: Greatest time between two samples, s.
    """
    if s[-1] < _NOTHING:
        return joined(tuple(names), [], path[0], period)
    curve = make_interp_spline(s, path, k=5)
    d1, d2, d3 = (curve.derivative(k) for k in (1, 2, 3))
    fine = np.linspace(0.0, float(s[-1]), _FINE)
    steepest = np.maximum(np.abs(d1(fine)).max(axis=0), 1e-9)
    v, a, j = (float(np.min(limit / steepest)) for limit in limits)
    way = profile(float(s[-1]), min(speed, v), a, j)
    t = np.union1d(np.linspace(0.0, way.duration, _FINE), np.concatenate([way.t, way.t + 1e-9]))
    x, dx, ddx, dddx = (value[:, None] for value in way.at(t))
    q1, q2, q3 = d1(x[:, 0]), d2(x[:, 0]), d3(x[:, 0])
    velocity = np.abs(q1 * dx) / limits.velocity
    acceleration = np.abs(q2 * dx**2 + q1 * ddx) / limits.acceleration
    # at the border of two pieces the jerk jumps: the grid holds both sides of it
    jerk = np.abs(q3 * dx**3 + 3.0 * q2 * dx * ddx + q1 * dddx) / limits.jerk
    factor = max(1.0, float(velocity.max()), float(acceleration.max()) ** 0.5, float(jerk.max()) ** (1.0 / 3.0))
    way = way.slower(factor * (1.0 + 1e-6))
    t = _sample_times(way, period)
    x, dx, ddx, _ = (value[:, None] for value in way.at(t))
    q1, q2 = d1(x[:, 0]), d2(x[:, 0])
    q = np.asarray(curve(x[:, 0]))
    q[0], q[-1] = path[0], path[-1]
    return at_rest(tuple(names), t, q, q1 * dx, q2 * dx**2 + q1 * ddx)


def segments(waypoints: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Start, end and difference (n,) of the straight segments of a polyline; those of no length are left out."""
    for start, end in itertools.pairwise(waypoints):
        if float(np.abs(end - start).max()) >= _NOTHING:
            yield start, end, end - start


def _sample_times(way: Profile, period: float) -> Array:
    """Grid of at most `period`, joined with the borders of the pieces; grid points next to a border give way."""
    grid = np.linspace(0.0, way.duration, max(2, int(np.ceil(way.duration / period)) + 1))
    borders = np.concatenate([way.t, [way.duration]])
    borders = borders[np.concatenate([[True], np.diff(borders) > SPACING])]
    borders[-1] = way.duration
    far = np.min(np.abs(grid[:, None] - borders[None, :]), axis=1) > SPACING
    return np.sort(np.concatenate([grid[far], borders]))


def at_rest(names: tuple[str, ...], t: Array, q: Array, v: Array, a: Array) -> Trajectory:
    """A trajectory whose ends are at rest to the last bit: controllers refuse one that ends with a velocity."""
    v[[0, -1]] = 0.0
    a[[0, -1]] = 0.0
    return Trajectory(names, t, q, v, a)


def joined(names: tuple[str, ...], parts: list[Trajectory], q: Array, period: float) -> Trajectory:
    """Parts one after the other, each beginning at rest where the last ended; a rest of one period without any."""
    if not parts:
        rest = np.zeros((2, q.size))
        return Trajectory(names, np.array([0.0, period]), np.stack([q, q]), rest, rest)
    t, offset = [parts[0].t], parts[0].duration
    for part in parts[1:]:
        t.append(part.t[1:] + offset)
        offset += part.duration
    q_, v, a = (
        np.concatenate([getattr(parts[0], k), *(getattr(p, k)[1:] for p in parts[1:])]) for k in ("q", "v", "a")
    )
    return Trajectory(names, np.concatenate(t), q_, v, a)
