# SPDX-License-Identifier: Apache-2.0
"""An object detected in one image: an upright box in the base frame. The detector produces it, grasping reads it.

The z axis of the box is up, `size[0]` and `size[1]` are its horizontal edges along its x and y, `size[2]` its height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openarm_common.errors import Code
from openarm_common.types import Array

#: A cube is a box whose edges differ by less; a can is a cylinder at least this many times as tall as wide.
CUBE_RATIO, CAN_RATIO = 1.15, 1.5
#: The wider shape that a shape belongs to.
WIDER = {"cube": "box", "can": "cylinder"}
#: Names of shapes. A network's class of such a name says what shape an object has, not what it is.
KINDS = frozenset({"box", "cylinder", "sphere", *WIDER})


class Described:
    """What is known of an object besides where it is.

    Attributes:
        name: Class of a network, or of a tag; empty when nothing says so.
        color: A colour of the palette; empty when it has none.
        kind: Shape: box, cube, cylinder, can, sphere; empty when it is not known.
    """

    name: str
    color: str
    kind: str

    @property
    def label(self) -> str:
        """What tells it from others: its name, else its colour, else its wider shape."""
        return self.name or self.color or WIDER.get(self.kind, self.kind) or "object"

    @property
    def attributes(self) -> tuple[str, ...]:
        """All that it may be called: its label, then colour, shape and wider shape, those that are known."""
        every = (self.label, self.color, self.kind, WIDER.get(self.kind, ""))
        return tuple(dict.fromkeys(attribute for attribute in every if attribute))


#: Name of what is found without knowing what it is.
ANYTHING = "anything"


@dataclass(frozen=True, eq=False)
class Detection(Described):
    """One object in one image.

    Attributes:
        name: Same as for `Described`; so are `color` and `kind`.
        score: Confidence, 0 to 1.
        T_base_object: (4, 4) pose of the centre of the box, yaw only, m.
        size: (3,) full edges, m.
        round: True for a circle seen from above: its yaw means nothing, and a hand may approach from any side.
        measured: Whether the box is that of the object. If not, it encloses what is visible of the object: an obstacle,
            and a target only where nothing is known of the object but its points.
        code: Why it was not measured: NOTHING_DETECTED (hidden, or cut by the border of the image), or a mismatch.
        id: Id of the object, the same in every image that shows it; empty where it is not followed.
    """

    name: str
    score: float
    T_base_object: Array
    size: Array
    round: bool = False
    kind: str = ""
    measured: bool = True
    code: Code = Code.NOTHING_DETECTED
    color: str = ""
    id: str = ""

    @property
    def in_part(self) -> bool:
        """Whether only a part of something of unknown shape is seen: the rest is hidden, or beyond the border."""
        return self.name == ANYTHING and not self.measured and self.code is Code.NOTHING_DETECTED

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
    def foot(self) -> Array:
        """Middle of the lower face, (3,), m."""
        return np.array([*self.p_base[:2], self.bottom])

    @property
    def yaw(self) -> float:
        """Angle of the x axis about the z axis of the base, rad in (-pi, pi]."""
        return float(np.arctan2(self.T_base_object[1, 0], self.T_base_object[0, 0]))


def gap(a: Detection, b: Detection) -> float:
    """Return the horizontal distance of the boxes of two objects, m; 0 where one is over the other."""
    step, axes = (b.p_base - a.p_base)[:2], np.concatenate([d.T_base_object[:2, :2].T for d in (a, b)])
    halves = [np.abs(axes @ d.T_base_object[:2, :2]) @ d.size[:2] / 2.0 for d in (a, b)]
    if (np.abs(axes @ step) <= halves[0] + halves[1]).all():
        return 0.0
    return min(_nearest_corner(a, b), _nearest_corner(b, a))


def _nearest_corner(a: Detection, b: Detection) -> float:
    """Return the distance of the nearest corner of a box from another one, seen from above, m."""
    corners = (np.indices((2, 2)).reshape(2, -1).T - 0.5) * a.size[:2] @ a.T_base_object[:2, :2].T + a.p_base[:2]
    return float(distances_from(b, corners).min())


def distances_from(one: Detection, xy: Array) -> Array:
    """Return the horizontal distances (n,) of points (n, 2) from the box of an object, m; 0 within."""
    local = (xy - one.p_base[:2]) @ one.T_base_object[:2, :2]
    return np.asarray(np.linalg.norm(np.maximum(np.abs(local) - one.size[:2] / 2.0, 0.0), axis=1), dtype=np.float64)


def kind_of(shape: str, size: Array) -> str:
    """Return the kind of a shape (box, cylinder, sphere) of measured edges (3,), m, the last the height."""
    if shape == "box":
        return "cube" if max(size) <= CUBE_RATIO * min(size) else "box"
    if shape == "cylinder":
        return "can" if size[2] >= CAN_RATIO * max(size[:2]) else "cylinder"
    return shape
