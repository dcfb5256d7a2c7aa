# SPDX-License-Identifier: Apache-2.0
"""Lazily imported public names of a package (PEP 562), so that importing the package stays light."""

from __future__ import annotations

import ast
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path


def attach(package: str, file: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return the `__getattr__` and `__dir__` of a package.

    The public names are those that the package imports under `if TYPE_CHECKING:`, from absolute modules, in the form
    `import Name as Name`, which type checkers read as an export; each is imported when it is first used.

    Args:
        package: `__name__` in the `__init__.py` of the package.
        file: `__file__` there.

    Example:
        >>> __getattr__, __dir__ = attach(__name__, __file__)  # doctest: +SKIP
    """

    @cache
    def modules() -> dict[str, str]:
        blocks = [node for node in ast.parse(Path(file).read_text(encoding="utf-8")).body if isinstance(node, ast.If)]
        imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
        return {alias.name: node.module or "" for node in imports for alias in node.names}

    def getattr_(name: str) -> object:
        if name == "__all__":
            return sorted(modules())
        if name.startswith("__") or name not in modules():
            names = ", ".join(sorted(modules()))
            raise AttributeError(f"module {package!r} has no attribute {name!r}; public names: {names}")
        return getattr(import_module(modules()[name]), name)

    return getattr_, lambda: sorted(modules())
