# SPDX-License-Identifier: Apache-2.0
"""In which order to look at the points of a line."""

from __future__ import annotations

from functools import lru_cache


@lru_cache(maxsize=512)
def spread(n: int) -> tuple[float, ...]:
    """0, 1/n, ..., 1 with the ends and far-apart points first, so that a collision is found early."""
    order: list[int] = [n, 0]
    gap = n
    seen = {0, n}
    while len(seen) <= n:
        gap = max(gap // 2, 1)
        for k in range(gap, n, gap):
            if k not in seen:
                seen.add(k)
                order.append(k)
    return tuple(k / n for k in order)
