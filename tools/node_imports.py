# SPDX-License-Identifier: Apache-2.0
"""What each node of a graph imports, what it costs, and which module of the suite asked for it.

    python tools/node_imports.py [GRAPH] [--node NAME] [--above MS]

Each node's module is imported in a process of its own (`python -X importtime`). The table has a row for each library:
its share of the import in milliseconds, its modules, and the imports that lead to it from the node.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from openarm_bringup.supervision.graph import load_graph

_LINE = re.compile(r"import time:\s*(\d+) \|\s*\d+ \|( +)(\S+)")


@dataclass
class Library:
    """Modules with one first name."""

    ms: float = 0.0
    modules: int = 0
    asked_by: list[str] = field(default_factory=list[str])


def imports(module: str) -> Iterator[tuple[str, float, tuple[str, ...]]]:
    """Yield each module that an import loads, its own time in ms, and the modules that led to it, first to last.

    Raises:
        RuntimeError: The module cannot be imported.
    """
    run = subprocess.run([sys.executable, "-X", "importtime", "-c", f"import {module}"], capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError(f"{module} cannot be imported: {run.stderr.strip().splitlines()[-1]}")
    parents: list[tuple[int, str]] = []
    # A module is printed after those that it imports: read from the end, it comes before them.
    for us, indent, name in reversed(_LINE.findall(run.stderr)):
        while parents and parents[-1][0] >= len(indent):
            parents.pop()
        yield name, int(us) / 1e3, tuple(parent for _, parent in parents)
        parents.append((len(indent), name))


def libraries(loaded: Iterable[tuple[str, float, tuple[str, ...]]]) -> dict[str, Library]:
    """Return the libraries by name; the standard library counts as one."""
    found: dict[str, Library] = defaultdict(Library)
    for name, ms, parents in loaded:
        first = name.split(".")[0]
        library = found["(standard library)" if first in sys.stdlib_module_names else first]
        library.ms += ms
        library.modules += 1
        library.asked_by = [parent for parent in parents if parent.startswith("openarm_")]
    return found


def main() -> None:
    """Print a table for each node of a graph."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("graph", nargs="?", default="sim", help="name or file")
    parser.add_argument("--node", help="this one alone")
    parser.add_argument("--above", type=float, default=10.0, help="ms; libraries that cost less are left out")
    args = parser.parse_args()
    for name, node in load_graph(args.graph).nodes.items():
        if node.module is None or args.node not in (None, name):
            continue
        found = libraries(imports(node.module))
        ms, modules = sum(one.ms for one in found.values()), sum(one.modules for one in found.values())
        print(f"\n{name}: {ms:.0f} ms, {modules} modules")
        for library, one in sorted(found.items(), key=lambda item: -item[1].ms):
            if one.ms >= args.above:
                print(f"  {library:22} {one.ms:6.0f} ms {one.modules:5}  {' > '.join(one.asked_by)}")


if __name__ == "__main__":
    main()
