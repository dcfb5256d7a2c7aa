# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the octree codec: a pyramid over a dense box, and the preorder walk over it.

States: 0 unknown, 1 free, 2 occupied, 3 inner node (its children differ). Level 0 are the cells, level 16 the root;
the array of level l begins at key `origin[l]` of that level. All levels begin and end at even keys, so that every
node has its eight children in the array below. Child i of a node lies at ``x = i & 1, y = i >> 1 & 1, z = i >> 2``.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from openarm_common.types import Bytes, Floats, Ints

INNER = 3
#: Why a payload is refused (negative returns of the readers).
TRUNCATED, TOO_DEEP = -1, -2


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def write_states(flat: Bytes, offset: Ints, shape: Ints, origin: Ints, out: Bytes) -> tuple[int, int]:
    """Write the tree as two bytes an inner node, preorder, two bits a child.

    Args:
        flat: All levels one after the other.
        offset: (17,) where each level begins in `flat`.
        shape: (17, 3) of each level.
        origin: (17, 3) key of the first cell of each level.
        out: Filled; two bytes for each inner node.

    Returns:
        Bytes written, and nodes of the tree.
    """
    stack = np.empty((8 * 17, 4), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 16, 0, 0, 0
    top, n, nodes = 1, 0, 1
    while top > 0:
        top -= 1
        level = stack[top, 0] - 1
        x, y, z = 2 * stack[top, 1], 2 * stack[top, 2], 2 * stack[top, 3]
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


@njit(cache=True, nogil=True)
def read_states(data: Bytes, leaves: Ints) -> tuple[int, int, int]:
    """Read the leaves of a tree of two bytes per inner node.

    Args:
        data: As `write_states` writes it.
        leaves: (4 * len(data), 5), filled: level, x, y, z at that level, state.

    Returns:
        Number of leaves, or TRUNCATED or TOO_DEEP; bytes used; nodes of the tree.
    """
    stack = np.empty((8 * 17, 4), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 16, 0, 0, 0
    top, used, m, nodes = 1, 0, 0, 1
    while top > 0:
        top -= 1
        if used + 2 > data.shape[0]:
            return TRUNCATED, used, nodes
        level = stack[top, 0] - 1
        x, y, z = 2 * stack[top, 1], 2 * stack[top, 2], 2 * stack[top, 3]
        bits = int(data[used]) | int(data[used + 1]) << 8
        used += 2
        for c in range(7, -1, -1):
            s = bits >> (2 * c) & 3
            if s == 0:
                continue
            nodes += 1
            cx, cy, cz = x + (c & 1), y + ((c >> 1) & 1), z + (c >> 2)
            if s == INNER:
                if level == 0:
                    return TOO_DEEP, used, nodes
                stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = level, cx, cy, cz
                top += 1
            else:
                leaves[m, 0], leaves[m, 1], leaves[m, 2], leaves[m, 3], leaves[m, 4] = level, cx, cy, cz, s
                m += 1
    return m, used, nodes


@njit(cache=True, nogil=True)
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
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                count, leaves = 0, 0
                best, first, same = np.float32(-np.inf), np.float32(0.0), True
                for c in range(8):
                    x, y, z = 2 * i + (c & 1), 2 * j + ((c >> 1) & 1), 2 * k + (c >> 2)
                    s = below[x, y, z]
                    if s == 0:
                        continue
                    v = values[x, y, z]
                    if count == 0:
                        first = v
                    count += 1
                    leaves += s == 1
                    same = same and v == first
                    best = max(best, v)
                x, y, z = i + shift[0], j + shift[1], k + shift[2]
                above_values[x, y, z] = best
                if count == 0:
                    above[x, y, z] = 0
                else:
                    above[x, y, z] = 1 if leaves == 8 and same else INNER


@njit(cache=True, nogil=True)
def write_values(
    flat: Bytes, values: NDArray[np.uint8], offset: Ints, shape: Ints, origin: Ints, out: Bytes
) -> tuple[int, int]:
    """Write the tree as five bytes a node, preorder: log-odds (float32), then a bit for each child that there is.

    Args:
        flat: States of all levels: 0 nothing, 1 leaf, 3 inner.
        values: (cells, 4) bytes of the float32 values of all levels.
        offset: (17,) where each level begins.
        shape: (17, 3) of each level.
        origin: (17, 3) key of the first cell of each level.
        out: Filled.

    Returns:
        Bytes written, and nodes of the tree.
    """
    stack = np.empty((8 * 17, 4), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 16, 0, 0, 0
    top, n = 1, 0
    while top > 0:
        top -= 1
        up = stack[top, 0]
        x, y, z = stack[top, 1], stack[top, 2], stack[top, 3]
        row = (x - origin[up, 0]) * shape[up, 1] + (y - origin[up, 1])
        here = offset[up] + row * shape[up, 2] + (z - origin[up, 2])
        mask = 0
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
        for b in range(4):
            out[n + b] = values[here, b]
        out[n + 4] = mask
        n += 5
    return n, n // 5


@njit(cache=True, nogil=True)
def read_values(data: Bytes, leaves: Ints) -> tuple[int, int, int]:
    """Read the leaves of a tree of five bytes per node.

    Args:
        data: As `write_values` writes it.
        leaves: (len(data) // 5, 5), filled: level, x, y, z at that level, offset of the value in `data`.

    Returns:
        Number of leaves, or TRUNCATED or TOO_DEEP; bytes used; nodes of the tree.
    """
    stack = np.empty((8 * 17, 4), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 16, 0, 0, 0
    top, used, m = 1, 0, 0
    while top > 0:
        top -= 1
        if used + 5 > data.shape[0]:
            return TRUNCATED, used, used // 5
        level, x, y, z = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        mask = int(data[used + 4])
        if mask == 0:
            leaves[m, 0], leaves[m, 1], leaves[m, 2], leaves[m, 3], leaves[m, 4] = level, x, y, z, used
            m += 1
        elif level == 0:
            return TOO_DEEP, used, used // 5
        used += 5
        for c in range(7, -1, -1):
            if mask >> c & 1:
                stack[top, 0] = level - 1
                stack[top, 1], stack[top, 2], stack[top, 3] = 2 * x + (c & 1), 2 * y + ((c >> 1) & 1), 2 * z + (c >> 2)
                top += 1
    return m, used, used // 5


@njit(cache=True, nogil=True)
def paint(leaves: Ints, values: Floats, key_min: Ints, out: Floats) -> int:
    """Fill the cells of a box that leaves cover.

    Args:
        leaves: (n, 5): level, x, y, z at that level.
        values: (n,) log-odds.
        key_min: (3,) key of out[0, 0, 0].
        out: (nx, ny, nz), written where a leaf is.

    Returns:
        How many leaves lie outside of the box, wholly or in part.
    """
    outside = 0
    for i in range(leaves.shape[0]):
        level = leaves[i, 0]
        edge = 1 << level
        x, y, z = (leaves[i, 1] << level) - key_min[0], (leaves[i, 2] << level) - key_min[1], leaves[i, 3]
        z = (z << level) - key_min[2]
        x0, x1 = max(x, 0), min(x + edge, out.shape[0])
        y0, y1 = max(y, 0), min(y + edge, out.shape[1])
        z0, z1 = max(z, 0), min(z + edge, out.shape[2])
        if x0 != x or y0 != y or z0 != z or x1 != x + edge or y1 != y + edge or z1 != z + edge:
            outside += 1
        for a in range(x0, x1):
            for b in range(y0, y1):
                for c in range(z0, z1):
                    out[a, b, c] = values[i]
    return outside
