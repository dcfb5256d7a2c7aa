# SPDX-License-Identifier: Apache-2.0
"""The hand of a robot: what a position of its finger joint means in metres, and its measures.

*Finger* is the distance of a pad from the middle of the hand, m: half of the aperture. Drivers and joint states speak
of the joint that drives the fingers, m of a slide or rad of a hinge, whose sign may differ from arm to arm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from openarm_common.config import Config
from openarm_common.types import Array

if TYPE_CHECKING:
    from openarm_common.robot.zeros import HandReach

#: Room that an open finger keeps to each side of what it goes around, m: the error of a pose.
_ROOM = 0.005

Length = Annotated[float, Field(ge=0.0, le=0.2)]


class HandParts(Config):
    """A hand as `robot.yaml` says it; of a robot whose hands differ in nothing but the sign of the finger joint.

    Attributes:
        fingers: [position of the finger joint, finger], from closed to open; linear between. m, or rad.
        tcp: [finger, how far the pads meet an object beyond the TCP link along its z], m; linear between.
        opening: Finger of a hand that is open for a grasp, m.
        tip_clearance: TCP above a surface so that the tips clear it, m.
        tip_clearance_tilted: Added times sin(tilt), m.
        pad_centre: Middle of the pads behind the TCP, m.
        palm_depth: Deepest that an object may reach between the fingers, m.
        palm_depth_tilted: Taken off times sin(tilt), m.
        armature: Inertia of the finger drive at the finger joint, kg, or kg m2.
    """

    fingers: tuple[tuple[float, float], ...] = Field(min_length=2)
    tcp: tuple[tuple[float, float], ...] = Field(default=((0.0, 0.0),), min_length=1)
    opening: float = Field(gt=0.0, le=0.1)
    tip_clearance: Length
    tip_clearance_tilted: Length
    pad_centre: Length
    palm_depth: Length
    palm_depth_tilted: Length
    armature: float = Field(gt=0.0)

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        for name, rows in (("fingers", np.array(self.fingers)), ("tcp", np.array(self.tcp))):
            if (np.diff(rows[:, 0]) <= 0.0).any() or (name == "fingers" and (np.diff(rows[:, 1]) <= 0.0).any()):
                raise ValueError(f"{name}: expected ascending rows, got {rows.tolist()}")
        if not self.opening <= self.fingers[-1][1]:
            raise ValueError(f"opening {self.opening:g} m is beyond the last of fingers, {self.fingers[-1][1]:g} m")
        return self

    @property
    def max_width(self) -> float:
        """Widest side of an object that the open hand has room around, m."""
        return 2.0 * (self.opening - _ROOM)

    def tcp_shift(self, finger: float) -> float:
        """How far beyond the TCP link fingers meet an object, along its z, m."""
        return float(np.interp(finger, *np.array(self.tcp).T))


@dataclass(frozen=True, eq=False)
class Hand:
    """The fingers of one arm.

    Attributes:
        joint: Joint that drives them.
        sign: Sign of its positions, against those of `parts`.
        parts: Measures; the opening is that of the reach.
        reach: Reach that was learned; None: the drawing stands for it.
    """

    joint: str
    sign: float
    parts: HandParts
    reach: HandReach | None = None

    def with_reach(self, reach: HandReach) -> Hand:
        """Return the hand as it was learned."""
        return replace(self, parts=self.parts.model_copy(update={"opening": reach.opened}), reach=reach)

    @cached_property
    def _table(self) -> Array:
        return np.array(self.parts.fingers).T

    def finger(self, position: float) -> float:
        """Return the finger (m) at a position of the joint; beyond the table the line goes on."""
        return _along(self.sign * position, *self._table)

    def position(self, finger: float) -> float:
        """Return the position of the joint (m, or rad) that puts a pad so far from the middle, m."""
        return self.sign * _along(finger, *self._table[::-1])

    @cached_property
    def lever(self) -> float:
        """What a finger moves when the joint does, the mean up to where the hand is open: ±1 for a slide, m/rad."""
        return (self.parts.opening - self.finger(self.closed)) / (self.opened - self.closed)

    @property
    def opened(self) -> float:
        """Position of the joint of a hand that is open for a grasp."""
        return self.position(self.parts.opening)

    @property
    def closed(self) -> float:
        """Position of the joint of a closed hand, whose pads meet or are as near to each other as they come."""
        return self.sign * max(self.sign * self.position(0.0), self.parts.fingers[0][0])


def _along(x: float, xs: Array, ys: Array) -> float:
    """Return y at x of a polygon whose first and last edge go on."""
    k = int(np.clip(np.searchsorted(xs, x) - 1, 0, len(xs) - 2))
    return float(ys[k] + (x - xs[k]) * (ys[k + 1] - ys[k]) / (xs[k + 1] - xs[k]))
