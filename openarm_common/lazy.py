# SPDX-License-Identifier: Apache-2.0
"""Lazily imported public names of a package (PEP 562), so that importing the package stays light."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module


def attach(package: str, modules: Mapping[str, str]) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return the `__getattr__` and `__dir__` of a package.

    Args:
        package: Name of the package (`__name__` in its `__init__.py`).
        modules: Public name to the module that defines it, relative to the package.

    Example:
        >>> __getattr__, __dir__ = attach(__name__, {"Arm": "planning.arm"})  # doctest: +SKIP
    """

    def getattr_(name: str) -> object:
        if name not in modules:
            names = ", ".join(sorted(modules))
            raise AttributeError(f"module {package!r} has no attribute {name!r}; public names: {names}")
        return getattr(import_module(f"{package}.{modules[name]}"), name)

    return getattr_, lambda: sorted(modules)
