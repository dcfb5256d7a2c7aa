# SPDX-License-Identifier: Apache-2.0
"""A campaign while it runs: a bar with scenes an hour and the time that is left, or a line now and then in a log."""

from __future__ import annotations

import time
from datetime import timedelta
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

#: A log gets a line at least this often, s.
_EVERY_S = 60.0


def pace(new: int, left: int, seconds: float) -> str:
    """Scenes an hour and the time that is left, by the `new` rows of some seconds; nothing before the first row."""
    if not new or seconds <= 0.0:
        return ""
    return f"{3600.0 * new / seconds:.0f} scenes an hour, {timedelta(seconds=round(left * seconds / new))} left"


class Watch(Progress):
    """Shows the progress of a campaign; a context manager.

    Args:
        total: Rows in all.
        console: Console to write to.
    """

    def __init__(self, total: int, console: Console) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        super().__init__(*columns, console=console, disable=not console.is_terminal)
        self._bar = self.add_task("scenes", total=total)
        self._total = total
        self._before = self._done = self._bad = 0
        self._began = self._printed = time.monotonic()

    def begin(self, there: int) -> None:
        """The campaign begins with so many rows from before."""
        self._began, self._before, self._done = time.monotonic(), there, there
        self.update(self._bar, completed=there)

    def show(self, row: dict[str, Any]) -> None:
        """A row has come."""
        now = time.monotonic()
        self._done += 1
        self._bad += not row["as_expected"]
        speed = pace(self._done - self._before, self._total - self._done, now - self._began)
        text = f"{self._bad} not as expected; {speed}"
        self.update(self._bar, completed=self._done, description=text)
        if not row["as_expected"]:
            line = f"seed {row['seed']} ({row['kind']}): {row['outcome']}: {row['code']}: {row['message']}"
            self.console.print(line, style="red", markup=False)
        if not self.console.is_terminal and now - self._printed > _EVERY_S:
            self._printed = now
            self.console.print(f"{self._done} of {self._total} scenes, {text}", markup=False)
