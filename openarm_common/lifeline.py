# SPDX-License-Identifier: Apache-2.0
"""Notice at once that a process of the same machine has ended, and soon that it hangs, however busy the machine is.

The process listens on a Unix socket in the abstract namespace, and sends a byte now and then to whoever has connected;
the kernel ends the connections when the process ends. From another machine (or network namespace) there is no such
socket: there discovery must do, which forgets a participant whose lease is over.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable

#: Connections that wait to be accepted, also those of processes that have ended.
_BACKLOG = 4096


def _address(name: str) -> bytes:
    return b"\0openarm_lifeline_" + name.encode()


class Lifeline:
    """Shows that this process lives, until it is closed.

    Args:
        name: Not used by any other at this time.

    Raises:
        OSError: It is used.
    """

    def __init__(self, name: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.setblocking(False)
        self._socket.bind(_address(name))
        self._socket.listen(_BACKLOG)
        self._watchers: list[socket.socket] = []

    def beat(self) -> None:
        """Show that this process works."""
        with contextlib.suppress(OSError):  # nobody waits, or it has ended
            while True:
                self._watchers.append(self._socket.accept()[0])
        for watcher in tuple(self._watchers):
            try:
                watcher.send(b".", socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
            except BlockingIOError:  # it has enough to read
                continue
            except OSError:
                self._watchers.remove(watcher)
                watcher.close()

    def close(self) -> None:
        """End it."""
        for one in (self._socket, *self._watchers):
            one.close()
        self._watchers.clear()


class Watched:
    """A process that is watched by its lifeline, in a thread.

    Args:
        connection: Connection to the lifeline.
        on_end: Called once when it ends, unless `close` was called before.

    Attributes:
        ended: True once it has ended.
    """

    def __init__(self, connection: socket.socket, on_end: Callable[[], object]) -> None:
        self.ended = False
        self._connection, self._on_end = connection, on_end
        self._closed = False
        self._heard_at = time.monotonic()
        threading.Thread(target=self._listen, name="lifeline", daemon=True).start()

    @property
    def silence(self) -> float:
        """Seconds since the last sign of life."""
        with contextlib.suppress(OSError):  # this process may have rested itself
            if self._connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT):
                return 0.0
        return time.monotonic() - self._heard_at

    def close(self) -> None:
        """Watch no longer."""
        self._closed = True
        with contextlib.suppress(OSError):  # it has ended by itself
            self._connection.shutdown(socket.SHUT_RDWR)

    def _listen(self) -> None:
        with self._connection, contextlib.suppress(OSError):
            while self._connection.recv(64):
                self._heard_at = time.monotonic()
        if not self._closed:
            self.ended = True
            self._on_end()


def watch(name: str, on_end: Callable[[], object] = lambda: None) -> Watched | None:
    """Watch a lifeline of this machine; None when there is none of that name.

    Args:
        name: Name of the lifeline.
        on_end: Called in a thread when it ends.
    """
    connection = socket.socket(socket.AF_UNIX)
    connection.setblocking(False)
    try:
        connection.connect(_address(name))
    except OSError:
        connection.close()
        return None
    connection.setblocking(True)
    return Watched(connection, on_end)
