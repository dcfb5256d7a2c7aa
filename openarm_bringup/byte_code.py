# SPDX-License-Identifier: Apache-2.0
"""`python -m openarm_bringup.byte_code`: compile the modules that nodes load, so that no start waits for it."""

from __future__ import annotations

import compileall
import importlib
import sys
from pathlib import Path

from openarm_bringup.supervision.graph import load_graph
from openarm_common.ros.node import prepare


def imported_by_nodes() -> list[Path]:
    """Import the nodes and the command line; return the sources that this took, also those of other projects.

    Kernels and messages load modules of their own when they are first used.
    """
    nodes = load_graph("sim").nodes.values()
    for name in (
        "openarm_bringup.cli",
        "openarm_bringup.daemon.server",
        *(node.module for node in nodes if node.module),
    ):
        importlib.import_module(name)
    prepare()
    files = [getattr(module, "__file__", None) for module in list(sys.modules.values())]
    return sorted({Path(file) for file in files if file and file.endswith(".py")})


def keep_byte_code() -> None:
    """Compile what the nodes import.

    The installer of packages leaves that to their first import, which is in all nodes at the same time, and, where the
    environment has PYTHONDONTWRITEBYTECODE, as in many containers, at every start.
    """
    for file in imported_by_nodes():
        compileall.compile_file(file, quiet=2)


if __name__ == "__main__":
    keep_byte_code()
