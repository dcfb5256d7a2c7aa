# SPDX-License-Identifier: Apache-2.0
"""The leaves of an octree in cells of another size, or in another frame.

A cell is occupied where an occupied leaf overlaps it, free where free leaves cover all of it, and unknown else. In a
turned frame it counts for its bounding box along the axes of the leaves, so more is occupied, never less.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from openarm_common.kernels import kernel
from openarm_common.octree.block_kernels import EDGE
from openarm_common.octree.lattice import KEY_ZERO, Lattice
from openarm_common.types import Array, Floats, Ints

#: Cells that are worked on at a time: twelve bytes each.
_PART = 1 << 23
#: Of a cell of the leaves: faces that are nearer to each other are the same, since files round their resolution.
_SAME = 1e-3
#: Share of a cell that may be missing where it is covered, for rounding.
_ROUNDING = 1e-9

Keys = NDArray[np.int32]
Leaves = Callable[[], Iterable[tuple[Keys, Floats]]]


def resampled(leaves: Leaves, edge: float, lattice: Lattice, T_map_leaves: Array) -> Iterator[tuple[int, Floats, int]]:
    """Yield a box of cells, some layers of blocks at a time.

    Args:
        leaves: Begins with the first leaves each time: (n, 4) level, x, y, z key at that level, and log-odds (n,).
        edge: Edge of their cells of level 0, m.
        lattice: The box; its faces lie at keys that are multiples of 8.
        T_map_leaves: (4, 4) the leaves' frame in that of the box.

    Yields:
        The first layer of blocks, along x; log-odds (8 layers, ny, nz), the largest of what overlaps a cell, NaN where
        unknown; and how many leaves lie outside of the box, wholly or in part, all of them with the first layer.
    """
    ratio = lattice.resolution / edge
    turn, shift = T_map_leaves[:3, :3], T_map_leaves[:3, 3]
    # cells of the box to cells of the leaves, and back; both from the origin of their frame
    there = np.column_stack([turn.T * ratio, -turn.T @ shift / edge])
    back = np.column_stack([turn / ratio, shift / lattice.resolution])
    nx, ny, nz = lattice.shape
    first: Ints = np.array(lattice.key_min, np.int64) - KEY_ZERO
    box: Ints = np.stack([first, first + lattice.shape])
    layers = max(_PART // (ny * nz) // EDGE, 1) * EDGE
    for begin in range(0, nx, layers):
        size = min(layers, nx - begin)
        values = np.full((size, ny, nz), -np.inf, np.float32)
        covered = np.zeros((size, ny, nz))
        outside = 0
        for keys, log_odds in leaves():
            outside += _add(keys, log_odds, there, back, box, first + np.array([begin, 0, 0]), values, covered)
        values[(values < 0.0) & (covered < 1.0 - _ROUNDING)] = np.nan
        yield begin // EDGE, values, outside if begin == 0 else 0


@kernel
def _add(
    keys: Keys, log_odds: Floats, there: Array, back: Array, box: Ints, first: Ints, values: Floats, covered: Array
) -> int:
    """Add leaves to the cells that they overlap.

    Args:
        keys: (n, 4) level, x, y, z key at that level.
        log_odds: (n,).
        there: (3, 4) from places in cells of the box to places in cells of the leaves.
        back: (3, 4) the inverse.
        box: (2, 3) the cells of the box, the last ones excluded.
        first: (3,) the cell values[0, 0, 0].
        values: (nx, ny, nz) the largest log-odds so far.
        covered: (nx, ny, nz) the share of each cell that leaves cover so far.

    Returns:
        How many leaves lie outside of the box, wholly or in part.
    """
    half, reach, lower = np.empty(3), np.empty(3), np.empty((2, 3))
    begin, end = np.empty(3, np.int64), np.empty(3, np.int64)
    for k in range(3):
        half[k] = 0.5 * (abs(there[k, 0]) + abs(there[k, 1]) + abs(there[k, 2]))
    same = _SAME * min(1.0, 2.0 * half.min())
    outside = 0
    for i in range(keys.shape[0]):
        edge = np.int64(1) << keys[i, 0]
        out = False
        for k in range(3):
            lower[0, k] = (np.int64(keys[i, 1 + k]) << keys[i, 0]) - KEY_ZERO
        for k in range(3):
            middle, reach[k] = back[k, 3], 0.0
            size = 0.0
            for j in range(3):
                middle += back[k, j] * (lower[0, j] + 0.5 * edge)
                size += abs(back[k, j]) * 0.5 * edge
                reach[k] += abs(back[k, j]) * (half[j] + 0.5 * edge)
            out = out or middle - size < box[0, k] - same or middle + size > box[1, k] + same
            begin[k] = max(np.int64(np.ceil(max(middle - reach[k] - 0.5, -1e9))), first[k])
            end[k] = min(np.int64(np.floor(min(middle + reach[k] + 0.5, 1e9))), first[k] + values.shape[k])
        outside += out
        for x in range(begin[0], end[0]):
            for y in range(begin[1], end[1]):
                for z in range(begin[2], end[2]):
                    share = 1.0
                    for k in range(3):
                        at = there[k, 0] * (x + 0.5) + there[k, 1] * (y + 0.5) + there[k, 2] * (z + 0.5) + there[k, 3]
                        low, high = at - half[k], at + half[k]
                        low = np.round(low) if abs(low - np.round(low)) < same else low
                        high = np.round(high) if abs(high - np.round(high)) < same else high
                        share *= max(min(high, lower[0, k] + edge) - max(low, lower[0, k]), 0.0) / (high - low)
                    if share > 0.0:
                        cell = (x - first[0], y - first[1], z - first[2])
                        values[cell] = max(values[cell], log_odds[i])
                        covered[cell] += share
    return outside
