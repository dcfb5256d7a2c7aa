# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node `calibration_publisher`, and what it shares with the node `calibration`; light to import."""

from __future__ import annotations

from typing import Any

from pydantic import Field, field_validator

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
    nominal: bool = Field(default=False, description="publish the mounts of the configuration whatever is stored")
