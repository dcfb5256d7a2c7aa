# SPDX-License-Identifier: Apache-2.0
"""An object as it lies, in the frame of the upright box around it, which scenes, worlds and judges speak of."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.objects.model import ObjectModel, load_object
from openarm_common.objects.solid import Part
from openarm_common.types import Array


@dataclass(frozen=True, eq=False)
class PosedObject:
    """An object and the upright box around it.

    Attributes:
        model: The object.
        T_box_object: (4, 4) its own frame in that of the box, whose origin is the middle and whose z is up.
        size: Edges of the box, m.
    """

    model: ObjectModel
    T_box_object: Array
    size: tuple[float, float, float]

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Convex parts in the frame of the box."""
        return tuple(part.moved(self.T_box_object) for part in self.model.parts)

    @cached_property
    def corners(self) -> Array:
        """Corners (n, 3) of the parts in the frame of the box, m."""
        return se3.apply(self.T_box_object, self.model.points)

    @cached_property
    def visual(self) -> Array:
        """Vertices (n, 3) of what is seen, in the frame of the box, m."""
        return se3.apply(self.T_box_object, self.model.visual.vertices)


def posed_object(source: str, side: int = 0, attitude: tuple[float, ...] | None = None) -> PosedObject:
    """Return an object as it lies.

    Args:
        source: Same as for `load_object`.
        side: Number of the side that it rests on, the most frequent first; not used with an attitude.
        attitude: Quaternion (x, y, z, w) of its own frame in that of the box; None: it rests on the side.

    Raises:
        OpenArmError: CONFIG_INVALID, as `load_object`; INVALID_ARGUMENT for a side that it has not.
    """
    return _posed(load_object(source), side, attitude)


@lru_cache(maxsize=256)
def _posed(model: ObjectModel, side: int, attitude: tuple[float, ...] | None) -> PosedObject:
    if attitude is not None:
        R = se3.matrix_from_quat_xyzw(attitude)
    elif 0 <= side < len(model.sides):
        R = model.sides[side].R
    else:
        text = f"object {model.source!r} has no side {side}; sides: 0 to {len(model.sides) - 1}"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    points = model.points @ R.T
    low, high = points.min(axis=0), points.max(axis=0)
    x, y, z = (float(np.round(edge, 6)) for edge in high - low)
    return PosedObject(model, se3.make(R, -0.5 * (low + high)), (x, y, z))
