# SPDX-License-Identifier: Apache-2.0
"""What is around an arm in one query, how near it may come to it, and what is too near. Base frame, m, rad."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from pydantic import Field

from openarm_common.config import Config
from openarm_motion.collision.seen import SeenMap
from openarm_motion.collision.solids import Box, Solid


class Clearance(Config):
    """Distances that pairs keep, m; nearer is a collision."""

    own: float = Field(
        default=0.003, ge=0.0, le=0.05, description="between links of the arm, and to the robot's body, m"
    )
    world: float = Field(default=0.010, ge=0.0, le=0.1, description="arm to boxes, m")
    arms: float = Field(default=0.030, ge=0.0, le=0.1, description="arm to the other arm, m")
    hand: float = Field(default=0.010, ge=0.0, le=0.1, description="hand, or what it holds, to boxes, m")
    touch: float = Field(
        default=0.002, ge=0.0, le=0.05, description="arm and palm to a box that the fingers may touch, m"
    )
    rest: float = Field(
        default=0.0, ge=-0.02, le=0.05, description="held box to what it stands on; < 0 allows overlap, m"
    )


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is around an arm in one query.

    Attributes:
        state: Positions of (at least) the robot's other movable joints; missing ones are taken as 0.
        boxes: Obstacles, base frame; boxes or other bodies.
        held: Boxes held by this arm, pose in the tool frame.
        carried: Boxes that go with the other arm: the joint that each hangs on, pose in that joint's frame.
        touchable: Ids of boxes that the fingers may touch.
        supports: Ids of boxes that a held box may stand on.
        fixed: Ids of boxes that are where they are said to be; the others are estimates.
        clearance: Distances to keep.
        map: What the cameras see beside all that; None is nothing.
        own: Whether the arm is checked against itself and the robot's body; False leaves the other arm and the boxes.
    """

    state: Mapping[str, float]
    boxes: Sequence[Solid] = ()
    held: Sequence[Box] = ()
    carried: Sequence[tuple[int, Box]] = ()
    touchable: frozenset[str] = frozenset()
    supports: frozenset[str] = frozenset()
    fixed: frozenset[str] = frozenset()
    clearance: Clearance = field(default_factory=Clearance)
    map: SeenMap | None = None
    own: bool = True


@dataclass(frozen=True)
class Contact:
    """Two things nearer to each other than allowed.

    Attributes:
        first: Link or held box.
        second: Link or obstacle.
        distance: < 0 is how deep they overlap, m.
        required: What it should be, m.
        where: Added to the name of the second in a sentence.
    """

    first: str
    second: str
    distance: float
    required: float
    where: str = ""

    def __str__(self) -> str:
        """Sentence for a refusal."""
        second = self.second + self.where
        if self.distance <= 0.0:
            return f"{self.first} would hit {second} ({-self.distance * 1e3:.0f} mm deep)"
        return (
            f"{self.first} would come within {self.distance * 1e3:.1f} mm of {second},"
            f" expected {self.required * 1e3:.0f} mm"
        )
