# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of what is left of the grasps that were found: none alike, none in what was seen."""

from __future__ import annotations

import numpy as np

from openarm_common.kernels import kernel
from openarm_common.types import Array, Ints


@kernel
def inside(points: Array, R: Array, p: Array, planes: Array, starts: Ints, low: Array, high: Array) -> bool:
    """Whether any of points (n, 3) is in the hand at (R, p); low, high: (3,) bounds of the hand in its frame."""
    for n in range(points.shape[0]):
        x, y, z = points[n, 0] - p[0], points[n, 1] - p[1], points[n, 2] - p[2]
        c = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
        if c < low[2] or c > high[2]:
            continue
        a = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z
        b = R[0, 1] * x + R[1, 1] * y + R[2, 1] * z
        if a < low[0] or a > high[0] or b < low[1] or b > high[1]:
            continue
        for piece in range(starts.shape[0] - 1):
            out = False
            for e in range(starts[piece], starts[piece + 1]):
                if planes[e, 0] * a + planes[e, 1] * b + planes[e, 2] * c + planes[e, 3] > 0.0:
                    out = True
                    break
            if not out:
                return True
    return False


@kernel
def distinct(found: Array, apart: float, least_cos: float, best: int) -> Ints:
    """Return the indices of rows (sorted, best first) that no better one resembles: TCP within `apart`, turned less."""
    kept = np.empty(best, np.int64)
    many = 0
    for n in range(found.shape[0]):
        new = True
        for m in range(many):
            a, b = found[n], found[kept[m]]
            dx, dy, dz = a[3] - b[3], a[7] - b[7], a[11] - b[11]
            if dx * dx + dy * dy + dz * dz > apart * apart:
                continue
            trace = 0.0
            for r in range(3):
                for c in range(3):
                    trace += a[4 * r + c] * b[4 * r + c]
            if trace > 1.0 + 2.0 * least_cos:
                new = False
                break
        if new:
            kept[many] = n
            many += 1
            if many == best:
                break
    return kept[:many].copy()
