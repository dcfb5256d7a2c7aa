# SPDX-License-Identifier: Apache-2.0
"""Hands of a robot as they were learned, stored as calibrations are; graphs take them up at their start (`zeros`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import Field

from openarm_common.errors import OpenArmError
from openarm_common.records import OfAnotherRobot, Record, RecordStore
from openarm_common.robot.zeros import REAL, HandReach


class StoredHands(Record):
    """What the hands of a robot read at both ends of their fingers."""

    format: int = Field(default=1, ge=1, le=1, description="of this file")
    of: str = Field(default=REAL, description="as of its zeros: a real robot, or the simulated one that they are of")
    hands: dict[str, HandReach] = Field(description="by arm")

    @property
    def name(self) -> str:
        """The robot that they are of."""
        return self.of


class HandStore(RecordStore[StoredHands]):
    """The hands of robots, below a folder of calibrations.

    Args:
        folder: Folder of the calibrations.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "hands", StoredHands, "learned hand")

    def keep(self, of: str, arm: str, reach: HandReach) -> Path:
        """Store a hand beside the others of a robot; a damaged file is replaced."""
        try:
            others = self.in_use(of)
        except OpenArmError:
            others = {}
        return self.save(StoredHands(of=of, hands={**others, arm: reach}))

    def in_use(self, of: str) -> Mapping[str, HandReach]:
        """Return the hands of a robot by arm; none of which nothing was learned.

        Raises:
            OpenArmError: CONFIG_INVALID, when the file is damaged, and none before it is whole.
        """
        try:
            found = self.find(of)
        except OfAnotherRobot:
            return {}
        except OpenArmError as error:
            text = f"{error.message}; or remove it, and learn the hands again: `openarm hardware learn-hand`"
            raise OpenArmError(error.code, text) from error
        return {} if found is None else found.record.hands
