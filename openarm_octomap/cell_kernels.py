# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the map: what marks, time and the robot do to cells.

A kernel that lacks room, a row for a block or a code for new log-odds, says so, and is called again when there is: what
it does a second time changes nothing. The GIL is released.
"""

from __future__ import annotations

import numpy as np

from openarm_common.kernels import inlined_kernel, kernel
from openarm_common.octree.block_kernels import (
    CELLS,
    EDGE,
    FREE,
    FULL,
    OCCUPIED,
    UNKNOWN,
    Palette,
    Rows,
    Words,
    code_of,
    compact,
    drop_row,
    load_block,
    store_block,
    take_row,
)  # fmt: skip
from openarm_common.octree.lattice import KEY_ZERO
from openarm_common.robot.filter_kernels import inside
from openarm_common.types import Array, Floats, Ints

MISS, HIT = 0, 1


@kernel
def _step(palette: Palette, kind: int, code: int, deltas: Floats, limits: Floats) -> int:
    """Return the code after a miss or hit, and remember it; FULL when there is no room for it."""
    value = palette.values[code]
    if np.isnan(value):
        value = np.float32(0.0)
    value = min(value + deltas[HIT], limits[HIT]) if kind == HIT else max(value + deltas[MISS], limits[MISS])
    new = code_of(palette, value)
    if new != FULL:
        palette.steps[kind, code] = new
    return new


@kernel
def apply_marks(
    through: Words, hits: Words, begin: int, rows: Rows, palette: Palette, seen: Rows, now: int,
    deltas: Floats, limits: Floats, changed: Words,
) -> int:  # fmt: skip
    """Turn marks into log-odds, and clear the marks.

    Args:
        through: (blocks, 8) cells that rays went through.
        hits: (blocks, 8) cells that a ray ended in; they count as hit, whatever went through them.
        begin: Block to begin with.
        rows: The cells.
        palette: Their log-odds.
        seen: When occupied cells were observed, 64 cells a row; where there is no row: never.
        now: Written to `seen`.
        deltas: (2,) float32 added for a miss and for a hit.
        limits: (2,) float32, lower and upper.
        changed: (blocks, 8), cells whose state changed are added.

    Returns:
        The block for which a row or a code was missing; how many blocks there are when all are done.
    """
    cells = np.empty(CELLS, np.int32)
    one = np.uint64(1)
    for block in range(begin, rows.table.size):
        either, any_hit = np.uint64(0), np.uint64(0)
        for w in range(8):
            any_hit |= hits[block, w]
            either |= through[block, w]
        if either | any_hit == 0:
            continue
        row = rows.table[block]
        if row < 0 and any_hit == 0 and palette.states[-1 - row] == FREE and palette.steps[MISS, -1 - row] == -1 - row:
            through[block, :] = np.uint64(0)  # as free as can be
            continue
        load_block(rows, block, cells)
        occupied = 0  # a bit for each word
        for w in range(8):
            hit, mark = hits[block, w], hits[block, w] | through[block, w]
            if mark == 0:
                continue
            turned = np.uint64(0)
            for k in range(64):
                bit = one << np.uint64(k)
                if not mark & bit:
                    continue
                kind = HIT if hit & bit else MISS
                old = cells[64 * w + k]
                new = palette.steps[kind, old]
                if new < 0:
                    new = _step(palette, kind, old, deltas, limits)
                    if new == FULL:
                        return block
                cells[64 * w + k] = new
                state = palette.states[new]
                occupied |= (state == OCCUPIED) << w
                if state != palette.states[old]:
                    turned |= bit
            changed[block, w] |= turned
        # rows first: once the cells are stored, this block must not come again
        for w in range(8):
            if occupied >> w & 1 and seen.table[8 * block + w] < 0:
                if seen.top[0] == 0:
                    return block
                seen.pool[take_row(seen, 8 * block + w), :] = 0
        if not store_block(rows, block, cells):
            return block
        for w in range(8):
            if occupied >> w & 1:
                mark, times = hits[block, w] | through[block, w], seen.pool[seen.table[8 * block + w]]
                for k in range(64):
                    if mark >> np.uint64(k) & one:
                        times[k] = now
        through[block, :] = np.uint64(0)
        hits[block, :] = np.uint64(0)
    return rows.table.size


@kernel
def forget_shapes(
    kinds: Ints, halves: Array, T_shape_base: Array,
    resolution: float, key_min: Ints, shape: Ints, rows: Rows, palette: Palette, changed: Words,
) -> bool:  # fmt: skip
    """Make the occupied cells unknown whose centre lies in a shape.

    Args:
        kinds: (n,).
        halves: (n, 3).
        T_shape_base: (n, 3, 4).
        resolution: Edge of a cell, m.
        key_min: (3,) key of the first cell.
        shape: (3,) blocks along each axis.
        rows: The cells.
        palette: Their log-odds.
        changed: (blocks, 8), the cells are added.

    Returns:
        Whether there were rows enough.
    """
    cells = np.empty(CELLS, np.int32)
    lo, hi = np.empty(3, np.int64), np.empty(3, np.int64)
    for i in range(kinds.size):
        T, half = T_shape_base[i], halves[i]
        for k in range(3):
            centre = -(T[0, k] * T[0, 3] + T[1, k] * T[1, 3] + T[2, k] * T[2, 3])
            reach = abs(T[0, k]) * half[0] + abs(T[1, k]) * half[1] + abs(T[2, k]) * half[2]
            lo[k] = max(int(np.floor((centre - reach) / resolution)) + KEY_ZERO - key_min[k], 0)
            hi[k] = min(int(np.floor((centre + reach) / resolution)) + KEY_ZERO - key_min[k] + 1, EDGE * shape[k])
        for bx in range(lo[0] // EDGE, (hi[0] + EDGE - 1) // EDGE):
            for by in range(lo[1] // EDGE, (hi[1] + EDGE - 1) // EDGE):
                for bz in range(lo[2] // EDGE, (hi[2] + EDGE - 1) // EDGE):
                    block = (bx * shape[1] + by) * shape[2] + bz
                    row = rows.table[block]
                    if row < 0 and palette.states[-1 - row] != OCCUPIED:
                        continue
                    load_block(rows, block, cells)
                    found = False
                    for j in range(CELLS):
                        a, b, c = EDGE * bx + compact(j), EDGE * by + compact(j >> 1), EDGE * bz + compact(j >> 2)
                        if palette.states[cells[j]] != OCCUPIED or not (
                            lo[0] <= a < hi[0] and lo[1] <= b < hi[1] and lo[2] <= c < hi[2]
                        ):
                            continue
                        x = (a + key_min[0] - KEY_ZERO + 0.5) * resolution
                        y = (b + key_min[1] - KEY_ZERO + 0.5) * resolution
                        z = (c + key_min[2] - KEY_ZERO + 0.5) * resolution
                        px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
                        py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
                        pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
                        if inside(kinds[i], px, py, pz, half[0], half[1], half[2]):
                            cells[j], found = UNKNOWN, True
                            changed[block, j // 64] |= np.uint64(1) << np.uint64(j % 64)
                    if found and not store_block(rows, block, cells):
                        return False
    return True


@inlined_kernel
def _seen_at(seen: Rows, block: int, cell: int) -> int:
    """Return when an occupied cell was observed; 0 where it never was."""
    row = seen.table[8 * block + cell // 64]
    return int(seen.pool[row, cell % 64]) if row >= 0 else 0


@kernel
def forget_unseen(rows: Rows, palette: Palette, seen: Rows, limit: int, changed: Words) -> bool:
    """Make the occupied cells unknown that were not observed since a moment.

    Args:
        rows: The cells.
        palette: Their log-odds.
        seen: When occupied cells were observed.
        limit: The moment.
        changed: (blocks, 8), the cells are added.

    Returns:
        Whether there were rows enough.
    """
    cells = np.empty(CELLS, np.int32)
    for block in range(rows.table.size):
        row = rows.table[block]
        if row < 0 and palette.states[-1 - row] != OCCUPIED:
            continue
        load_block(rows, block, cells)
        found = False
        for j in range(CELLS):
            if palette.states[cells[j]] == OCCUPIED and _seen_at(seen, block, j) < limit:
                cells[j], found = UNKNOWN, True
                changed[block, j // 64] |= np.uint64(1) << np.uint64(j % 64)
        if found and not store_block(rows, block, cells):
            return False
    return True


@kernel
def drop_seen(rows: Rows, palette: Palette, seen: Rows) -> None:
    """Take the rows of `seen` from where nothing is occupied any more."""
    for part in range(seen.table.size):
        if seen.table[part] < 0:
            continue
        row, occupied = rows.table[part // 8], False
        for j in range(64):
            code = np.int64(rows.pool[row, part % 8 * 64 + j]) if row >= 0 else np.int64(-1 - row)
            occupied |= palette.states[code] == OCCUPIED
        if not occupied:
            drop_row(seen, part, 0)


@kernel
def tally(rows: Rows, palette: Palette, seen: Rows, counts: Ints) -> int:
    """Count cells by state into `counts` (3,); returns when the occupied cell was observed that has waited longest."""
    oldest = np.int64(1) << 62
    for block in range(rows.table.size):
        row = rows.table[block]
        if row < 0:
            state = palette.states[-1 - row]
            counts[state] += CELLS
            if state != OCCUPIED:
                continue
        for j in range(CELLS):
            if row >= 0:
                state = palette.states[rows.pool[row, j]]
                counts[state] += 1
                if state != OCCUPIED:
                    continue
            oldest = min(oldest, _seen_at(seen, block, j))
    return int(oldest)
