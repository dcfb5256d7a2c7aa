# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes of this package."""

from __future__ import annotations

from typing import Any

from pydantic import Field, field_validator

from openarm_calibration.gate import GateConfig
from openarm_calibration.offline import ALGORITHMS
from openarm_calibration.verdict import Limits
from openarm_common.config import Config


class StoreConfig(Config):
    """Where calibrations are stored, and which mounts are in use."""

    cameras: str = Field(default="", description="YAML of the cameras; empty is config/params/cameras.yaml")
    store: str = Field(
        default="",
        description="folder of stored calibrations; empty: OPENARM_CALIBRATIONS or ~/.local/share/openarm/calibrations",
    )
    mount_seed: int = Field(
        default=-1,
        ge=-1,
        description="of the simulated mounts in use; -1 or none: real ones, or simulated without an error",
    )

    @field_validator("mount_seed", mode="before")
    @classmethod
    def _none_is_no_seed(cls, value: Any) -> Any:
        return -1 if value is None or value == "none" else value

    @property
    def seed(self) -> int | None:
        """The mount seed; None without one."""
        return None if self.mount_seed < 0 else self.mount_seed


class PublisherConfig(StoreConfig):
    """Parameters of the node `calibration_publisher`."""

    period: float = Field(default=0.5, gt=0.0, le=60.0, description="between looks at the store, s of wall clock")


class CalibrationConfig(StoreConfig):
    """Parameters of the node `calibration`."""

    camera: str = Field(default="wrist", min_length=1, description="name of the camera to calibrate")
    board: str = Field(
        default="", description="keys of the board as YAML, such as {kind: circles, rows: 11}; empty: defaults"
    )
    carrier: str = Field(
        default="openarm_right_link7",
        min_length=1,
        description="link that holds the board when the camera stands still",
    )
    algorithm: str = Field(default="REFINED", description="what compute_calibration uses at first")
    image_timeout: float = Field(default=2.0, gt=0.0, le=60.0, description="longest wait for an image, s of wall clock")
    state_timeout: float = Field(
        default=1.0, gt=0.0, le=60.0, description="longest wait for joint states, s of wall clock"
    )
    gate: GateConfig = GateConfig()
    limits: Limits = Limits()

    @field_validator("algorithm")
    @classmethod
    def _known(cls, value: str) -> str:
        if value.upper() not in ALGORITHMS:
            raise ValueError(f"unknown algorithm; algorithms: {', '.join(ALGORITHMS)}")
        return value.upper()
