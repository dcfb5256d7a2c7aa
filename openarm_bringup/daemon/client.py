# SPDX-License-Identifier: Apache-2.0
"""Asks the daemon of a graph to run a command. The standard library only, so that the answer comes at once."""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from openarm_bringup.daemon.protocol import LONGEST, build, is_answered, peer_uid
from openarm_bringup.supervision.state import is_private, socket_path, state_dir
from openarm_common.errors import Code, OpenArmError

#: Set in the environment, every command joins the graph by itself.
DIRECT = "OPENARM_DIRECT"
#: Longest wait for the greeting, s; a daemon that is being started takes two thirds of it.
_GREETING_S = 3.0


def ask(argv: Sequence[str]) -> int | None:
    """Have the daemon of the graph run a command; return its exit code.

    Returns:
        None, where the command has to be run in this process: it is another one, no graph runs here or several do, or
        the daemon does not answer, is another user's, or is of another build.

    Raises:
        OpenArmError: INTERNAL, when the daemon ends while it runs the command.
    """
    request = json.dumps(list(argv)).encode() + b"\n"
    if os.environ.get(DIRECT) or not is_answered(argv) or len(request) > LONGEST:
        return None
    connection = None
    with suppress(OSError, ValueError, TypeError, KeyError):  # whatever else is there: the command works without it
        connection = _meet(argv)
    if connection is None:
        return None
    with connection:
        return _run(connection, request)


def _meet(argv: Sequence[str]) -> socket.socket | None:
    """Return a connection to the daemon of the graph that the command is for, if it answers and is the right one."""
    domain = _domain(argv)
    records = [json.loads(path.read_bytes()) for path in state_dir().glob("*.json")] if is_private(state_dir()) else []
    records = [record for record in records if domain in (None, record["domain"])]
    if len({record["domain"] for record in records}) > 1 and argv[0] != "ps":
        return None  # which one is for the command to say
    for record in sorted(records, key=lambda record: record["started"], reverse=True):
        if connection := _greeted(int(record["pid"]), record["domain"]):
            return connection
    return None


def _greeted(pid: int, domain: int) -> socket.socket | None:
    path = socket_path(pid)
    connection = socket.socket(socket.AF_UNIX)
    with suppress(OSError, ValueError, TypeError, KeyError):
        connection.settimeout(_GREETING_S)
        if is_private(path):
            connection.connect(str(path))
            if peer_uid(connection) == os.geteuid():
                greeting = json.loads(_line(connection))
                if (greeting["build"], greeting["domain"]) == (build(), domain):
                    connection.settimeout(None)
                    return connection
    connection.close()
    return None


def _line(connection: socket.socket) -> bytes:
    """Read the greeting: the daemon says nothing more before it is asked."""
    line = b""
    while not line.endswith(b"\n"):
        if not (more := connection.recv(4096)) or len(line) > 4096:
            raise ValueError("no greeting")
        line += more
    return line


def _domain(argv: Sequence[str]) -> int | None:
    """Return the domain that the command or the environment names."""
    for index, word in enumerate(argv):
        if word == "--domain":
            return int(argv[index + 1]) if index + 1 < len(argv) else -1
        if word.startswith("--domain="):
            return int(word.partition("=")[2])
    text = os.environ.get("ROS_DOMAIN_ID", "")
    return int(text) if text.isdecimal() else None


def _run(connection: socket.socket, request: bytes) -> int:
    presses: list[int] = []

    def end(number: int, _: Any) -> None:
        """Ask for the end at the first Ctrl-C; leave at the second."""
        presses.append(number)
        if len(presses) > 1:
            sys.exit(128 + number)
        with suppress(OSError):
            connection.shutdown(socket.SHUT_WR)

    before = signal.signal(signal.SIGINT, end)
    try:
        with suppress(BrokenPipeError):  # it has ended: so does what is read
            connection.sendall(request)
        for line in connection.makefile("rb"):
            kind, value = json.loads(line)
            if kind == "exit":
                return int(value)
            stream = sys.stdout if kind == "out" else sys.stderr
            stream.write(value)
            stream.flush()
    except ConnectionResetError:
        pass  # as when it ends without a code
    finally:
        signal.signal(signal.SIGINT, before)
    raise OpenArmError(
        Code.INTERNAL,
        "the daemon of the graph ended while it ran this, which may have happened; `openarm logs daemon` shows why",
    )
