# SPDX-License-Identifier: Apache-2.0
"""Numba kernel that takes what the robot fills out of the map; shapes are those of `robot.filter_kernels`."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from openarm_common.octree.lattice import KEY_ZERO
from openarm_common.robot.filter_kernels import inside
from openarm_common.types import Array, Bytes, Floats, Ints
from openarm_octomap.kernels import OCCUPIED, UNKNOWN


@njit(cache=True, nogil=True)
def reset_cells(
    kinds: Ints, halves: Array, T_shape_base: Array,
    resolution: float, key_min: Ints, log_odds: Floats, states: Bytes, changed: NDArray[np.int32],
) -> int:  # fmt: skip
    """Make the occupied cells unknown whose centre lies in a shape.

    Args:
        kinds: (n,).
        halves: (n, 3).
        T_shape_base: (n, 3, 4).
        resolution: Edge of a cell, m.
        key_min: (3,) key of states[0, 0, 0].
        log_odds: (nx, ny, nz), changed.
        states: (nx, ny, nz), changed.
        changed: Filled with the flat indices of the cells.

    Returns:
        How many cells there were.
    """
    count = 0
    _, ny, nz = states.shape
    for i in range(kinds.size):
        T, half = T_shape_base[i], halves[i]
        lo, hi = np.empty(3, np.int64), np.empty(3, np.int64)
        for k in range(3):
            centre = -(T[0, k] * T[0, 3] + T[1, k] * T[1, 3] + T[2, k] * T[2, 3])
            reach = abs(T[0, k]) * half[0] + abs(T[1, k]) * half[1] + abs(T[2, k]) * half[2]
            lo[k] = max(int(np.floor((centre - reach) / resolution)) + KEY_ZERO - key_min[k], 0)
            hi[k] = min(int(np.floor((centre + reach) / resolution)) + KEY_ZERO - key_min[k] + 1, states.shape[k])
        for a in range(lo[0], hi[0]):
            x = (a + key_min[0] - KEY_ZERO + 0.5) * resolution
            for b in range(lo[1], hi[1]):
                y = (b + key_min[1] - KEY_ZERO + 0.5) * resolution
                for c in range(lo[2], hi[2]):
                    if states[a, b, c] != OCCUPIED:
                        continue
                    z = (c + key_min[2] - KEY_ZERO + 0.5) * resolution
                    px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
                    py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
                    pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
                    if inside(kinds[i], px, py, pz, half[0], half[1], half[2]):
                        states[a, b, c] = UNKNOWN
                        log_odds[a, b, c] = np.float32(np.nan)
                        changed[count] = (a * ny + b) * nz + c
                        count += 1
    return count
