# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the octree codec: a pyramid over blocks of cells, the preorder walk over both, and the readers.

States: 0 unknown, 1 free, 2 occupied, 3 inner node (its children differ). Level 3 are the blocks of
`openarm_common.octree.block_kernels`, below which nodes are ranges of a block's cells; level 16 is the root. The array
of level l begins at key `origin[l]` of that level. All levels begin and end at even keys, so that every node has its
eight children in the array below. Child i of a node lies at ``x = i & 1, y = i >> 1 & 1, z = i >> 2``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from openarm_common.kernels import inlined_kernel, kernel
from openarm_common.octree.block_kernels import CELLS, LEVEL, Palette, Rows
from openarm_common.types import Bytes, Floats, Ints

INNER = 3
#: Why a payload is refused (negative returns of the readers).
TRUNCATED, TOO_DEEP = -1, -2

Keys = NDArray[np.int32]


@kernel
def merge_states(below: Bytes, above: Bytes, shift: Ints) -> None:
    """Fill one level from the one below.

    Args:
        below: (2 nx, 2 ny, 2 nz) states.
        above: States of the next level, zero outside of what is filled.
        shift: Index (3,) in `above` of the parent of below[0, 0, 0].
    """
    nx, ny, nz = below.shape[0] // 2, below.shape[1] // 2, below.shape[2] // 2
    for i in range(nx):
        for j in range(ny):
            a = below[2 * i, 2 * j]
            b = below[2 * i, 2 * j + 1]
            c = below[2 * i + 1, 2 * j]
            d = below[2 * i + 1, 2 * j + 1]
            row = above[i + shift[0], j + shift[1]]
            for k in range(nz):
                s = a[2 * k]
                low = s & a[2 * k + 1] & b[2 * k] & b[2 * k + 1] & c[2 * k] & c[2 * k + 1] & d[2 * k] & d[2 * k + 1]
                high = s | a[2 * k + 1] | b[2 * k] | b[2 * k + 1] | c[2 * k] | c[2 * k + 1] | d[2 * k] | d[2 * k + 1]
                # equal children merge into one leaf, except inner nodes, which stay
                row[k + shift[2]] = high if low == high else INNER


@kernel
def block_states(rows: Rows, states: Bytes, shape: Ints, above: Bytes, shift: Ints) -> int:
    """Fill level 3 with the states of blocks.

    Args:
        rows: The cells.
        states: (capacity,) of each code.
        shape: (3,) blocks along each axis.
        above: Level 3, zero outside of what is filled.
        shift: Index (3,) in `above` of the first block.

    Returns:
        How many inner nodes there can be at most below level 3 and at it.
    """
    count = 0
    for block in range(rows.table.size):
        row = rows.table[block]
        if row < 0:
            state = np.int64(states[-1 - row])
        else:
            codes = rows.pool[row]
            state = np.int64(states[codes[0]])
            for i in range(1, CELLS):
                if states[codes[i]] != state:
                    state = INNER
                    count += 73
                    break
        x, y, z = block // (shape[1] * shape[2]), block // shape[2] % shape[1], block % shape[2]
        above[x + shift[0], y + shift[1], z + shift[2]] = state
    return count


@kernel
def _fold_states(rows: Rows, states: Bytes, row: int, tree: Bytes) -> None:
    """Fill the nodes of a mixed block.

    Args:
        rows: The cells.
        states: (capacity,) of each code.
        row: Row of the block.
        tree: (584,) filled: states of its 512 cells, then of the 64 nodes above them, then of the 8 above these.
    """
    codes = rows.pool[row]
    for i in range(CELLS):
        tree[i] = states[codes[i]]
    for i in range(72):
        low, high = np.uint8(255), np.uint8(0)
        for k in range(8 * i, 8 * i + 8):
            low &= tree[k]
            high |= tree[k]
        tree[CELLS + i] = high if low == high else INNER


@inlined_kernel
def _put_bits(tree: Bytes, first: int, out: Bytes, n: int) -> int:
    """Write two bits for each of eight children; returns how many there are."""
    bits, there = 0, 0
    for c in range(7, -1, -1):
        s = np.int64(tree[first + c])
        bits = bits << 2 | s
        there += s != 0
    out[n] = bits & 255
    out[n + 1] = bits >> 8
    return there


