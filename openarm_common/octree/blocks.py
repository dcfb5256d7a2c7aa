# SPDX-License-Identifier: Apache-2.0
"""Cells of a box with log-odds, in blocks of 8 × 8 × 8 that take memory only where their cells differ.

A block whose cells are all alike (unknown, or free as often) is one number; the others have one byte for each cell,
two once the map has more than 256 different log-odds, four beyond 65536. Log-odds are exact float32 all the same: a
cell is an index into a palette of those that there are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.octree import block_kernels as kernels
from openarm_common.octree.block_kernels import CELLS, EDGE, UNKNOWN, Palette, Rows
from openarm_common.octree.lattice import Lattice
from openarm_common.types import Bytes, Floats, Ints

#: Codes that a cell of one and of two bytes can have.
_BYTE, _WORD = 1 << 8, 1 << 16
#: Rows that are added at a time, at least.
_ROWS = 64


def empty_rows(owners: int, cells: int, dtype: type[np.generic]) -> Rows:
    """Return rows for a number of blocks or parts of blocks, of which none has one yet."""
    pool = np.empty((0, cells), dtype)
    return Rows(np.full(owners, -1, np.int32), pool, np.empty(0, np.int32), np.zeros(1, np.int64))


def more_rows(rows: Rows) -> Rows:
    """Return the same rows and an eighth more, of zeros."""
    n, cells = rows.pool.shape
    added = min(max(n // 8, _ROWS), rows.table.size - n)
    # in place: a copy next to the old pool would be the most memory that a map ever takes
    rows.pool.resize((n + added, cells), refcheck=False)
    spare = np.empty(n + added, np.int32)
    top = int(rows.top[0])
    spare[:top] = rows.spare[:top]
    spare[top : top + added] = np.arange(n + added - 1, n - 1, -1)
    rows.top[0] = top + added
    return rows._replace(spare=spare)


@dataclass(frozen=True, eq=False)
class CellSet:
    """Some cells of a box, a bit each.

    Attributes:
        blocks: (3,) blocks of the box along each axis.
        words: (blocks, 8) uint64, in the order of the blocks' cells.
    """

    blocks: Ints
    words: NDArray[np.uint64]

    @property
    def size(self) -> int:
        """How many there are."""
        return int(np.bitwise_count(self.words).sum(dtype=np.int64))

    def __ior__(self, other: CellSet) -> CellSet:
        np.bitwise_or(self.words, other.words, out=self.words)
        return self

    def indices(self) -> NDArray[np.int32]:
        """Return their flat indices in an array of the box, in ascending order."""
        block = np.flatnonzero(self.words.any(axis=1))
        bits = np.unpackbits(self.words[block].view(np.uint8), axis=1, bitorder="little")
        which, cell = np.nonzero(bits)
        index = np.stack(np.unravel_index(block[which], tuple(self.blocks)), axis=1) * EDGE
        for axis in range(3):
            at = cell >> axis
            index[:, axis] += (at & 1) | (at >> 2 & 2) | (at >> 4 & 4)
        flat = np.ravel_multi_index(tuple(index.T), tuple(EDGE * self.blocks))
        return np.sort(flat).astype(np.int32)


class VoxelBlocks:
    """The cells of a box, all unknown at first.

    Args:
        lattice: The box; its faces lie at keys that are multiples of 8.

    Attributes:
        lattice: The box.
        shape: (3,) blocks along each axis.
        key_min: (3,) key of the first cell.
        axes: For each axis (n,) the part of a cell's number that its index along the axis gives; their sum over 512 is
            the block, the rest the cell in it.
        rows: Codes of the cells.
        palette: Log-odds of the codes.

    Raises:
        OpenArmError: CONFIG_INVALID, when a face lies between two blocks.
    """

    def __init__(self, lattice: Lattice) -> None:
        if any(k % EDGE or n % EDGE for k, n in zip(lattice.key_min, lattice.shape, strict=True)):
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"box begins at key {lattice.key_min} and has {lattice.shape} cells; blocks need multiples of {EDGE}",
            )
        self.lattice = lattice
        self.shape: Ints = np.array(lattice.shape, np.int64) // EDGE
        self.key_min: Ints = np.array(lattice.key_min, np.int64)
        strides = (int(self.shape[1] * self.shape[2]), int(self.shape[2]), 1)
        self.axes = tuple(_axis(n, stride, k) for k, (n, stride) in enumerate(zip(lattice.shape, strides, strict=True)))
        self.clear()

    def clear(self) -> None:
        """Make all cells unknown, and give their memory back."""
        self.rows = empty_rows(int(self.shape.prod()), CELLS, np.uint8)
        self.palette = _palette(_BYTE)

    @property
    def nbytes(self) -> int:
        """Memory of the cells, bytes."""
        return sum(array.nbytes for array in (*self.rows, *self.palette))

    def cell_set(self) -> CellSet:
        """Return an empty set of cells of this box."""
        return CellSet(self.shape, np.zeros((self.rows.table.size, 8), np.uint64))

    def grow(self) -> None:
        """Make room for whatever was missing: rows, codes or both."""
        if self.rows.top[0] == 0:
            self.rows = more_rows(self.rows)
        if self.palette.used[0] == self.palette.states.size:
            self._more_codes()

    def repeat(self, work: Callable[[], bool]) -> None:
        """Call a kernel that may be called again until it says that there was room enough."""
        while not work():
            self.grow()

    def code_of(self, value: float) -> int:
        """Return the code of log-odds, NaN for unknown."""
        code = kernels.code_of(self.palette, np.float32(value))
        while code == kernels.FULL:
            self._more_codes()
            code = kernels.code_of(self.palette, np.float32(value))
        return int(code)

    def fill(self, box: tuple[slice, slice, slice], value: float) -> None:
        """Give all cells of a box of indices the same log-odds, NaN for unknown."""
        first: Ints = np.array([s.start for s in box], np.int64)
        last: Ints = np.array([s.stop for s in box], np.int64)
        if (first < last).all():
            code = self.code_of(value)
            self.repeat(lambda: bool(kernels.fill_box(self.rows, self.shape, first, last, code)))

    def paint(self, cells: NDArray[np.int32], log_odds: Floats) -> None:
        """Give cells the log-odds of the leaves that cover them.

        Args:
            cells: (n, 4) level, x, y, z key at that level.
            log_odds: (n,).
        """
        done = 0
        while done < cells.shape[0]:
            done = kernels.paint_blocks(self.rows, self.palette, self.shape, self.key_min, cells, log_odds, done)
            if done < cells.shape[0]:
                self.grow()

    def set_layers(self, first: int, values: Floats) -> None:
        """Set layers of blocks along x from `first` on: log-odds (8 layers, ny, nz), NaN where unknown."""
        self.repeat(lambda: bool(kernels.gather(self.rows, self.palette, self.shape, first, values)))

    def states(self, layers: slice = slice(None)) -> Bytes:
        """Return the states of layers of blocks along x, (8 layers, ny, nz)."""
        return self._dense(self.palette.states, layers)

    def log_odds(self, layers: slice = slice(None)) -> Floats:
        """Return the log-odds of layers of blocks along x, (8 layers, ny, nz), NaN where unknown."""
        return self._dense(self.palette.values, layers)

    def halved(self) -> Bytes:
        """Return the states of cells twice as large, (nx / 2, ny / 2, nz / 2): the largest state of their parts."""
        x, y, z = (int(n) * EDGE // 2 for n in self.shape)
        out = np.empty((x, y, z), np.uint8)
        kernels.halve(self.rows, self.shape, self.palette.states, out)
        return out

    def states_at(self, index: ArrayLike) -> Bytes:
        """Return the states (n,) of cells of the box, indices (n, 3)."""
        at = np.asarray(index, np.int64)
        number = sum((axis[at[:, k]] for k, axis in enumerate(self.axes)), np.zeros(at.shape[0], np.int64))
        rows = self.rows.table[number // CELLS].astype(np.int64)
        codes = -1 - rows
        mixed = rows >= 0
        codes[mixed] = self.rows.pool[rows[mixed], number[mixed] % CELLS]
        return np.asarray(self.palette.states[codes], np.uint8)

    def _dense(self, meaning: NDArray[Any], layers: slice) -> NDArray[Any]:
        first, last, _ = layers.indices(int(self.shape[0]))
        _, ny, nz = self.lattice.shape
        out = np.empty(((last - first) * EDGE, ny, nz), meaning.dtype)
        kernels.expand(self.rows, self.shape, meaning, first, out)
        return out

    def _more_codes(self) -> None:
        """Drop the log-odds that no cell has; where these are few, make room for more."""
        used = np.zeros(self.palette.states.size, np.uint8)
        kernels.mark_used(self.rows, used)
        used[UNKNOWN] = 1
        kept = np.flatnonzero(used)
        capacity = used.size
        if 8 * kept.size > 7 * capacity:  # else this would soon be done again
            capacity = _WORD if capacity == _BYTE else 2 * capacity
        old, self.palette = self.palette, _palette(capacity)
        codes = np.zeros(used.size, np.int32)
        codes[kept] = kernels.codes_of(self.palette, old.values[kept])
        dtype = np.uint8 if capacity <= _BYTE else np.uint16 if capacity <= _WORD else np.uint32
        pool = self.rows.pool if self.rows.pool.dtype == dtype else np.zeros(self.rows.pool.shape, dtype)
        kernels.recode(self.rows, codes, pool)
        self.rows = self.rows._replace(pool=pool)


def _axis(n: int, stride: int, place: int) -> Ints:
    index = np.arange(n)
    inner = (index & 1) | (index & 2) << 2 | (index & 4) << 4
    return np.asarray(index // EDGE * stride * CELLS + (inner << place), np.int64)


def _palette(capacity: int) -> Palette:
    values = np.full(capacity + 1, np.nan, np.float32)
    states = np.full(capacity, UNKNOWN, np.uint8)
    steps, slots = np.full((2, capacity), -1, np.int32), np.full(2 * capacity, -1, np.int32)
    return Palette(values, values.view(np.int32), states, steps, slots, np.ones(1, np.int64))
