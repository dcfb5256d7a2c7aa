# SPDX-License-Identifier: Apache-2.0
"""`python -m openarm_bringup.daemon SOCKET DOMAIN`: the daemon of a graph, started by its supervisor.

What it imports takes a second or two, while the graph may already work: that is done at a low priority, which on Linux
is one of a thread.
"""

from __future__ import annotations

import os
import threading


def _import() -> None:
    os.setpriority(os.PRIO_PROCESS, 0, 10)
    import openarm_bringup.daemon.server  # noqa: F401  # pyright: ignore[reportUnusedImport]


def main() -> None:
    """Import, then answer on the inherited socket until SIGINT or SIGTERM."""
    thread = threading.Thread(target=_import, daemon=True)
    thread.start()
    thread.join()
    from openarm_bringup.daemon.server import main as serve

    serve()


if __name__ == "__main__":
    main()
