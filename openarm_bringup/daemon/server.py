# SPDX-License-Identifier: Apache-2.0
"""The daemon of a graph.

It keeps one ROS context for as long as it runs, in which the graph is discovered; each request gets a thread, and a
node of its own in that context. What runs is the command line itself, with its output sent to the client.
"""

from __future__ import annotations

import io
import json
import os
import select
import signal
import socket
import sys
import threading
import time
import traceback
from contextvars import ContextVar
from functools import partial
from typing import Any, TextIO

from openarm_bringup import cli
from openarm_bringup.commands import connect, processes, ros2, tf  # what is asked for, imported before
from openarm_bringup.daemon.protocol import LONGEST, build, is_answered, peer_uid, send
from openarm_bringup.ros.peer import Peer
from openarm_bringup.supervision import shm
from openarm_common.errors import OpenArmError
from openarm_common.ros.client import ContextNode, new_context

#: Longest wait for a request, s.
_REQUEST_S = 5.0
#: Requests at the same time; a further client does its work itself.
_MOST = 16
#: Longest wait for requests to end when the daemon does, s.
_END_S = 1.0
_CLIENT: ContextVar[Client | None] = ContextVar("_CLIENT", default=None)
_WARM = (processes, ros2, tf)


class Client:
    """The other end of a request."""

    def __init__(self, connection: socket.socket, stopping: threading.Event) -> None:
        self._connection = connection
        self._stopping = stopping
        self._told = False

    def say(self, kind: str, value: Any) -> None:
        """Send a line; a client that is gone is noticed by `check`."""
        try:
            send(self._connection, [kind, value])
        except OSError:
            self._stopping = _SET

    def check(self) -> None:
        """Raise KeyboardInterrupt, once, when the client has ended its side, or the daemon ends."""
        if not self._told and (self._stopping.is_set() or self._ended()):
            self._told = True
            raise KeyboardInterrupt

    def _ended(self) -> bool:
        try:
            return not self._connection.recv(1, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            return True


_SET = threading.Event()
_SET.set()


class _ToClient(io.TextIOBase):
    """What a request prints goes to its client, anything else where it would."""

    def __init__(self, kind: str, otherwise: TextIO) -> None:
        self._kind, self._otherwise = kind, otherwise

    def write(self, text: str, /) -> int:
        client = _CLIENT.get()
        if client is None:
            return self._otherwise.write(text)
        client.say(self._kind, text)
        return len(text)

    def flush(self) -> None:
        self._otherwise.flush()


class Daemon:
    """Answers clients until a signal, or until its code has been changed.

    Args:
        listener: Socket that the supervisor has opened.
        domain: Domain of the graph; the environment says the same.
    """

    def __init__(self, listener: socket.socket, domain: int) -> None:
        self._listener = listener
        self._greeting = {"build": build(), "domain": domain}
        self._stopping = threading.Event()
        self._threads: set[threading.Thread] = set()
        self._context = new_context()
        # Kept: with its last node a context leaves the graph, and the next one discovers it anew.
        self._resident = ContextNode(f"_openarm_daemon_{os.getpid()}", bare=True, context=self._context)
        try:
            with Peer(self._context):
                pass  # the graph is discovered
        except OpenArmError as error:
            sys.stderr.write(f"{error}\n")  # each request looks again

    def run(self) -> None:
        """Answer until a signal; the next client of a changed code meets the next daemon."""
        # A signal that another thread gets, or that comes just before `select`, would not end it.
        signalled, wakeup = socket.socketpair()
        wakeup.setblocking(False)
        signal.set_wakeup_fd(wakeup.fileno())
        while True:
            ready, _, _ = select.select([self._listener, signalled], [], [])
            if signalled in ready:
                return
            self._threads = {thread for thread in self._threads if thread.is_alive()}
            if build() != self._greeting["build"]:
                return
            try:
                connection, _ = self._listener.accept()
            except BlockingIOError:  # it has gone again
                continue
            if len(self._threads) >= _MOST:
                connection.close()
                continue
            thread = threading.Thread(target=self._serve, args=(connection,), daemon=True)
            self._threads.add(thread)
            thread.start()

    def close(self) -> None:
        """End the requests."""
        self._stopping.set()
        deadline = time.monotonic() + _END_S
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _serve(self, connection: socket.socket) -> None:
        with connection:
            try:
                connection.setblocking(True)
                if peer_uid(connection) != os.geteuid():
                    return
                send(connection, self._greeting)
                argv = _request(connection)
            except (OSError, ValueError, RecursionError):
                return  # not one of ours, or gone
            client = Client(connection, self._stopping)
            _CLIENT.set(client)
            connect.PEER.set(partial(Peer, self._context, check=client.check, settled=True))
            code = 1
            try:
                code = cli.run(argv)
            except Exception as error:
                print(traceback.format_exc(), file=sys.__stderr__)  # the log of the daemon
                what = type(error).__name__
                client.say("err", f"INTERNAL: a defect of this command ({what}); `openarm logs daemon` shows where\n")
            client.say("exit", code)


def _request(connection: socket.socket) -> list[str]:
    """Read the arguments of a command.

    Raises:
        ValueError: for anything else.
        OSError: when nothing comes, or not all of it in time.
    """
    deadline, line = time.monotonic() + _REQUEST_S, b""
    while not line.endswith(b"\n"):
        connection.settimeout(max(1e-3, deadline - time.monotonic()))
        more = connection.recv(LONGEST)
        line += more
        if not more or len(line) > LONGEST or time.monotonic() > deadline:
            raise ValueError("no request")
    connection.settimeout(None)
    argv: Any = json.loads(line)
    if not isinstance(argv, list) or not all(isinstance(word, str) for word in argv) or not is_answered(argv):
        raise ValueError("not a command that is answered here")
    return argv


def main() -> None:
    """Answer on the inherited socket until SIGINT or SIGTERM."""
    for number in (signal.SIGINT, signal.SIGTERM):  # a shell starts what is in its background with SIGINT ignored
        signal.signal(number, signal.default_int_handler)
    sys.stdout, sys.stderr = _ToClient("out", sys.stdout), _ToClient("err", sys.stderr)
    daemon, code = None, 0
    try:
        daemon = Daemon(socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2]))
        daemon.run()
    except KeyboardInterrupt:
        pass
    except Exception:
        traceback.print_exc()
        code = 1
    if daemon is not None:
        daemon.close()
    shm.leave(shm.mapped_by(os.getpid()), code)
