# SPDX-License-Identifier: Apache-2.0
"""The result of a command: one object for people, scripts and the exit code."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import printable_lines

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from openarm_bringup.supervision.supervisor import Event

#: What the command line does last, with the exit code.
AT_END: list[Callable[[int], object]] = []
#: Whether stdout is for people, not for the one JSON document of `--json`.
FOR_PEOPLE: ContextVar[bool] = ContextVar("FOR_PEOPLE", default=True)


@dataclass(frozen=True)
class Outcome:
    """The end of a command.

    Args:
        success: Whether what was asked happened.
        message: One sentence for people.
        code: Why it did not; OK when it did.
        data: Data that `--json` writes in addition to success, code and message.
        text: Longer text for people (a table, a drawing), printed before the message.
    """

    success: bool
    message: str = ""
    code: str = Code.OK
    data: Mapping[str, Any] = field(default_factory=dict[str, Any])
    text: str = ""

    @property
    def exit_code(self) -> int:
        """0 when what was asked happened, else 1 (a wrong call, 2, never gets this far)."""
        return 0 if self.success else 1

    def as_json(self) -> dict[str, Any]:
        """Return what `--json` writes."""
        return {"success": self.success, "code": str(self.code), "message": self.message, **self.data}


def show(text: str) -> None:
    """Print something at once, of a command that goes on; with `--json` on stdout nothing is printed."""
    if FOR_PEOPLE.get():
        sys.stdout.write(printable_lines(text))
        sys.stdout.flush()


def console() -> Console:
    """Return a console on stderr, for what a command shows while it runs."""
    from rich.console import Console

    class PrintableConsole(Console):
        def print(self, *objects: Any, **options: Any) -> None:
            shown = (printable_lines(one) if isinstance(one, str) else one for one in objects)
            super().print(*shown, **options)

    return PrintableConsole(stderr=True, highlight=False)


class GraphReport:
    """Prints on stderr what becomes of a graph while it starts and runs."""

    def __init__(self) -> None:
        self._console = console()

    def event(self, event: Event) -> None:
        """A node has changed; shown when that is a fault."""
        if event.state in ("failed", "backoff"):
            self._console.print(f"{event.node}: {event.state}: {event.detail}", style="red", markup=False)

    def ready(self, seconds: float) -> None:
        """All nodes are ready, after a time in s."""
        self._console.print(f"[green]the graph is ready[/green] after {seconds:.1f} s")


def as_text(table: Table, width: int | None = None) -> str:
    """Return a table as text; without colours where a width is given."""
    from rich.console import Console

    page = Console(highlight=False) if width is None else Console(width=width, color_system=None)
    with page.capture() as shown:
        page.print(table)
    return shown.get()


def failure(error: OpenArmError, **data: Any) -> Outcome:
    """Return the outcome of an error."""
    return Outcome(False, error.message, error.code, data)
