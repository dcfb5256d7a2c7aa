# SPDX-License-Identifier: Apache-2.0
"""Puts together what several streams say of one moment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

T = TypeVar("T")


class StampMatcher(Generic[T]):
    """Collects one item of each stream with the same stamp.

    Args:
        streams: Names of the streams.
        complete: Called with the stamp, ns, and the items by stream, once all are there.
        capacity: Moments that are waited for at a time; older ones are dropped.
    """

    def __init__(
        self, streams: Sequence[str], complete: Callable[[int, dict[str, T]], None], capacity: int = 5
    ) -> None:
        self._streams = frozenset(streams)
        self._complete = complete
        self._capacity = capacity
        self._waiting: dict[int, dict[str, T]] = {}
        #: Moments that never became complete.
        self.dropped = 0

    def add(self, stream: str, t_ns: int, item: T) -> None:
        """Add an item; when it completes its moment, the moments before it are given up."""
        moment = self._waiting.setdefault(t_ns, {})
        moment[stream] = item
        if moment.keys() == self._streams:
            self.dropped += sum(1 for t in self._waiting if t < t_ns)
            # stamps later than a complete one are kept unless time went back, in which case they fall to the capacity
            self._waiting = {t: m for t, m in self._waiting.items() if t > t_ns}
            self._complete(t_ns, moment)
        while len(self._waiting) > self._capacity:
            # the first in order of arrival, not of stamps: a restarted simulation starts again from zero
            del self._waiting[next(iter(self._waiting))]
            self.dropped += 1

    def clear(self) -> None:
        """Forget what is incomplete."""
        self._waiting.clear()
