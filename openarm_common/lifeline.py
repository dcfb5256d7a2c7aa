# SPDX-License-Identifier: Apache-2.0
"""Notice at once that a process of the same machine has ended, however it ended and however busy the machine is.

The process listens on a Unix socket in the abstract namespace; the other connects, and reads its end when the kernel
has closed it. Nothing is sent, and no connection has to be accepted. From another machine (or network namespace) there
is no such socket: there a lease must do.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable

#: Connections that a lifeline may have, also those of processes that have ended: beyond it a lease must do.
_WATCHERS = 4096


def _address(name: str) -> bytes:
    return b"\0openarm_lifeline_" + name.encode()


class Lifeline:
    """Shows that this process lives, until it is closed.

    Args:
        name: Not used by any other at this time.
    """

    def __init__(self, name: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.bind(_address(name))
        self._socket.listen(_WATCHERS)

    def close(self) -> None:
        """End it."""
        self._socket.close()


def lives(name: str) -> bool:
    """Return whether there is a lifeline of that name on this machine; that of a stopped process is there, too."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.setblocking(False)
        try:
            connection.connect(_address(name))
        except BlockingIOError:  # as many wait for it as it can have
            return True
        except OSError:
            return False
    return True


def watch(name: str, ended: Callable[[], object]) -> Callable[[], None] | None:
    """Call a function, in a thread, when a lifeline ends.

    Args:
        name: Of the lifeline.
        ended: Called once, unless the watch has ended before.

    Returns:
        Ends the watch; None when there is no such lifeline on this machine.
    """
    connection = socket.socket(socket.AF_UNIX)
    connection.setblocking(False)
    try:
        connection.connect(_address(name))
    except OSError:
        connection.close()
        return None
    connection.setblocking(True)
    over = threading.Event()

    def wait() -> None:
        with connection, contextlib.suppress(OSError):
            connection.recv(1)
        if not over.is_set():
            ended()

    def end() -> None:
        over.set()
        with contextlib.suppress(OSError):  # it has ended by itself
            connection.shutdown(socket.SHUT_RDWR)

    threading.Thread(target=wait, name="lifeline", daemon=True).start()
    return end
