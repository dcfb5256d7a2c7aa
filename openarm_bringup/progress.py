# SPDX-License-Identifier: Apache-2.0
"""How far a long command is, where stderr is a terminal."""

from __future__ import annotations

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from openarm_bringup.outcome import console


def progress() -> Progress:
    """Return bars with a count and the time that is left; a context manager."""
    shown = console()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=shown, disable=not shown.is_terminal)
