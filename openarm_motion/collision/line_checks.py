# SPDX-License-Identifier: Apache-2.0
"""What is asked of exact collision checks about straight joint lines and motions, of one arm or of two. m, rad."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.types import Array

if TYPE_CHECKING:
    from openarm_motion.collision.exact import CollisionScene, Contact


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


class LineChecks(ABC):
    """Checks of straight joint lines by single configurations."""

    #: (n,) how far the points that a joint moves are from its axis, at most, m.
    levers: Array
    #: Whether more is checked than the scenes of the arms know, and so the fast layer.
    exact_only: bool = False

    @property
    @abstractmethod
    def arms(self) -> Sequence[CollisionScene]:
        """The scene of each arm, in the order of their joints."""

    @abstractmethod
    def contacts(self, q: ArrayLike) -> list[Contact]:
        """All pairs that are nearer than they may be, the deepest first."""

    @abstractmethod
    def collides(self, q: ArrayLike) -> bool:
        """Whether some pair is nearer than it may be at a configuration (n,)."""

    @abstractmethod
    def lenient(self, share: float, arms: float | None = None) -> AbstractContextManager[None]:
        """Ask for only a share of each positive distance meanwhile, `arms` of that between the arms."""

    @abstractmethod
    def swings(self) -> Array:
        """(p, n) how far the shapes of each pair come nearer when a joint turns, at most, m/rad."""

    @abstractmethod
    def further(self, by: Array) -> AbstractContextManager[None]:
        """Ask for more distance of each pair meanwhile, by (p,) m."""

    def edge_free(self, a: Array, b: Array, step: float = 0.05, travel: float = 0.04) -> bool:
        """Whether the straight joint line between two configurations is free, the ends included.

        Args:
            a: (n,) rad.
            b: (n,) rad.
            step: No joint turns further than this between two checks, rad.
            travel: No point moves further than this between two checks, m; travels of two arms add up.
        """
        return self.first_hit(a, b, step, travel) is None

    def first_hit(self, a: Array, b: Array, step: float = 0.05, travel: float = 0.04) -> Array | None:
        """Some colliding configuration on the line between two, or None; far-apart points are checked first."""
        difference = b - a
        size = np.abs(difference)
        n = int(np.ceil(max(float(size.max()) / step, float(size @ self.levers) / travel, 1.0)))
        return next((q for q in (a + u * difference for u in spread(n)) if self.collides(q)), None)
