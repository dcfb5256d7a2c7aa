# SPDX-License-Identifier: Apache-2.0
"""What an arm does next: go on with a velocity for a moment, then stop, within velocity, acceleration and jerk limits.

Positions rad (m of joints that slide), times s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import ruckig

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.timing.trajectory import JointLimits

#: From one point of a course that is sent or checked to the next, s.
_STEP = 0.02


class JointState(NamedTuple):
    """Position, velocity and acceleration (n,) of the joints."""

    q: Array
    v: Array
    a: Array

    @classmethod
    def rest(cls, q: Array) -> JointState:
        """At rest at a position (n,)."""
        return cls(q, np.zeros_like(q), np.zeros_like(q))


def towards(state: JointState, velocity: Array, limits: JointLimits) -> Any:
    """The fastest change (a ruckig.Trajectory) to a constant velocity (n,) that keeps the limits.

    Raises:
        OpenArmError: INTERNAL, when there is none.
    """
    n = len(state.q)
    asked, change = ruckig.InputParameter(n), ruckig.Trajectory(n)
    asked.control_interface = ruckig.ControlInterface.Velocity
    asked.synchronization = ruckig.Synchronization.No
    asked.current_position, asked.current_velocity = state.q.tolist(), state.v.tolist()
    asked.current_acceleration = np.clip(state.a, -limits.acceleration, limits.acceleration).tolist()
    asked.target_velocity, asked.target_acceleration = velocity.tolist(), [0.0] * n
    asked.max_acceleration, asked.max_jerk = limits.acceleration.tolist(), limits.jerk.tolist()
    result = ruckig.Ruckig(n).calculate(asked, change)
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise OpenArmError(Code.INTERNAL, f"no change of velocity from {state.v.tolist()} to {velocity.tolist()}")
    return change


def _at(change: Any, t: float) -> JointState:
    q, v, a = change.at_time(max(t, 0.0))
    return JointState(np.array(q), np.array(v), np.array(a))


@dataclass(frozen=True, eq=False)
class Course:
    """A change of velocity that is followed for `hold` s, then a stop.

    Attributes:
        start: State at its beginning.
        change: Change from `towards`.
        hold: s.
        brake: Deceleration from `towards`, at the end of `hold`.
    """

    start: JointState
    change: Any
    hold: float
    brake: Any

    @classmethod
    def of(cls, start: JointState, velocity: Array, hold: float, limits: JointLimits) -> Course:
        """Go on with a velocity (n,), and stop.

        Args:
            start: State at the beginning.
            velocity: rad/s.
            hold: s before the stop.
            limits: Limits that it keeps.
        """
        change = towards(start, velocity, limits)
        return cls(start, change, hold, towards(_at(change, hold), np.zeros_like(velocity), limits))

    @classmethod
    def resting(cls, q: Array, limits: JointLimits) -> Course:
        """Stay at a position (n,)."""
        return cls.of(JointState.rest(q), np.zeros_like(q), 0.0, limits)

    @property
    def duration(self) -> float:
        """Until it rests, s."""
        return float(self.hold + self.brake.duration)

    @property
    def end(self) -> Array:
        """Where it rests, (n,)."""
        return _at(self.brake, self.brake.duration).q

    def at(self, t: float) -> JointState:
        """State at a time, s; at rest after its end."""
        if t < self.hold:
            return _at(self.change, t)
        if t >= self.duration:
            return JointState.rest(self.end)
        return _at(self.brake, t - self.hold)

    def times(self, step: float = _STEP) -> Array:
        """Times (m,) from its beginning to its end, with the end of `hold` among them."""
        pieces = max(1, int(np.ceil(self.brake.duration / step)))
        after = np.linspace(self.hold, self.duration, pieces + 1)
        return np.unique(np.concatenate([np.arange(0.0, self.hold - 1e-3, step), after]))

    def positions(self) -> Array:
        """Positions (m, n) on the way."""
        return np.array([self.at(t).q for t in self.times()])
