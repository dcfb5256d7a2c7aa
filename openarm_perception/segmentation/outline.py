# SPDX-License-Identifier: Apache-2.0
"""What lies beyond the outline of each thing in an image: background, the image's border, what hides it, or nothing.

A sensor that looks with two eyes has a gap without depth at every step. So a place where nothing was measured is
crossed up to a width before it counts as missing.
"""

# pyright: reportUntypedFunctionDecorator=false, reportMissingTypeStubs=false, reportUnknownVariableType=false

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openarm_common.kernels import kernel
from openarm_common.types import Array, Mask
from openarm_perception.geometry.depth import Points

#: Columns of what `survey` counts.
_FREE, _BORDER, _HIDDEN, _MISSING, _TOUCHING = range(5)
#: Gaps without depth up to this share of the image's width are crossed.
_GAP = 0.06
#: A neighbour nearer to the camera by this hides the thing, m, or by four times the noise.
_NEARER = 0.01


@dataclass(frozen=True)
class Outline:
    """Shares of the outline of a thing, 0 to 1; they add up to 1.

    Attributes:
        free: Beyond it is the support, or what is farther away.
        border: The image ends.
        hidden: Something nearer to the camera, or the robot, is in front of it.
        missing: Nothing was measured.
        touching: Another thing at the same depth.
    """

    free: float
    border: float
    hidden: float
    missing: float
    touching: float

    @property
    def cut(self) -> str:
        """What cuts the outline, in words; empty when all of it is in view."""
        parts = (
            ("the image's border", self.border),
            ("something nearer", self.hidden),
            ("missing depth", self.missing),
        )
        return ", ".join(f"{name} ({share:.0%})" for name, share in parts if share > 0.05)


def survey(label: NDArray[np.uint16], points: Points, robot: Mask, noise: float) -> tuple[Outline, ...]:
    """Return the outline of each thing 1, 2, … of an image.

    Args:
        label: (h, w) 0: none.
        points: (h, w, 3) organised, optical frame, m.
        robot: (h, w) pixels of the robot.
        noise: Noise of a depth at 1 m, m.
    """
    count = int(label.max())
    sums = _survey(label, points, robot, np.float32(noise), max(2, round(_GAP * label.shape[1])), count)
    shares = sums / np.maximum(sums.sum(axis=1, keepdims=True), 1.0)
    return tuple(Outline(*(float(v) for v in row)) for row in shares[1:])


@kernel
def _survey(label: NDArray[np.uint16], points: Points, robot: Mask, noise: np.float32, gap: int, count: int) -> Array:
    h, w = label.shape
    out = np.zeros((count + 1, 5))
    for v in range(h):
        for u in range(w):
            a = label[v, u]
            if a == 0:
                continue
            z = points[v, u, 2]
            for side in range(4):
                dv = (0, 0, 1, -1)[side]
                du = (1, -1, 0, 0)[side]
                j, i = v + dv, u + du
                if 0 <= j < h and 0 <= i < w and label[j, i] == a:
                    continue
                found = _MISSING
                for _ in range(gap + 1):
                    if not (0 <= j < h and 0 <= i < w):
                        found = _BORDER
                        break
                    if label[j, i] == a:  # a hole in it
                        found = -1
                        break
                    if robot[j, i]:
                        found = _HIDDEN
                        break
                    other = points[j, i, 2]
                    if other > 0.0:
                        step = max(_NEARER, 4.0 * noise * z * z)
                        if other < z - step:
                            found = _HIDDEN
                            if label[j, i] == 0:  # what floats before it, or the thing itself hides a part of itself
                                j += dv
                                i += du
                                continue
                        elif label[j, i] != 0 and other < z + step:
                            found = _TOUCHING
                        else:
                            found = _FREE
                        break
                    j += dv
                    i += du
                if found >= 0:
                    out[a, found] += 1.0
    return out
