# SPDX-License-Identifier: Apache-2.0
"""What was learned of a robot, zeros of its joints and reach of its hands, stored as calibrations are.

Graphs take it up at their start (see `zeros`).
"""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import ClassVar, TypeVar

from pydantic import Field

from openarm_common.errors import OpenArmError
from openarm_common.records import Record, RecordStore
from openarm_common.robot.zeros import REAL, HandReach


class Learned(Record):
    """What was learned of a robot; without values, the robot is as described."""

    usual: ClassVar[str] = REAL

    format: int = Field(default=1, ge=1, le=1, description="of this file")
    of: str = Field(default=REAL, description="zeros: a real robot; else the simulated one that they are of")

    @property
    def name(self) -> str:
        """The robot that they are of."""
        return self.of


class StoredZeros(Learned):
    """Zeros of the joints: where a joint is, minus what its encoder reports."""

    place: ClassVar[str] = "zeros"
    noun: ClassVar[str] = "joint zeros"
    command: ClassVar[str] = "openarm calibrate zeros --save"

    offsets: dict[str, float] = Field(default_factory=dict, description="by joint, rad")
    sigma: dict[str, float] = Field(default_factory=dict, description="standard deviations, rad")
    by_prior: tuple[str, ...] = Field(default=(), description="joints that the samples could not tell")
    cameras: tuple[str, ...] = Field(default=(), description="whose mounts were found with them, and stored")
    samples: int = Field(default=0, ge=0, description="that they rest on")
    sessions: tuple[str, ...] = Field(default=(), description="hashes of the session files")
    created: str = Field(default="", description="when, as ISO 8601")

    def __str__(self) -> str:
        """Return how far the joints are off, and when that was found."""
        if not any(self.offsets.values()):
            return "joints as described"
        rms = math.sqrt(sum(value**2 for value in self.offsets.values()) / len(self.offsets))
        return (
            f"{len(self.offsets)} joints off by {math.degrees(rms):.2f}° rms, {self.samples} samples,"
            f" with {', '.join(self.cameras)}, {self.created or 'undated'}"
        )


class StoredHands(Learned):
    """What the hands of a robot read at both ends of their fingers."""

    place: ClassVar[str] = "hands"
    noun: ClassVar[str] = "learned hand"
    command: ClassVar[str] = "openarm hardware learn-hand"

    hands: dict[str, HandReach] = Field(default_factory=dict[str, HandReach], description="by arm")

    def __str__(self) -> str:
        """Return the reach of each hand, and when it was learned."""
        return "; ".join(f"{arm} {reach}" for arm, reach in self.hands.items()) or "as described"


LearnedT = TypeVar("LearnedT", bound=Learned)


class LearnedStore(RecordStore[LearnedT]):
    """What was learned of robots; before the first one of a robot is its description, to which `rollback` leads."""

    def save(self, record: LearnedT) -> Path:
        """Store what was learned; see `RecordStore.save`."""
        if not self.history(record.name):
            super().save(self.kind(of=record.of))
        return super().save(record)

    def in_use(self, of: str) -> LearnedT:
        """Return what was learned of a robot; nothing where none is stored.

        Raises:
            OpenArmError: CONFIG_INVALID, when the file is damaged and the history has no good one.
        """
        found = self.find(of)
        return self.kind(of=of) if found is None else found.record


def keep_hand(calibrations: Path, of: str, arm: str, reach: HandReach) -> Path:
    """Store a hand with the other ones of its robot, and return the file; a damaged file is replaced.

    Args:
        calibrations: Folder of the calibrations.
        of: Name that the zeros of the robot are stored by.
        arm: Arm of the hand.
        reach: Reach that was learned.
    """
    store, others = LearnedStore(calibrations, StoredHands), dict[str, HandReach]()
    with contextlib.suppress(OpenArmError):
        others = store.in_use(of).hands
    return store.save(StoredHands(of=of, hands={**others, arm: reach}))
