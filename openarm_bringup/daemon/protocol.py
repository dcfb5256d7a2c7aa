# SPDX-License-Identifier: Apache-2.0
"""What the command line and the daemon of a graph say to each other. The standard library only.

The daemon greets with one line of JSON, `{"build": ..., "domain": ...}`. A client of the same build and domain asks
with one line, the list of its arguments; before that it may leave and do the work itself. The daemon answers with lines
`["out", text]`, `["err", text]`, and at the end `["exit", code]`. A client that ends its side asks for the end of the
command, as Ctrl-C does.
"""

from __future__ import annotations

import json
import os
import socket
import struct
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

#: Commands that a daemon runs: they look into the graph, or ask something of it, and touch no files.
COMMANDS = ("topic", "service", "action", "node", "param", "tf", "ps")
#: Longest request, bytes.
LONGEST = 1 << 16


def is_answered(argv: Sequence[str]) -> bool:
    """Return whether a daemon runs a command line: no help, and nothing that is read or written in a folder."""
    words = [word for word in argv if word != "--json"]
    if not words or words[0] not in COMMANDS or (len(words) < 2 and words[0] != "ps"):
        return False
    return not any(
        word in ("--help", "-h", "--version") or word.startswith(("--out", "--json=")) or word.endswith(".json")
        for word in words
    )


def build() -> str:
    """Return what identifies the code: where it is, and when it was changed."""
    folders = (Path(__file__).parents[1], Path(__file__).parents[2] / "openarm_common")
    newest, count = 0, 0
    for folder in folders:
        for root, _, names in os.walk(folder):
            for name in names:
                if name.endswith(".py"):
                    newest, count = max(newest, os.stat(os.path.join(root, name)).st_mtime_ns), count + 1
    return f"{folders[0]} {sys.prefix} {count} {newest}"


def send(connection: socket.socket, value: Any) -> None:
    """Send one line."""
    connection.sendall(json.dumps(value).encode() + b"\n")


def peer_uid(connection: socket.socket) -> int:
    """Return the user of the process at the other end."""
    size = struct.calcsize("3i")
    return struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))[1]
