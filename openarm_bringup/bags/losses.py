# SPDX-License-Identifier: Apache-2.0
"""Messages of a topic that were published and never arrived, from the sequence numbers of its publishers.

A publisher numbers its messages 1, 2, 3, …; a subscriber gets the numbers, but not which publisher they are of.
"""

from __future__ import annotations

from collections.abc import Callable


class Arrivals:
    """The messages of one topic, as they arrive.

    Messages before the first that arrives of a publisher are not counted: they may be older than the subscription.
    """

    def __init__(self) -> None:
        #: Last number of each publisher, the one that was silent longest first.
        self._last: list[int] = []

    def missing(self, sequence: int, publishers: Callable[[], int]) -> int:
        """Note a message; return how many of the same publisher are missing right before it.

        Args:
            sequence: Number that its publisher gave it.
            publishers: Number of publishers of the topic; called only when the number continues no known one.
        """
        earlier = [number for number in self._last if number < sequence]
        before = sequence - 1
        if before not in earlier:
            free = publishers() - len(self._last)
            if free > 0 or not earlier:  # a new publisher, or in the place of one that has ended
                if free <= 0:
                    del self._last[:1]
                self._last.append(sequence)
                return 0
            before = max(earlier)
        self._last.remove(before)
        self._last.append(sequence)
        return sequence - before - 1
