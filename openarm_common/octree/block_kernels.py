# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of `openarm_common.octree.blocks`: blocks of 8 × 8 × 8 cells, of which only the mixed ones take memory.

A block is a node of level 3 of the octree. Its cells lie in Morton order, ``x`` in the lowest bit, so that each node
within it is a contiguous range, and the number of a cell in the box is a sum of one term for each axis. A cell is a
code, the index of its log-odds in a palette; code 0 is unknown.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from openarm_common.kernels import inlined_kernel, kernel
from openarm_common.types import Bytes, Floats, Ints

#: Levels of a block, cells along its edge, cells.
LEVEL, EDGE, CELLS = 3, 8, 512
UNKNOWN, FREE, OCCUPIED = 0, 1, 2
#: Returned in place of a code when the palette is full.
FULL = -1

Codes = NDArray[np.int32]
Words = NDArray[np.uint64]


class Rows(NamedTuple):
    """A row of memory for each block that needs one, or for each part of a block.

    Attributes:
        table: (owners,) row of each; below zero it has none: -1 - code of all of its cells.
        pool: (rows, cells): 512 cells of a block.
        spare: (rows,) stack of the rows that are free.
        top: (1,) how many those are.
    """

    table: NDArray[np.int32]
    pool: NDArray[Any]
    spare: NDArray[np.int32]
    top: Ints


class Palette(NamedTuple):
    """The log-odds that cells have.

    Attributes:
        values: (capacity + 1,) NaN for code 0; the last one is scratch.
        bits: The same memory as int32.
        states: (capacity,) UNKNOWN, FREE or OCCUPIED.
        steps: (2, capacity) code after a miss and after a hit; -1 where it was not asked for yet.
        slots: Hash table of codes, a power of two long; -1 where there is none.
        used: (1,) codes in use.
    """

    values: Floats
    bits: NDArray[np.int32]
    states: Bytes
    steps: NDArray[np.int32]
    slots: NDArray[np.int32]
    used: Ints


@kernel
def code_of(palette: Palette, value: np.float32) -> int:
    """Return the code of log-odds, a new one where there is none yet; FULL when there is no room for it."""
    if np.isnan(value):
        return 0
    capacity = palette.states.size
    palette.values[capacity] = value
    bits = palette.bits[capacity]  # compared as bits: 0 and -0 are different bytes in a file
    mask = palette.slots.size - 1
    slot = np.int64((np.uint64(np.uint32(bits)) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)) & mask
    while palette.slots[slot] >= 0:
        code = int(palette.slots[slot])
        if palette.bits[code] == bits:
            return code
        slot = (slot + 1) & mask
    code = int(palette.used[0])
    if code >= capacity:
        return FULL
    palette.values[code] = value
    palette.states[code] = OCCUPIED if value >= np.float32(0.0) else FREE
    palette.slots[slot] = code
    palette.used[0] = code + 1
    return code


@kernel
def codes_of(palette: Palette, values: Floats) -> Codes:
    """Return the codes of log-odds (n,), for all of which there is room."""
    out = np.empty(values.size, np.int32)
    for i in range(values.size):
        out[i] = code_of(palette, values[i])
    return out


@kernel
def take_row(rows: Rows, block: int) -> int:
    """Give a block a row, with whatever is in it; -1 when none is spare."""
    if rows.top[0] == 0:
        return -1
    rows.top[0] -= 1
    row = int(rows.spare[rows.top[0]])
    rows.table[block] = row
    return row


@kernel
def drop_row(rows: Rows, block: int, code: int) -> None:
    """Make all cells of a block one code, without a row."""
    row = rows.table[block]
    if row >= 0:
        rows.spare[rows.top[0]] = row
        rows.top[0] += 1
    rows.table[block] = -1 - code


@kernel
def load_block(rows: Rows, block: int, cells: Codes) -> None:
    """Copy the codes of a block to `cells` (512,)."""
    row = rows.table[block]
    if row < 0:
        cells[:] = -1 - row
    else:
        source = rows.pool[row]
        for i in range(CELLS):
            cells[i] = source[i]


