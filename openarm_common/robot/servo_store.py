# SPDX-License-Identifier: Apache-2.0
"""Identified servos of arms, stored as calibrations are."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from openarm_common.records import Record
from openarm_common.robot.servos import ServoModel


class StoredServos(Record):
    """Servos of an arm: values and standard deviations by joint, from the shoulder."""

    place: ClassVar[str] = "servos"
    noun: ClassVar[str] = "identification"
    command: ClassVar[str] = "openarm calibrate dynamics"

    format: int = Field(default=1, ge=1, le=1, description="of this file")
    arm: str = Field(description="name of the arm")
    stiffness: tuple[float, ...] = Field(description="position gain, N m/rad")
    damping: tuple[float, ...] = Field(description="velocity gain and that of the gearbox, N m s/rad")
    friction: tuple[float, ...] = Field(description="dry friction, N m")
    armature: tuple[float, ...] = Field(description="inertia of rotor and gear, kg m2")
    latency: tuple[float, ...] = Field(description="from a command to its effect, s")
    stiffness_std: tuple[float, ...] = Field(default=(), description="N m/rad")
    damping_std: tuple[float, ...] = Field(default=(), description="N m s/rad")
    friction_std: tuple[float, ...] = Field(default=(), description="N m")
    latency_std: tuple[float, ...] = Field(default=(), description="s")
    rms: tuple[float, ...] = Field(default=(), description="what is left of the targets, rad")
    dynamics_seed: int | None = Field(default=None, description="of the simulated robot; None: a real one")
    created: str = Field(default="", description="when, as ISO 8601")

    @property
    def name(self) -> str:
        """The arm."""
        return self.arm

    def __str__(self) -> str:
        """Return the gains, and when they were identified."""
        seed = "none" if self.dynamics_seed is None else str(self.dynamics_seed)
        gains = ", ".join(f"{gain:.0f}" for gain in self.stiffness)
        return f"gains {gains} N m/rad, dynamics seed {seed}, {self.created or 'undated'}"

    def model(self) -> ServoModel:
        """Return them for a carrier; what is identified are servos that leave the weight to the client."""
        arrays = (self.stiffness, self.damping, self.friction, self.armature, self.latency)
        return ServoModel(*map(np.array, arrays), weight=1.0)
