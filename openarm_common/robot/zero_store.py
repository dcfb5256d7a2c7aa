# SPDX-License-Identifier: Apache-2.0
"""Calibrated zeros of a robot's joints, stored as calibrations are; graphs take them up at their start (`zeros`)."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from openarm_common.records import Found, OfAnotherRobot, Record, RecordStore
from openarm_common.robot.zeros import REAL


class StoredZeros(Record):
    """Zeros of the joints: where a joint is, minus what its encoder reports."""

    format: int = Field(default=1, ge=1, le=1, description="of this file")
    of: str = Field(default=REAL, description="zeros: a real robot; else the simulated one that they are of")
    offsets: dict[str, float] = Field(description="by joint, rad")
    sigma: dict[str, float] = Field(default_factory=dict, description="standard deviations, rad")
    by_prior: tuple[str, ...] = Field(default=(), description="joints that the samples could not tell")
    cameras: tuple[str, ...] = Field(default=(), description="whose mounts were found with them, and stored")
    samples: int = Field(default=0, ge=0, description="that they rest on")
    sessions: tuple[str, ...] = Field(default=(), description="hashes of the session files")
    created: str = Field(default="", description="when, as ISO 8601")

    @property
    def name(self) -> str:
        """The robot that they are of."""
        return self.of


class ZeroStore(RecordStore[StoredZeros]):
    """The zeros of the joints, below a folder of calibrations.

    Args:
        folder: Folder of the calibrations.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "zeros", StoredZeros, "joint zeros")

    def save(self, record: StoredZeros) -> Path:
        """Store zeros; before the first ones, those of the description are stored, to which `rollback` leads."""
        if not self.history(record.name):
            super().save(StoredZeros(of=record.of, offsets={}))
        return super().save(record)

    def in_use(self, of: str) -> Found[StoredZeros]:
        """Return the zeros of a robot; those of its description where none are stored, or those of another robot.

        Raises:
            OpenArmError: CONFIG_INVALID, when the file is damaged and the history has no good one.
        """
        try:
            found = self.find(of)
        except OfAnotherRobot:
            found = None
        return found or Found(StoredZeros(of=of, offsets={}))