@kernel
def write_states(
    rows: Rows, states: Bytes, blocks: Ints, flat: Bytes, offset: Ints, shape: Ints, origin: Ints, out: Bytes
) -> tuple[int, int]:
    """Write the tree as two bytes an inner node, preorder, two bits a child.

    Args:
        rows: The cells.
        states: (capacity,) of each code.
        blocks: (2, 3) key of the first block at level 3, and blocks along each axis.
        flat: All levels from 3 one after the other.
        offset: (17,) where each level begins in `flat`.
        shape: (17, 3) of each level.
        origin: (17, 3) key of the first node of each level.
        out: Filled; two bytes for each inner node.

    Returns:
        Bytes written, and nodes of the tree.
    """
    stack = np.empty((8 * 17, 4), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 16, 0, 0, 0
    tree = np.empty(584, np.uint8)
    top, n, nodes = 1, 0, 1
    while top > 0:
        top -= 1
        x, y, z = stack[top, 1], stack[top, 2], stack[top, 3]
        if stack[top, 0] == LEVEL:
            block = ((x - blocks[0, 0]) * blocks[1, 1] + (y - blocks[0, 1])) * blocks[1, 2] + (z - blocks[0, 2])
            _fold_states(rows, states, int(rows.table[block]), tree)
            nodes += _put_bits(tree, 576, out, n)
            n += 2
            for i in range(8):
                if tree[576 + i] == INNER:
                    nodes += _put_bits(tree, CELLS + 8 * i, out, n)
                    n += 2
                    for k in range(8 * i, 8 * i + 8):
                        if tree[CELLS + k] == INNER:
                            nodes += _put_bits(tree, 8 * k, out, n)
                            n += 2
            continue
        level = stack[top, 0] - 1
        x, y, z = 2 * x, 2 * y, 2 * z
        ny, nz = shape[level, 1], shape[level, 2]
        first = offset[level] + ((x - origin[level, 0]) * ny + (y - origin[level, 1])) * nz + (z - origin[level, 2])
        bits = 0
        # from the last child to the first, so that the first is taken from the stack first
        for c in range(7, -1, -1):
            dx, dy, dz = c & 1, (c >> 1) & 1, c >> 2
            s = int(flat[first + (dx * ny + dy) * nz + dz])
            bits = bits << 2 | s
            if s != 0:
                nodes += 1
            if s == INNER:
                stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = level, x + dx, y + dy, z + dz
                top += 1
        out[n] = bits & 255
        out[n + 1] = bits >> 8
        n += 2
    return n, nodes


@kernel
def read_states(
    data: Bytes, low: np.float32, high: np.float32, stack: Ints, at: Ints, leaves: Keys, values: Floats
) -> int:
    """Read the next leaves of a tree of two bytes per inner node.

    Args:
        data: Bytes that `write_states` writes.
        low: Log-odds of free leaves.
        high: Log-odds of occupied leaves.
        stack: (136, 4) level, x, y, z of nodes that are not read yet; at first the root alone, at level 16.
        at: (3,) nodes on the stack, bytes used, nodes of the tree so far; at first 1, 0, 1.
        leaves: (n, 4), filled: level, x, y, z at that level; n is at least 8.
        values: (n,), filled with log-odds.

    Returns:
        Number of leaves, or TRUNCATED or TOO_DEEP; none is left when the stack is empty.
    """
    top, used, m = at[0], at[1], 0
    while top > 0 and m + 8 <= values.size:
        top -= 1
        if used + 2 > data.shape[0]:
            return TRUNCATED
        level = stack[top, 0] - 1
        x, y, z = 2 * stack[top, 1], 2 * stack[top, 2], 2 * stack[top, 3]
        bits = int(data[used]) | int(data[used + 1]) << 8
        used += 2
        for c in range(7, -1, -1):
            s = bits >> (2 * c) & 3
            if s == 0:
                continue
            at[2] += 1
            cx, cy, cz = x + (c & 1), y + ((c >> 1) & 1), z + (c >> 2)
            if s == INNER:
                if level == 0:
                    at[1] = used
                    return TOO_DEEP
                stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = level, cx, cy, cz
                top += 1
            else:
                leaves[m, 0], leaves[m, 1], leaves[m, 2], leaves[m, 3] = level, cx, cy, cz
                values[m] = high if s == 2 else low
                m += 1
    at[0], at[1] = top, used
    return m


@inlined_kernel
def _merge_eight(states: Bytes, values: Floats, first: int) -> tuple[int, np.float32]:
    """Merge eight children that lie next to each other, as `merge_values` does."""
    count, leaves, best, same = 0, 0, np.float32(-np.inf), True
    at = first
    for k in range(first, first + 8):
        if states[k] != 0:
            at = k if count == 0 else at
            count += 1
            leaves += states[k] == 1
            same = same and values[k] == values[at]
            best = max(best, values[k])
    return (0 if count == 0 else 1 if leaves == 8 and same else INNER), best


@kernel
def _fold_values(rows: Rows, palette: Palette, row: int, tree: Bytes, values: Floats) -> tuple[int, np.float32]:
    """Do as `_fold_states` for log-odds: states (584,) as `merge_values` has them, and values (584,)."""
    codes = rows.pool[row]
    for i in range(CELLS):
        code = codes[i]
        tree[i] = 0 if code == 0 else 1
        values[i] = palette.values[code]
    for i in range(72):
        tree[CELLS + i], values[CELLS + i] = _merge_eight(tree, values, 8 * i)
    return _merge_eight(tree, values, 576)


@kernel
def block_values(rows: Rows, palette: Palette, shape: Ints, above: Bytes, above_values: Floats, shift: Ints) -> int:
    """Fill level 3 with the log-odds of blocks.

    Args:
        rows: The cells.
        palette: Their log-odds.
        shape: (3,) blocks along each axis.
        above: States of level 3, zero outside of what is filled.
        above_values: Log-odds of `above`.
        shift: Index (3,) in `above` of the first block.

    Returns:
        Nodes below level 3.
    """
    tree, values, count = np.empty(584, np.uint8), np.empty(584, np.float32), 0
    for block in range(rows.table.size):
        row = rows.table[block]
        if row < 0:
            state, value = (0 if row == -1 else 1), palette.values[-1 - row]
        else:
            state, value = _fold_values(rows, palette, row, tree, values)
            if state == INNER:
                for i in range(576, 584):
                    count += tree[i] != 0
                for i in range(72):
                    if tree[CELLS + i] == INNER:
                        for k in range(8 * i, 8 * i + 8):
                            count += tree[k] != 0
        x, y, z = block // (shape[1] * shape[2]), block // shape[2] % shape[1], block % shape[2]
        above[x + shift[0], y + shift[1], z + shift[2]] = state
        above_values[x + shift[0], y + shift[1], z + shift[2]] = value
    return count


@kernel
def merge_values(below: Bytes, values: Floats, above: Bytes, above_values: Floats, shift: Ints) -> None:
    """Merge as `merge_states`, for leaves (state 1; 0 is unknown) with a value; an inner node has the largest one.

    Args:
        below: (2 nx, 2 ny, 2 nz) states.
        values: Log-odds of `below`.
        above: States of the next level, zero outside of what is filled.
        above_values: Log-odds of `above`.
        shift: Index (3,) in `above` of the parent of below[0, 0, 0].
    """
    nx, ny, nz = below.shape[0] // 2, below.shape[1] // 2, below.shape[2] // 2
    eight, logs = np.empty(8, np.uint8), np.empty(8, np.float32)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                for c in range(8):
                    x, y, z = 2 * i + (c & 1), 2 * j + ((c >> 1) & 1), 2 * k + (c >> 2)
                    eight[c], logs[c] = below[x, y, z], values[x, y, z]
                x, y, z = i + shift[0], j + shift[1], k + shift[2]
                above[x, y, z], above_values[x, y, z] = _merge_eight(eight, logs, 0)


@inlined_kernel
def _put_value(bits: int, mask: int, out: Bytes, n: int) -> None:
    for b in range(4):
        out[n + b] = bits >> 8 * b & 255
    out[n + 4] = mask


@kernel
def _put_node(tree: Bytes, bits: Keys, node: int, below: int, out: Bytes, n: int) -> int:
    """Write a node of a block and how many bytes there are then; its children begin at `below`."""
    mask = 0
    if tree[node] == INNER:
        for c in range(8):
            mask |= (tree[below + c] != 0) << c
    _put_value(int(bits[node]), mask, out, n)
    return n + 5


@kernel
def write_values(
    rows: Rows, palette: Palette, blocks: Ints, flat: Bytes, bits: Keys, offset: Ints, shape: Ints, origin: Ints,
    out: Bytes,
) -> tuple[int, int]:  # fmt: skip
    """Write the tree as five bytes a node, preorder: log-odds (float32), then a bit for each child that there is.

    Args:
        rows: The cells.
        palette: Their log-odds.
        blocks: (2, 3) key of the first block at level 3, and blocks along each axis.
        flat: States of all levels from 3: 0 nothing, 1 leaf, 3 inner.
        bits: (nodes,) the float32 values of all levels, as int32.
        offset: (17,) where each level begins.
        shape: (17, 3) of each level.
        origin: (17, 3) key of the first node of each level.
        out: Filled.

    Returns:
        Bytes written, and nodes of the tree.
    """
    stack = np.empty((8 * 17, 4), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 16, 0, 0, 0
    tree, values = np.empty(584, np.uint8), np.empty(584, np.float32)
    within = values.view(np.int32)
    top, n = 1, 0
    while top > 0:
        top -= 1
        up = stack[top, 0]
        x, y, z = stack[top, 1], stack[top, 2], stack[top, 3]
        line = (x - origin[up, 0]) * shape[up, 1] + (y - origin[up, 1])
        here = offset[up] + line * shape[up, 2] + (z - origin[up, 2])
        mask = 0
        if flat[here] == INNER and up == LEVEL:
            block = ((x - blocks[0, 0]) * blocks[1, 1] + (y - blocks[0, 1])) * blocks[1, 2] + (z - blocks[0, 2])
            _fold_values(rows, palette, int(rows.table[block]), tree, values)
            for c in range(8):
                mask |= (tree[576 + c] != 0) << c
            _put_value(int(bits[here]), mask, out, n)
            n += 5
            for i in range(8):
                if tree[576 + i] == 0:
                    continue
                n = _put_node(tree, within, 576 + i, CELLS + 8 * i, out, n)
                if tree[576 + i] != INNER:
                    continue
                for k in range(8 * i, 8 * i + 8):
                    if tree[CELLS + k] == 0:
                        continue
                    n = _put_node(tree, within, CELLS + k, 8 * k, out, n)
                    if tree[CELLS + k] != INNER:
                        continue
                    for j in range(8 * k, 8 * k + 8):
                        if tree[j] != 0:
                            _put_value(int(within[j]), 0, out, n)
                            n += 5
            continue
        if flat[here] == INNER:
            level = up - 1
            x, y, z = 2 * x, 2 * y, 2 * z
            ny, nz = shape[level, 1], shape[level, 2]
            first = offset[level] + ((x - origin[level, 0]) * ny + (y - origin[level, 1])) * nz + (z - origin[level, 2])
            for c in range(7, -1, -1):
                dx, dy, dz = c & 1, (c >> 1) & 1, c >> 2
                if flat[first + (dx * ny + dy) * nz + dz] != 0:
                    mask |= 1 << c
                    stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = level, x + dx, y + dy, z + dz
                    top += 1
        _put_value(int(bits[here]), mask, out, n)
        n += 5
    return n, n // 5


@kernel
def read_values(data: Bytes, extra: int, stack: Ints, at: Ints, leaves: Keys, bits: Keys) -> int:
    """Read the next leaves of a tree of five bytes per node and some more; as `read_states`.

    Args:
        data: Bytes that `write_values` writes.
        extra: Bytes between the log-odds of a node and the bits of its children, which are skipped.
        stack: (136, 4).
        at: (3,).
        leaves: (n, 4), filled.
        bits: (n,), filled with log-odds (float32) as int32.

    Returns:
        Number of leaves, or TRUNCATED or TOO_DEEP.
    """
    top, used, m = at[0], at[1], 0
    while top > 0 and m < bits.size:
        top -= 1
        if used + 5 + extra > data.shape[0]:
            return TRUNCATED
        level, x, y, z = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        mask = int(data[used + 4 + extra])
        if mask == 0:
            leaves[m, 0], leaves[m, 1], leaves[m, 2], leaves[m, 3] = level, x, y, z
            low, high = np.int32(data[used]) | np.int32(data[used + 1]) << 8, np.int32(data[used + 2])
            bits[m] = low | high << 16 | np.int32(data[used + 3]) << 24
            m += 1
        elif level == 0:
            at[1] = used
            return TOO_DEEP
        used += 5 + extra
        for c in range(7, -1, -1):
            if mask >> c & 1:
                stack[top, 0] = level - 1
                stack[top, 1], stack[top, 2], stack[top, 3] = 2 * x + (c & 1), 2 * y + ((c >> 1) & 1), 2 * z + (c >> 2)
                top += 1
    at[0], at[1], at[2] = top, used, used // (5 + extra)
    return m


@kernel
def paint(leaves: Keys, values: Floats, key_min: Ints, shape: Ints, out: Floats) -> int:
    """Fill the cells of a box that leaves cover.

    Args:
        leaves: (n, 4): level, x, y, z at that level.
        values: (n,) log-odds.
        key_min: (3,) key of out[0, 0, 0].
        shape: (3,) of the box.
        out: (nx, ny, nz), written where a leaf is; empty: leaves are counted alone.

    Returns:
        How many leaves lie outside of the box, wholly or in part.
    """
    outside = 0
    for i in range(leaves.shape[0]):
        level = leaves[i, 0]
        edge = 1 << level
        x = (np.int64(leaves[i, 1]) << level) - key_min[0]
        y = (np.int64(leaves[i, 2]) << level) - key_min[1]
        z = (np.int64(leaves[i, 3]) << level) - key_min[2]
        x0, x1 = max(x, 0), min(x + edge, shape[0])
        y0, y1 = max(y, 0), min(y + edge, shape[1])
        z0, z1 = max(z, 0), min(z + edge, shape[2])
        if x0 != x or y0 != y or z0 != z or x1 != x + edge or y1 != y + edge or z1 != z + edge:
            outside += 1
        if out.size == 0:
            continue
        for a in range(x0, x1):
            for b in range(y0, y1):
                for c in range(z0, z1):
                    out[a, b, c] = values[i]
    return outside
