# SPDX-License-Identifier: Apache-2.0
"""How a thing of any shape is turned, seen from above: along most of its walls.

The least rectangle about a hammer, a triangle seen from above, may lie along any of its three sides, and changes with
the noise. Its handle does not.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from openarm_common.types import Array

#: Standard deviation of the blur that takes the steps off the outline, cells.
_BLUR = 1.5


def wall_yaw(xy: Array, step: float) -> float:
    """Return the direction of most walls of what points (n, 2) cover, to a quarter turn: rad in (-pi/4, pi/4].

    Args:
        xy: Points, spaced no farther than a step, m.
        step: Edge of a cell of the grid that they are put in, m.
    """
    cell = np.floor((xy - xy.min(axis=0)) / step).astype(np.int64) + 3
    mask = np.zeros(cell.max(axis=0) + 4, np.float32)
    mask[tuple(cell.T)] = 1.0
    soft = gaussian_filter(mask, _BLUR)
    gx, gy = np.gradient(soft, axis=0), np.gradient(soft, axis=1)
    walls = np.hypot(gx, gy) * np.exp(4.0j * np.arctan2(gy, gx))
    return float(np.angle(walls.sum())) / 4.0
