# SPDX-License-Identifier: Apache-2.0
"""What one image shows in space, point by point: which detection each point belongs to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.types import Array, Floats


@dataclass(frozen=True, eq=False)
class LabelledCloud:
    """Points of one image, m.

    Attributes:
        points: (n, 3) float32.
        labels: (n,) uint32: i is the i-th detection of the same image, counted from 1; 0 is none of them: the table, or
            what was not detected.
        camera: (3,) where the image was taken from, in the frame of the points.
        measured: Whether depth has measured them; else they are those of boxes, on which no surface is known.
    """

    points: Floats
    labels: NDArray[np.uint32]
    camera: Array
    measured: bool = True

    def moved(self, T: Array) -> LabelledCloud:
        """Return the same in another frame: T (4, 4) is the pose of this one in it."""
        points = self.points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
        return replace(self, points=points, camera=se3.apply(T, self.camera))
