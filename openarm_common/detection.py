# SPDX-License-Identifier: Apache-2.0
"""An object detected in one image: an upright box in the base frame. The detector produces it, grasping reads it.

The z axis of the box is up, `size[0]` and `size[1]` are its horizontal edges along its x and y, `size[2]` its height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openarm_common.types import Array

#: A cube is a box whose edges differ by less; a can is a cylinder at least this many times as tall as wide.
CUBE_RATIO, CAN_RATIO = 1.15, 1.5
#: The wider kind that a kind belongs to.
WIDER = {"cube": "box", "can": "cylinder"}


@dataclass(frozen=True, eq=False)
class Detection:
    """One object in one image.

    Attributes:
        label: Its class: a colour, or a class of a network.
        score: Confidence, 0 to 1.
        T_base_object: (4, 4) pose of the centre of the box, yaw only, m.
        size: (3,) full edges, m.
        round: Whether it is a circle seen from above: its yaw means nothing, and a hand may approach from any side.
        kind: Shape: box, cube, cylinder, can, sphere; empty when it is not known.
        measured: Whether the box is that of the object. If not, it encloses what is visible of the object: an obstacle,
            but no target.
    """

    label: str
    score: float
    T_base_object: Array
    size: Array
    round: bool = False
    kind: str = ""
    measured: bool = True

    @property
    def p_base(self) -> Array:
        """Centre, (3,), m."""
        return self.T_base_object[:3, 3]

    @property
    def top(self) -> float:
        """Height of the upper face, m."""
        return float(self.T_base_object[2, 3] + self.size[2] / 2.0)

    @property
    def bottom(self) -> float:
        """Height of the lower face, m."""
        return float(self.T_base_object[2, 3] - self.size[2] / 2.0)

    @property
    def yaw(self) -> float:
        """Angle of the x axis about the z axis of the base, rad in (-pi, pi]."""
        return float(np.arctan2(self.T_base_object[1, 0], self.T_base_object[0, 0]))


def kind_of(shape: str, size: Array) -> str:
    """Return the kind of a shape (box, cylinder, sphere) of measured edges (3,), m, the last the height."""
    if shape == "box":
        return "cube" if max(size) <= CUBE_RATIO * min(size) else "box"
    if shape == "cylinder":
        return "can" if size[2] >= CAN_RATIO * max(size[:2]) else "cylinder"
    return shape
