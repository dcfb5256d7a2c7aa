# SPDX-License-Identifier: Apache-2.0
"""Carrying an arm by position commands alone: what a servo's target must be so that the joint is where it should.

A position servo pulls with its gain times the difference of target and position, so it hangs below its target by the
weight over the gain, and moves behind it by damping over the gain. The carrier adds both to the target, from the
robot's description and what was identified of the servos, and corrects what is left by joint states. Arrays (k,) are in
the order of the arm's joints; rad, N m, s.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from openarm_common.config import Config
from openarm_common.robot.servos import ArmLoad, ServoModel
from openarm_common.types import Array
from openarm_control.loop_gains import LoopGains

#: Speed at which dry friction is fully there, rad/s.
_SLIDING = 0.02
#: Time in which a motion forgets what was added at rest, s.
_FORGET_S = 0.2
#: Time in which targets of another carrier pass into those of this one, s.
_BLEND_S = 0.3
#: Largest acceleration that is carried, rad/s2: a command that jumps has none.
_MAX_ACCELERATION = 15.0


class CarrierConfig(Config):
    """How arms are carried by position commands."""

    weight: bool = Field(default=True, description="add the torque of weight and acceleration, over the gains")
    lag: bool = Field(default=True, description="add what damping, dry friction and latency take of a moving target")
    correction: float = Field(
        default=1.0, ge=0.0, le=1.0, description="share of the largest safe gains with which errors are corrected"
    )
    correction_limit: float = Field(default=0.3, ge=0.0, le=1.0, description="most that the correction adds, rad")
    settle: bool = Field(default=True, description="work off the error that is left at rest")
    settle_limit: float = Field(default=0.15, ge=0.0, le=0.5, description="most that adds up at rest, rad")
    settle_time: float = Field(
        default=0.3, ge=0.0, le=5.0, description="after a motion, time to come within settle_tolerance, s"
    )
    settle_tolerance: float = Field(default=0.001, gt=0.0, le=0.05, description="error at the tool that is left, m")
    payload_limit: float = Field(
        default=1.0,
        ge=0.0,
        le=10.0,
        description="largest mass that a hand is taken to hold, kg; 0: not estimated",
    )


class Carrier:
    """Makes servo targets of references, for one arm.

    Args:
        servos: Servos, as far as known.
        config: Settings of how it carries.
        load: Torque that motions take; needed where servos leave weight to the client.
        gains: Gains of the correction that are safe; needed there too.
    """

    def __init__(
        self,
        servos: ServoModel,
        config: CarrierConfig,
        load: ArmLoad | None = None,
        gains: LoopGains | None = None,
    ) -> None:
        self.servos, self.config = servos, config
        self._load, self._gains = (load, gains) if servos.soft else (None, None)
        self._lag = servos.damping / servos.stiffness + servos.latency_s
        self._bias: Array = np.zeros_like(servos.stiffness)
        self._velocity: Array = np.zeros_like(servos.stiffness)
        self._holds = False
        #: What was last added to the reference; and what was added before this carrier began, until it does.
        self._shift: Array = np.zeros_like(servos.stiffness)
        self._before: Array | None = None
        self._blend: Array = np.zeros_like(servos.stiffness)
        #: Mass that the hand holds as far as is known, kg.
        self.payload = 0.0

    @property
    def settles(self) -> bool:
        """Whether errors at rest are worked off."""
        return self._gains is not None and self.config.settle

    def reset(self) -> None:
        """Forget what was corrected, because the arm is elsewhere."""
        self._before = None
        self._blend = np.zeros_like(self._blend)
        self._bias = np.zeros_like(self._bias)
        self._velocity = np.zeros_like(self._velocity)

    def succeed(self, other: Carrier) -> None:
        """Go on where another carrier of the arm stops: its targets pass into those of this one."""
        self._before, self._velocity = other._shift, other._velocity
        self._holds, self.payload = other._holds, other.payload

    def begin(self, shift: Array) -> None:
        """Begin where servos have targets already.

        Args:
            shift: (k,) their targets minus the reference, rad.
        """
        self._before = shift.copy()

    def target(self, q: Array, v: Array, error: Array, slip: Array, dt: float) -> Array:
        """Return the targets (k,) of the servos for the coming tick.

        Args:
            q: Reference at its end.
            v: Velocity of the reference.
            error: Reference minus measured position, at its beginning.
            slip: The same of velocities.
            dt: Its length, s.
        """
        shift = self._lag * v if self.config.lag else np.zeros_like(v)
        if self._load is not None:
            torque = self.servos.friction * np.tanh(v / _SLIDING) if self.config.lag else np.zeros_like(v)
            if self.config.weight:
                a = np.clip((v - self._velocity) / dt, -_MAX_ACCELERATION, _MAX_ACCELERATION)
                torque = torque + self.servos.weight * self._load.torque(q, v, a) + self.servos.armature * a
            if self.payload:
                torque = torque + self.payload * self._load.torque_of_mass(q)
            shift = shift + torque / self.servos.stiffness
        if self._gains is not None:
            limit = self.config.correction_limit
            wanted = self._gains.proportional * error + self._gains.derivative * slip
            shift = shift + np.clip(self.config.correction * wanted, -limit, limit) + self._bias
            if np.any(v != 0.0):  # what dry friction took at the last rest, it takes the other way now
                self._bias = self._bias * math.exp(-dt / _FORGET_S)
        if self._before is not None:
            self._blend, self._before = self._before - shift, None
        shift = shift + self._blend
        self._blend = self._blend * math.exp(-dt / _BLEND_S)
        self._velocity, self._shift = v.copy(), shift
        return q + shift

    def hold(self, holds: bool) -> None:
        """Take note whether the hand is closed on something; an open hand holds nothing."""
        self._holds = holds
        if not holds:
            self.payload = 0.0

    def weigh(self, q: Array, error: Array) -> None:
        """Estimate what the hand holds by what corrections carry at rest, and carry it by feed-forward from now on.

        Args:
            q: (k,) where the arm rests.
            error: Reference minus measured position there.
        """
        if self._load is None or self._gains is None or not self._holds:
            return
        carried = error * (1.0 + self.config.correction * self._gains.proportional) + self._bias
        each = self._load.torque_of_mass(q)
        found = self.payload + float(each @ (self.servos.stiffness * carried) / (each @ each))
        payload = min(max(found, 0.0), self.config.payload_limit)
        self._bias = self._bias - (payload - self.payload) * each / self.servos.stiffness
        self.payload = payload

    def settled(self, q: Array, error: Array) -> bool:
        """Whether errors (k,) of joints at q matter no more at the tool."""
        return self._load is None or self._load.tool_offset(q, error) < self.config.settle_tolerance

    def settle(self, error: Array, dt: float) -> None:
        """Add up an error (k,) that is left at rest."""
        if self._gains is not None:
            limit = self.config.settle_limit
            self._bias = np.clip(self._bias + dt * self._gains.integral * error, -limit, limit)
