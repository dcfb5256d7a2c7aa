# SPDX-License-Identifier: Apache-2.0
"""Images of two cameras that were taken at the same moment."""

from __future__ import annotations

from collections import Counter, deque
from typing import Generic, Literal, TypeVar

T = TypeVar("T")
Side = Literal["left", "right"]

#: Images of one side that wait for the other.
_WAITING = 4


class PairMatcher(Generic[T]):
    """Pairs images by their stamps: each with the one of the other side that is nearest in time. Single-threaded.

    Args:
        gap: Most that the stamps of a pair differ, s; 0: they are equal.
        max_rate: Pairs a second of the stamps, Hz; others are passed over; 0: all.

    Attributes:
        counts: Images by what became of them: `paired`, `alone` (no partner came), `passed` (for the rate).
    """

    def __init__(self, gap: float, max_rate: float = 0.0) -> None:
        self.counts: Counter[str] = Counter()
        self._gap_ns = round(gap * 1e9)
        self._period_ns = 0.999e9 / max_rate if max_rate else 0.0
        self._waiting: dict[Side, deque[tuple[int, T]]] = {"left": deque(), "right": deque()}
        self._last_ns: int | None = None

    def add(self, side: Side, t_ns: int, image: T) -> tuple[int, T, T] | None:
        """Add an image; return the stamp of the left one, and the left and right image, when it completes a pair.

        Args:
            side: Side of the camera.
            t_ns: Stamp.
            image: Message or array.
        """
        others = self._waiting["right" if side == "left" else "left"]
        best = min(others, key=lambda other: abs(other[0] - t_ns), default=None)
        if best is None or abs(best[0] - t_ns) > self._gap_ns:
            mine = self._waiting[side]
            mine.append((t_ns, image))
            if len(mine) > _WAITING:
                mine.popleft()
                self.counts["alone"] += 1
            return None
        self.counts["alone"] += sum(len(waiting) for waiting in self._waiting.values()) - 1
        for waiting in self._waiting.values():
            waiting.clear()
        stamp, left, right = (t_ns, image, best[1]) if side == "left" else (best[0], best[1], image)
        # a stamp before the last one is a restarted simulation, not an image that came too early
        if self._last_ns is not None and 0 <= stamp - self._last_ns < self._period_ns:
            self.counts["passed"] += 1
            return None
        self._last_ns = stamp
        self.counts["paired"] += 1
        return stamp, left, right

    def clear(self) -> None:
        """Forget what waits, and the rate."""
        for waiting in self._waiting.values():
            waiting.clear()
        self._last_ns = None
