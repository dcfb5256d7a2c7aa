# SPDX-License-Identifier: Apache-2.0
"""The lift that carries the arms of a robot, as `robot.yaml` says it."""

from __future__ import annotations

from pydantic import Field

from openarm_common.config import Config


class LiftParts(Config):
    """A joint between the base and the arms; its limits and effort are those of the URDF.

    Attributes:
        joint: Slides; all arms are beyond it.
        home: Position in which the simulation starts, m.
        stiffness: Position gain of the simulated drive, N/m; one with a spindle hardly gives.
        damping: Velocity gain, N s/m.
    """

    joint: str
    home: float = 0.0
    stiffness: float = Field(default=4e5, gt=0.0)
    damping: float = Field(default=1e4, gt=0.0)
