# SPDX-License-Identifier: Apache-2.0
"""Say that numba compiles: the first caller of a kernel whose code is not kept yet waits for seconds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.core import event

#: What numba calls the compilation of one function.
_COMPILE = "numba:compile"


class _CompileListener(event.Listener):
    """Says once for each package that its kernels are being compiled."""

    def __init__(self) -> None:
        self.say: Callable[[str], object] | None = None
        self._said = set[str]()

    def on_start(self, event: Any) -> None:
        package = str(event.data["dispatcher"].py_func.__module__).rpartition(".")[0]
        if self.say is not None and package.startswith("openarm_") and package not in self._said:
            self._said.add(package)
            self.say(f"compiling kernels of {package}: once, and it takes some seconds")

    def on_end(self, event: Any) -> None:
        pass


_LISTENER = _CompileListener()


def announce(say: Callable[[str], object]) -> None:
    """Have it said when kernels are compiled in this process; who asked last is told.

    Args:
        say: Gets a sentence for each package, in the thread that compiles.
    """
    if _LISTENER.say is None:
        event.register(_COMPILE, _LISTENER)
    _LISTENER.say = say
