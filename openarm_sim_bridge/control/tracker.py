# SPDX-License-Identifier: Apache-2.0
"""Moving a command towards a target with bounded speed and acceleration, so that no jump of a target is a teleport."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.types import Array

_NEAR = 1e-9  # rad or m, is there


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
        """Be at rest at a position."""
        self.position[:] = position
        self.velocity[:] = 0.0

    def stopping_place(self) -> Array:
        """Position (k,) at which it comes to rest when it begins to brake now."""
        return self.position + self.velocity * np.abs(self.velocity) / (2.0 * self._a_max)

    def step(self, target: Array, dt: float, v_max: ArrayLike | None = None) -> None:
        """Move on for `dt` seconds; arrives without overshoot from rest.

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
