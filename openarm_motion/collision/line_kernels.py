# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of straight joint lines in the fast collision layer; they release the GIL. m, rad.

A line is checked in the same states as by the exact layer, the middle first, then the middles of its halves, and so
on. A group of shapes that is further apart in the middle than any point of it moves from there to the ends is left out
of both halves: that is a proof for all states between, and most groups are gone after a few checks.
"""

from __future__ import annotations

import math

from openarm_common.kernels import bare_kernel, inner_kernel
from openarm_common.types import Array
from openarm_motion.collision.clearance_kernels import Model, Workspace, check_listed, near, place, sift, sway


@bare_kernel
def line_free(a: Array, b: Array, step: float, travel: float, levers: Array, model: Model, work: Workspace) -> bool:
    """Whether the joint line from `a` to `b` is free at steps as the exact layer takes them, the ends included."""
    return not (near(b, model, work) or near(a, model, work)) and between_free(a, b, step, travel, levers, model, work)


@inner_kernel
def between_free(a: Array, b: Array, step: float, travel: float, levers: Array, model: Model, work: Workspace) -> bool:
    """As `line_free`, but for the ends."""
    largest, way = 0.0, 0.0
    for i in range(a.shape[0]):
        size = abs(b[i] - a[i])
        largest = max(largest, size)
        way += size * levers[i]
    n = math.ceil(max(largest / step, way / travel, 1.0))
    if n == 1:
        return True
    sways, lists, spans = work.sways, work.lists, work.spans
    # the first interval is the whole line; whatever is not listed for an interval can't get too near in it
    head, tail, end = 0, 1, 0
    spans[0, 0], spans[0, 1], spans[0, 2], spans[0, 3] = 0, n, 0, 0
    while head < tail:
        first, last, start, count = spans[head, 0], spans[head, 1], spans[head, 2], spans[head, 3]
        middle = (first + last) // 2
        u = middle / n
        for i in range(a.shape[0]):
            work.q[i] = a[i] + u * (b[i] - a[i])
        place(work.q, model, work)
        sway(a, b, (max(last - middle, middle - first) - 1) / n, model, work)
        if head == 0:
            count = sift(sways, model, work)
            end = count
        head += 1
        split = last - first > 2
        listed = split and end + count <= lists.shape[0]
        kept = check_listed(start, count, end if listed else -1, sways, model, work)
        if kept < 0:
            return False
        if listed:
            start, count = end, kept
            end += kept
        if not split or count == 0:
            continue
        for half in range(2):
            low, high = (first, middle) if half == 0 else (middle, last)
            if high - low >= 2:
                if tail == spans.shape[0]:
                    return False  # no room for so long a line: nothing is proven
                spans[tail, 0], spans[tail, 1], spans[tail, 2], spans[tail, 3] = low, high, start, count
                tail += 1
    return True