@kernel
def store_block(rows: Rows, block: int, cells: Codes) -> bool:
    """Write back the codes of a block; false, and nothing is changed, when it needs a row and none is spare."""
    first, differ = cells[0], 0
    for i in range(CELLS):
        differ |= cells[i] ^ first
    if differ == 0:
        drop_row(rows, block, first)
        return True
    row = rows.table[block]
    if row < 0:
        row = take_row(rows, block)
        if row < 0:
            return False
    target = rows.pool[row]
    for i in range(CELLS):
        target[i] = cells[i]
    return True


@kernel
def fill_box(rows: Rows, shape: Ints, first: Ints, last: Ints, code: int) -> bool:
    """Give all cells of a box one code.

    Args:
        rows: Changed.
        shape: (3,) blocks along each axis.
        first: (3,) index of the lowest cell.
        last: (3,) index behind the highest cell.
        code: Code of the palette.

    Returns:
        Whether there were rows enough; if not, a part is done, and a call with more rows does all.
    """
    cells = np.empty(CELLS, np.int32)
    for bx in range(first[0] // EDGE, (last[0] + EDGE - 1) // EDGE):
        for by in range(first[1] // EDGE, (last[1] + EDGE - 1) // EDGE):
            for bz in range(first[2] // EDGE, (last[2] + EDGE - 1) // EDGE):
                block = (bx * shape[1] + by) * shape[2] + bz
                load_block(rows, block, cells)
                for i in range(CELLS):
                    x, y, z = EDGE * bx + compact(i), EDGE * by + compact(i >> 1), EDGE * bz + compact(i >> 2)
                    if first[0] <= x < last[0] and first[1] <= y < last[1] and first[2] <= z < last[2]:
                        cells[i] = code
                if not store_block(rows, block, cells):
                    return False
    return True


@inlined_kernel
def compact(i: int) -> int:
    """Return bits 0, 3 and 6: of the number of a cell in its block, the coordinate whose lowest bit is bit 0."""
    return (i & 1) | (i >> 2 & 2) | (i >> 4 & 4)


@inlined_kernel
def spread(v: int) -> int:
    """Return three bits at places 0, 3 and 6: the inverse of `compact`."""
    return (v & 1) | (v & 2) << 2 | (v & 4) << 4


@kernel
def paint_blocks(
    rows: Rows, palette: Palette, shape: Ints, key_min: Ints, leaves: NDArray[np.int32], values: Floats, begin: int
) -> int:
    """Give cells the log-odds of the leaves that cover them.

    Args:
        rows: Changed.
        palette: Changed.
        shape: (3,) blocks along each axis.
        key_min: (3,) key of the first cell of the box; multiples of 8.
        leaves: (n, 4) level, x, y, z at that level.
        values: (n,) log-odds.
        begin: Leaf to begin with.

    Returns:
        The leaf for which a row or the room for a code was missing; n when all are done.
    """
    for i in range(begin, leaves.shape[0]):
        level = leaves[i, 0]
        code = code_of(palette, values[i])
        if code == FULL:
            return i
        x, y, z = np.int64(leaves[i, 1]), np.int64(leaves[i, 2]), np.int64(leaves[i, 3])
        if level >= LEVEL:
            up = level - LEVEL
            a, b, c = (x << up) - key_min[0] // EDGE, (y << up) - key_min[1] // EDGE, (z << up) - key_min[2] // EDGE
            for bx in range(max(a, 0), min(a + (1 << up), shape[0])):
                for by in range(max(b, 0), min(b + (1 << up), shape[1])):
                    for bz in range(max(c, 0), min(c + (1 << up), shape[2])):
                        drop_row(rows, (bx * shape[1] + by) * shape[2] + bz, code)
            continue
        x, y, z = (x << level) - key_min[0], (y << level) - key_min[1], (z << level) - key_min[2]
        if not (0 <= x < EDGE * shape[0] and 0 <= y < EDGE * shape[1] and 0 <= z < EDGE * shape[2]):
            continue
        block = ((x // EDGE) * shape[1] + y // EDGE) * shape[2] + z // EDGE
        row = rows.table[block]
        if row < 0:
            old = -1 - row
            row = take_row(rows, block)
            if row < 0:
                return i
            rows.pool[row, :] = old
        at = spread(x & 7) | spread(y & 7) << 1 | spread(z & 7) << 2
        for k in range(at, at + (1 << 3 * level)):
            rows.pool[row, k] = code
    return leaves.shape[0]


@kernel
def recode(rows: Rows, codes: Codes, out: NDArray[Any]) -> None:
    """Replace each code by another.

    Args:
        rows: Their table is changed.
        codes: (capacity,) new code of each.
        out: (rows, 512), filled; may be the pool.
    """
    for block in range(rows.table.size):
        row = rows.table[block]
        if row < 0:
            rows.table[block] = -1 - codes[-1 - row]
        else:
            for i in range(CELLS):
                out[row, i] = codes[rows.pool[row, i]]


@kernel
def mark_used(rows: Rows, used: Bytes) -> None:
    """Set `used` (capacity,) to 1 for each code that a cell has."""
    for block in range(rows.table.size):
        row = rows.table[block]
        if row < 0:
            used[-1 - row] = 1
        else:
            for i in range(CELLS):
                used[rows.pool[row, i]] = 1


@kernel
def expand(rows: Rows, shape: Ints, meaning: NDArray[Any], first: int, out: NDArray[Any]) -> None:
    """Fill a dense array with what codes mean.

    Args:
        rows: The cells.
        shape: (3,) blocks along each axis.
        meaning: (capacity,) of each code: its log-odds or state.
        first: Layer of blocks, along x, with which `out` begins.
        out: (8 layers, ny, nz), filled.
    """
    for bx in range(out.shape[0] // EDGE):
        for by in range(shape[1]):
            for bz in range(shape[2]):
                row = rows.table[((first + bx) * shape[1] + by) * shape[2] + bz]
                for x in range(EDGE):
                    for y in range(EDGE):
                        line = out[EDGE * bx + x, EDGE * by + y]
                        at = spread(x) | spread(y) << 1
                        for z in range(EDGE):
                            code = -1 - row
                            if row >= 0:
                                code = np.int64(rows.pool[row, at | spread(z) << 2])
                            line[EDGE * bz + z] = meaning[code]


@kernel
def gather(rows: Rows, palette: Palette, shape: Ints, first: int, values: Floats) -> bool:
    """Set layers of blocks, as `expand` gives them.

    Args:
        rows: Changed.
        palette: Changed.
        shape: (3,) blocks along each axis.
        first: Layer of blocks, along x, with which `values` begins.
        values: (8 layers, ny, nz) log-odds, NaN where unknown.

    Returns:
        Whether there were rows and room for codes enough; if not, a part is done, and a call with more does all.
    """
    cells = np.empty(CELLS, np.int32)
    for bx in range(values.shape[0] // EDGE):
        for by in range(shape[1]):
            for bz in range(shape[2]):
                for i in range(CELLS):
                    x, y, z = EDGE * bx + compact(i), EDGE * by + compact(i >> 1), EDGE * bz + compact(i >> 2)
                    cells[i] = code_of(palette, values[x, y, z])
                    if cells[i] == FULL:
                        return False
                if not store_block(rows, ((first + bx) * shape[1] + by) * shape[2] + bz, cells):
                    return False
    return True


@kernel
def halve(rows: Rows, shape: Ints, states: Bytes, out: Bytes) -> None:
    """Fill `out` (4 nx, 4 ny, 4 nz) with the largest state of each 2 × 2 × 2 cells; `states` is (capacity,)."""
    for block in range(rows.table.size):
        x, y, z = block // (shape[1] * shape[2]) * 4, block // shape[2] % shape[1] * 4, block % shape[2] * 4
        row = rows.table[block]
        for i in range(CELLS // 8):
            most = np.uint8(0)
            if row < 0:
                most = states[-1 - row]
            else:
                for k in range(8 * i, 8 * i + 8):
                    most = max(most, states[rows.pool[row, k]])
            out[x + compact(i), y + compact(i >> 1), z + compact(i >> 2)] = most
