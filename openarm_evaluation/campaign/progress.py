# SPDX-License-Identifier: Apache-2.0
"""A campaign while it runs: a bar with scenes an hour and the time that is left, or a line now and then in a log."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

#: A log gets a line at least this often, s.
_EVERY_S = 60.0


class Pace:
    """How fast rows come.

    Args:
        total: Rows in all.
    """

    def __init__(self, total: int) -> None:
        self._total = total
        self._began = 0.0
        self._there = 0
        self.done = 0

    def begin(self, now_s: float, there: int) -> None:
        """Start to count; `there` rows were there before."""
        self._began, self._there, self.done = now_s, there, there

    def text(self, now_s: float) -> str:
        """Scenes an hour and the time that is left; nothing before the first row."""
        new, took = self.done - self._there, now_s - self._began
        if not new or took <= 0.0:
            return ""
        left = round((self._total - self.done) * took / new)
        return f"{3600.0 * new / took:.0f} scenes an hour, {left // 3600}:{left // 60 % 60:02d}:{left % 60:02d} left"


class Watch:
    """Shows the progress of a campaign.

    Args:
        total: Rows in all.
        console: Where.
    """

    def __init__(self, total: int, console: Console) -> None:
        self._console = console
        self._pace = Pace(total)
        self._total = total
        self._bad = 0
        self._told = time.monotonic()
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        self._progress = Progress(*columns, console=console, disable=not console.is_terminal)
        self._bar = self._progress.add_task("scenes", total=total)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._progress.stop()

    def begin(self, there: int) -> None:
        """The campaign begins with so many rows from before."""
        self._pace.begin(time.monotonic(), there)
        self._progress.update(self._bar, completed=there)

    def show(self, row: dict[str, Any]) -> None:
        """A row has come."""
        now = time.monotonic()
        self._pace.done += 1
        self._bad += not row["as_expected"]
        text = f"{self._bad} not as expected; {self._pace.text(now)}"
        self._progress.update(self._bar, completed=self._pace.done, description=text)
        if not row["as_expected"]:
            line = f"seed {row['seed']} ({row['kind']}): {row['outcome']}: {row['code']}: {row['message']}"
            self._console.print(line, style="red", markup=False)
        if not self._console.is_terminal and now - self._told > _EVERY_S:
            self._told = now
            self._console.print(f"{self._pace.done} of {self._total} scenes, {text}", markup=False)
