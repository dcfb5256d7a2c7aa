# SPDX-License-Identifier: Apache-2.0
"""Which arms are taken, and by what: one motion of an arm at a time."""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager

from openarm_common.errors import Code, OpenArmError

_GOAL = "is moving already; wait for the end, or cancel it first"


class ArmClaims:
    """Arms that are taken; from any thread."""

    def __init__(self) -> None:
        self._taken: dict[str, str] = {}
        self._lock = threading.Lock()

    def take(self, *names: str, why: str = _GOAL) -> None:
        """Take arms.

        Args:
            names: All of them, or none where one is taken.
            why: Sentence that others read, after "the left arm".

        Raises:
            OpenArmError: BUSY, when one of them is taken.
        """
        with self._lock:
            for name in names:
                if name in self._taken:
                    raise OpenArmError(Code.BUSY, f"the {name} arm {self._taken[name]}")
            self._taken.update(dict.fromkeys(names, why))

    def give(self, *names: str) -> None:
        """Give arms back."""
        for name in names:
            self._taken.pop(name, None)

    @contextmanager
    def holding(self, *names: str, wanted: bool) -> Generator[None, None, None]:
        """Take arms for as long as this is open, where that is wanted; raises as `take`."""
        claimed = names if wanted else ()
        self.take(*claimed)
        try:
            yield
        finally:
            self.give(*claimed)
