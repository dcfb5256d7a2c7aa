# SPDX-License-Identifier: Apache-2.0
"""What moves with a hand: objects that were in the box that it holds when it began to."""

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
class Carrier:
    """A box that a hand holds.

    Attributes:
        T_base_box: Pose of its middle, (4, 4).
        size: Edges (3,), m.
    """

    T_base_box: Array
    size: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Grip:
    """Objects that a carrier holds, and where it was.

    Attributes:
        T_base_box: Pose of its middle in the newest image, (4, 4).
        ids: Ids of the objects.
    """

    T_base_box: Array
    ids: tuple[int, ...]


def carriers(description: RobotDescription, joints: Mapping[str, float], held: Sequence[HeldBox]) -> dict[str, Carrier]:
    """Return where the boxes are that the hands hold.

    Args:
        description: The robot.
        joints: Positions by joint name, rad or m.
        held: Boxes that the hands hold; on links of the robot.
    """
    return {box.name: Carrier(description.link_pose(box.link, joints) @ box.T_link_box, box.size) for box in held}


class Body(Protocol):
    """An object: its number and its points (n, 3), base frame, m."""

    @property
    def id(self) -> int: ...  # noqa: D102
    @property
    def points(self) -> Array: ...  # noqa: D102


def motions(before: Mapping[str, Grip], now: Mapping[str, Carrier]) -> dict[int, Array]:
    """Return how carriers have moved what they hold (4, 4), by id."""
    out = dict[int, Array]()
    for name, grip in before.items():
        if name in now:
            out |= dict.fromkeys(grip.ids, now[name].T_base_box @ se3.inverse(grip.T_base_box))
    return out


def let_go(before: Mapping[str, Grip], now: Mapping[str, Carrier]) -> frozenset[int]:
    """Return the ids of what carriers have held that are no more."""
    return frozenset(i for name, grip in before.items() if name not in now for i in grip.ids)


def gripped(
    before: Mapping[str, Grip], now: Mapping[str, Carrier], bodies: Sequence[Body], least: float
) -> dict[str, Grip]:
    """Return what carriers hold: what they have held, and a new one what is in its box.

    Args:
        before: Grips of each in the image before.
        now: Carriers of this image, by the same names.
        bodies: All objects.
        least: Share of the points of an object that is in the box of what holds it.
    """
    grips = dict[str, Grip]()
    for name, carrier in now.items():
        if name in before:
            ids = before[name].ids
        else:
            T, half = se3.inverse(carrier.T_base_box), np.asarray(carrier.size) / 2.0 + _MARGIN
            inside = {one.id: np.mean((np.abs(se3.apply(T, one.points)) <= half).all(axis=1)) for one in bodies}
            ids = tuple(i for i, share in inside.items() if share >= least)
        grips[name] = Grip(carrier.T_base_box, ids)
    return grips
