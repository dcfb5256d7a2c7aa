# SPDX-License-Identifier: Apache-2.0
"""Base of the controllers of arms and grippers: a command per joint that moves with bounded speed and acceleration."""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.robot.turns import nearest_turns
from openarm_common.types import Array
from openarm_control.trajectory import JointGroup

_NEAR = 1e-9  # rad or m; closer than this has arrived


class End(StrEnum):
    """How a goal ended, in the terms of actions."""

    SUCCEEDED = "succeeded"
    CANCELLED = "cancelled"
    ABORTED = "aborted"


class Tracker:
    """Position and velocity (k,) of a command that follows targets; rad or m and seconds.

    Args:
        position: (k,) where the command starts, at rest.
        velocity: Largest speed of each joint.
        acceleration: Largest acceleration of each joint.
    """

    def __init__(self, position: ArrayLike, velocity: ArrayLike, acceleration: ArrayLike) -> None:
        self.position: Array = np.array(position, dtype=np.float64)
        self.velocity: Array = np.zeros_like(self.position)
        self._v_max = np.asarray(velocity, dtype=np.float64)
        self._a_max = np.asarray(acceleration, dtype=np.float64)

    def hold(self, position: ArrayLike) -> None:
        """Stop at a position."""
        self.position[:] = position
        self.velocity[:] = 0.0

    def stopping_place(self) -> Array:
        """Return the position (k,) at which it comes to rest when it begins to brake now."""
        return self.position + self.velocity * np.abs(self.velocity) / (2.0 * self._a_max)

    def step(self, target: Array, dt: float, v_max: ArrayLike | None = None) -> None:
        """Advance by `dt` seconds; arrives without overshoot from rest.

        Args:
            target: (k,) where to go.
            dt: Seconds.
            v_max: Another largest speed for this step.
        """
        error = target - self.position
        distance = np.abs(error)
        limit = self._v_max if v_max is None else np.minimum(self._v_max, v_max)
        # The speed from which the rest of the way is enough to stop in whole steps.
        brake = np.sqrt((0.5 * self._a_max * dt) ** 2 + 2.0 * self._a_max * distance) - 0.5 * self._a_max * dt
        wanted = np.sign(error) * np.minimum(np.minimum(brake, limit), distance / dt)
        change = self._a_max * dt
        velocity = np.clip(wanted, self.velocity - change, self.velocity + change)
        arrived = (distance <= np.abs(velocity) * dt * (1.0 + 1e-9) + _NEAR) & (np.abs(velocity) <= change)
        self.position = np.where(arrived, target, self.position + velocity * dt)
        self.velocity = np.where(arrived, 0.0, velocity)


class Follower(ABC):
    """Computes the actuator targets of a group of joints, one control tick at a time.

    There is a command at any time: without a goal it holds, and no new target makes it jump. Used by the thread that
    steps the world.

    Args:
        group: The joints.
        command: Position of the command.
    """

    def __init__(self, group: JointGroup, command: Tracker) -> None:
        self.group = group
        self._command = command
        self._target: Array = command.position.copy()
        #: Why it moves slowly until a goal is reached; nothing: it does not.
        self.careful = ""

    @property
    def commanded(self) -> Array:
        """Where the joints (k,) should be now."""
        return self._command.position

    @property
    @abstractmethod
    def busy(self) -> bool:
        """Whether a goal is being followed."""

    @abstractmethod
    def abort(self, why: str) -> None:
        """Give up a running goal."""

    @abstractmethod
    def update(self, t_ns: int, dt_ns: int, position: Array, velocity: Array, effort: Array) -> Array:
        """Return the actuator targets (k,) of a tick.

        Args:
            t_ns: Time at its beginning.
            dt_ns: Its length.
            position: (k,) measured at its beginning; rad or m.
            velocity: (k,) rad/s or m/s.
            effort: (k,) N m or N.
        """

    def stop(self, why: str) -> None:
        """The emergency stop: as `hold`; goals end with a code of their own."""
        self.hold(why)

    def hold(self, why: str) -> None:
        """Give up a running goal and hold the present command, without a ramp."""
        self.abort(why)
        self._hold(self._command.position)

    @abstractmethod
    def begin(self, targets: Array) -> None:
        """Begin, after a reset, where the servos have targets (k,) already."""

    def reset(self, position: ArrayLike) -> None:
        """Hold another position, because the robot was put elsewhere; a running goal is aborted."""
        self.abort("the robot was put elsewhere, or its simulated world was reset")
        self._hold(position)

    def set_target(self, target: Array) -> None:
        """Go to a position (k,), NaN for joints that stay as they are; ignored while a goal is followed.

        Joints that turn without end go the short way.
        """
        if not self.busy:
            near = nearest_turns(target, self._command.position, self.group.upper)
            self._target = self._within_limits(np.where(np.isnan(target), self._target, near))

    def halt(self) -> None:
        """Come to rest and hold, because commands ceased; a goal continues."""
        if not self.busy:
            self._target = self._within_limits(self._command.stopping_place())

    def _hold(self, position: ArrayLike) -> None:
        self._command.hold(position)
        self._target = self._command.position.copy()

    def _within_limits(self, position: Array) -> Array:
        return np.clip(position, self.group.lower, self.group.upper)
