# SPDX-License-Identifier: Apache-2.0
"""The lift that carries the arms of a robot, as `robot.yaml` says it."""

from __future__ import annotations

from pydantic import Field

from openarm_common.config import Config

#: The lift's controller is called as that of an arm of this name would be.
LIFT = "lift"


class LiftParts(Config):
    """A joint between the base and the arms; its limits and effort are those of the URDF.

    Attributes:
        joint: Slides; all arms are beyond it.
        home: Position in which the simulation starts, m.
        stiffness: Position gain of the simulated drive, N/m; one with a spindle hardly gives.
        damping: Velocity gain, N s/m.
        acceleration: Acceleration of plans, m/s2; their velocity is that of the URDF.
        jerk: Jerk of plans, m/s3.
    """

    joint: str
    home: float = 0.0
    stiffness: float = Field(default=4e5, gt=0.0)
    damping: float = Field(default=1e4, gt=0.0)
    acceleration: float = Field(default=0.1, gt=0.0)
    jerk: float = Field(default=0.5, gt=0.0)
