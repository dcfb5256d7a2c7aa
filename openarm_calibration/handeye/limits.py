# SPDX-License-Identifier: Apache-2.0
"""Limits of a verdict; m, rad, px."""

from __future__ import annotations

import math

from pydantic import Field

from openarm_common.config import Config


class Limits(Config):
    """When a calibration passes; beyond three times a limit it fails, between the two it is a warning."""

    translation: float = Field(default=1e-3, gt=0.0, description="accuracy of the position, m")
    rotation: float = Field(default=math.radians(0.1), gt=0.0, description="accuracy of the rotation, rad")
    held_out: float = Field(default=1e-3, gt=0.0, description="rms error at the board of poses that were left out, m")
    focal_known: float = Field(default=0.003, gt=0.0, description="deviation of a camera's stated focal length")
    centre_known: float = Field(default=3.0, gt=0.0, description="the same of its principal point, px")
    distortion_known: float = Field(default=0.01, gt=0.0, description="the same of its distortion, k1 and k2")
    robot: float = Field(default=math.radians(0.1), gt=0.0, description="spread of the hand's rotations, rad")
    samples: int = Field(default=10, ge=3, description="fewer are a warning")
    drift: float = Field(default=2e-3, gt=0.0, description="distance from the stored calibration, m")
