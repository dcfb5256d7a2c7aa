# SPDX-License-Identifier: Apache-2.0
"""The measured height of the table, stored as calibrations are."""

from __future__ import annotations

import math
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from openarm_common.errors import Code, OpenArmError
from openarm_common.records import Record, RecordStore

#: Name of the record, and of the folder below that of the calibrations.
TABLE = "table"
#: A measured surface that is steeper is no table: intrinsics or mount of the camera are wrong, deg.
MAX_TILT_DEG = 1.4


class StoredTable(Record):
    """A measured height of the table."""

    place: ClassVar[str] = TABLE
    noun: ClassVar[str] = "height"
    command: ClassVar[str] = "openarm calibrate table"
    usual: ClassVar[str] = TABLE

    format: int = Field(default=1, ge=1, le=1, description="of this file")
    height: float = Field(ge=0.05, le=1.2, description="of the table top in the base frame, m")
    configured: float = Field(description="what the scene said then, m; of another table, this one says nothing")
    std: float = Field(default=0.0, ge=0.0, description="standard deviation, m")
    tilt: float = Field(default=0.0, ge=0.0, description="of the measured plane, rad")
    method: str = Field(default="", description="how it was measured")
    mount_seed: int | None = Field(default=None, description="of the simulated mounts; None: real or nominal")
    created: str = Field(default="", description="when, as ISO 8601")

    @property
    def name(self) -> str:
        """The only one there is."""
        return TABLE

    def __str__(self) -> str:
        """Return the height, how and when it was measured."""
        seed = "none" if self.mount_seed is None else str(self.mount_seed)
        return f"{self.height * 1e3:.1f} mm by {self.method or 'hand'}, mount seed {seed}, {self.created or 'undated'}"


class TableStore(RecordStore[StoredTable]):
    """The height of the table, below a folder of calibrations.

    Args:
        calibrations: Folder of the calibrations.
    """

    def __init__(self, calibrations: Path) -> None:
        super().__init__(calibrations, StoredTable)

    def in_use(self, configured: float, mount_seed: int | None) -> tuple[float, str, str]:
        """Return the height of the table (m), where it is from, and what is wrong with what is stored.

        Args:
            configured: Height that the scene states, m.
            mount_seed: Seed of the simulated mounts in use.
        """
        nominal = "of the scene"
        try:
            found = self.find(TABLE)
        except OpenArmError as error:
            return configured, nominal, error.message
        if found is None:
            return configured, nominal, ""
        record = found.record
        if record.mount_seed != mount_seed or not math.isclose(record.configured, configured, abs_tol=1e-6):
            return configured, f"{nominal}; what is stored was measured at another table", ""
        return record.height, f"measured {record.digest()[:12]}", found.warning

    def save_level(self, table: StoredTable) -> Path:
        """Store a measured table when it is level.

        Raises:
            OpenArmError: INTRINSICS_MISMATCH, when it is not; ENVIRONMENT.
        """
        if math.degrees(table.tilt) > MAX_TILT_DEG:
            raise OpenArmError(
                Code.INTRINSICS_MISMATCH,
                f"the measured surface is tilted by {math.degrees(table.tilt):.1f} deg, expected at most"
                f" {MAX_TILT_DEG:g}: not stored; intrinsics or mount of the camera are wrong, calibrate it first",
            )
        return self.save(table)
