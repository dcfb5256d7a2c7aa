# SPDX-License-Identifier: Apache-2.0
"""What moves with a hand: objects that were in the boxes that it holds when it began to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.held import HeldBox
from openarm_common.types import Array

#: What is so near to the box of a hand is in it, m: the hand has moved it a little as it closed.
_MARGIN = 0.01


@dataclass(frozen=True, eq=False)
class HeldBoxes:
    """Boxes that a hand holds.

    Attributes:
        T_base_hand: Pose of the hand, (4, 4).
        boxes: Pose of the middle of each in the hand, (4, 4), and its edges (3,), m.
    """

    T_base_hand: Array
    boxes: tuple[tuple[Array, tuple[float, float, float]], ...]

    @property
    def middle(self) -> Array:
        """(3,) middle of the boxes, base frame, m."""
        return np.mean([(self.T_base_hand @ T)[:3, 3] for T, _ in self.boxes], axis=0)

    def share(self, points: Array) -> float:
        """Share of the points (n, 3), base frame, that is in one of the boxes, or nearly."""
        inside = np.zeros(len(points), dtype=np.bool_)
        for T, size in self.boxes:
            local = se3.apply(se3.inverse(self.T_base_hand @ T), points)
            inside |= (np.abs(local) <= np.asarray(size) / 2.0 + _MARGIN).all(axis=1)
        return float(inside.mean())


@dataclass(frozen=True, eq=False)
class Grip:
    """Objects that a hand holds, and where it was.

    Attributes:
        T_base_hand: Pose of the hand in the newest image, (4, 4).
        ids: Ids of the objects.
    """

    T_base_hand: Array
    ids: tuple[int, ...]


def carriers(
    description: RobotDescription, joints: Mapping[str, float], held: Sequence[HeldBox]
) -> dict[str, HeldBoxes]:
    """Return what the hands hold, by link, and where it is.

    Args:
        description: The robot.
        joints: Positions by joint name, rad or m.
        held: Boxes that the hands hold; on links of the robot.
    """
    boxes = dict[str, list[HeldBox]]()
    for box in held:
        boxes.setdefault(box.link, []).append(box)
    return {
        link: HeldBoxes(description.link_pose(link, joints), tuple((box.T_link_box, box.size) for box in some))
        for link, some in boxes.items()
    }


class Body(Protocol):
    """An object: its number and its points (n, 3), base frame, m."""

    @property
    def id(self) -> int: ...  # noqa: D102
    @property
    def points(self) -> Array: ...  # noqa: D102


def motions(before: Mapping[str, Grip], now: Mapping[str, HeldBoxes]) -> dict[int, Array]:
    """Return how hands have moved what they hold (4, 4), by id."""
    out = dict[int, Array]()
    for name, grip in before.items():
        if name in now:
            out |= dict.fromkeys(grip.ids, now[name].T_base_hand @ se3.inverse(grip.T_base_hand))
    return out


def let_go(before: Mapping[str, Grip], now: Mapping[str, HeldBoxes]) -> frozenset[int]:
    """Return the ids of what hands have held that hold nothing any more."""
    return frozenset(i for name, grip in before.items() if name not in now for i in grip.ids)


def gripped(
    before: Mapping[str, Grip], now: Mapping[str, HeldBoxes], bodies: Sequence[Body], least: float
) -> dict[str, Grip]:
    """Return what hands hold: what they have held, and one that has closed since what is in its boxes.

    Args:
        before: Grips of each in the image before.
        now: Boxes of each hand in this image, by the same names.
        bodies: All objects.
        least: Share of the points of an object that is in the boxes of what holds it.
    """
    return {
        name: Grip(
            held.T_base_hand,
            before[name].ids if name in before else tuple(one.id for one in bodies if held.share(one.points) >= least),
        )
        for name, held in now.items()
    }
