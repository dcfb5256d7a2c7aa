# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the distance field: exact Euclidean distances between cell centres, cut at a reach.

Each axis is one pass (Felzenszwalb and Huttenlocher 2012: the lower envelope of parabolas), in whole cells squared.
Because distances are cut at `reach` cells, cells further away than that never matter: a pass reads only the
neighbours within reach, and skips lines that have nothing within it.
"""

from __future__ import annotations

import numpy as np

from openarm_common.kernels import kernel
from openarm_common.types import Bytes, Floats


@kernel
def along_z(states: Bytes, obstacle: int, cap: np.float32, out: Floats) -> None:
    """Compute squared distances along z to the nearest obstacle, cut at `cap`.

    Args:
        states: (nx, ny, nz).
        obstacle: State of an obstacle.
        cap: Squared reach, cells.
        out: (nx, ny, nz), filled.
    """
    nx, ny, nz = states.shape
    for i in range(nx):
        for j in range(ny):
            row = states[i, j]
            line = out[i, j]
            last = -100000
            for k in range(nz):
                if row[k] == obstacle:
                    last = k
                d = np.float32(k - last)
                line[k] = min(d * d, cap)
            last = 100000
            for k in range(nz - 1, -1, -1):
                if row[k] == obstacle:
                    last = k
                d = np.float32(last - k)
                line[k] = min(line[k], d * d)


@kernel
def along_y(squares: Floats, cap: np.float32, reach: int, scratch: Floats) -> None:
    """Run the second pass in place: all z of one row at a time, so that the inner loop runs over neighbours in memory.

    Args:
        squares: (nx, ny, nz) of the pass before, changed.
        cap: Squared reach, cells.
        reach: Cells.
        scratch: (ny, nz).
    """
    nx, ny, nz = squares.shape
    near = np.empty(ny, np.bool_)
    for i in range(nx):
        plane = squares[i]
        for j in range(ny):
            least = cap
            for k in range(nz):
                scratch[j, k] = plane[j, k]
                least = min(least, plane[j, k])
            near[j] = least < cap
        for j in range(ny):
            line = plane[j]
            for other in range(max(j - reach, 0), min(j + reach + 1, ny)):
                if other == j or not near[other]:
                    continue
                d = np.float32((other - j) * (other - j))
                source = scratch[other]
                for k in range(nz):
                    candidate = source[k] + d
                    line[k] = candidate if candidate < line[k] else line[k]


@kernel
def along_x(squares: Floats, cap: np.float32, reach: int, edge: np.float32, scratch: Floats, ring: Floats) -> None:
    """Run the third pass in place, and convert to metres.

    Args:
        squares: (nx, ny, nz) of the pass before; distances afterwards, m.
        cap: Squared reach, cells.
        reach: Cells.
        edge: Edge of a cell, m.
        scratch: (nz,).
        ring: (reach, ny, nz): squares of the last planes that hold distances already.
    """
    nx, ny, nz = squares.shape
    near = np.empty((nx, ny), np.bool_)
    for i in range(nx):
        for j in range(ny):
            least = cap
            for k in range(nz):
                least = min(least, squares[i, j, k])
            near[i, j] = least < cap
    for i in range(nx):
        for j in range(ny):
            line = scratch
            for k in range(nz):
                line[k] = squares[i, j, k]
            for other in range(max(i - reach, 0), min(i + reach + 1, nx)):
                if other == i or not near[other, j]:
                    continue
                d = np.float32((other - i) * (other - i))
                source = squares[other, j] if other > i else ring[other % reach, j]
                for k in range(nz):
                    candidate = source[k] + d
                    line[k] = candidate if candidate < line[k] else line[k]
            target, kept = squares[i, j], ring[i % reach, j]
            for k in range(nz):
                kept[k] = target[k]
                target[k] = np.sqrt(line[k]) * edge
