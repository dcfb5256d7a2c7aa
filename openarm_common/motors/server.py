# SPDX-License-Identifier: Apache-2.0
"""Emulated motors on local sockets, one of each bus."""

from __future__ import annotations

import heapq
import select
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from openarm_common.errors import Code, OpenArmError, said
from openarm_common.motors.bus import Frame, SocketBus, unix_name
from openarm_common.motors.emulated import EmulatedBuses


class BusServer:
    """Serves emulated buses on local sockets.

    Args:
        buses: Their addresses are `unix:PATH`.
        advance: Moves what the motors move until a time, ns.
        flexible: Whether replies are CAN FD.

    Raises:
        OpenArmError: ENVIRONMENT, when a socket can't be made.
    """

    def __init__(self, buses: EmulatedBuses, advance: Callable[[int], None], *, flexible: bool = True) -> None:
        self.buses, self._advance, self._flexible = buses, advance, flexible
        self._listeners = dict[int, tuple[socket.socket, str]]()
        self._clients = dict[int, tuple[SocketBus, str]]()
        self._late: list[tuple[int, int, SocketBus, list[Frame]]] = []
        self._count = 0
        for address in buses.addresses:
            path = address.removeprefix("unix:")
            listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            try:
                if not path.startswith("@"):
                    Path(path).unlink(missing_ok=True)
                listener.bind(unix_name(path))
            except OSError as error:
                listener.close()
                text = f"can't serve emulated motors at {address}: {said(error)}; does another robot run there?"
                raise OpenArmError(Code.ENVIRONMENT, text) from error
            listener.listen()
            self._listeners[listener.fileno()] = listener, address

    def serve(self, seconds: float, also: Sequence[int] = ()) -> list[int]:
        """Serve what comes within a time; return the descriptors of `also` that are ready."""
        if self._late:
            seconds = min(seconds, max(0.0, (self._late[0][0] - time.monotonic_ns()) * 1e-9))
        ready, _, _ = select.select([*self._listeners, *self._clients, *also], [], [], seconds)
        now_ns = time.monotonic_ns()
        self._advance(now_ns)
        for fd in ready:
            if fd in self._listeners:
                listener, address = self._listeners[fd]
                client = SocketBus(listener.accept()[0], address, flexible=self._flexible)
                self._clients[client.fileno()] = client, address
            elif fd in self._clients:
                self._answer(fd, now_ns)
        while self._late and self._late[0][0] <= now_ns:
            _, _, client, replies = heapq.heappop(self._late)
            with suppress(OSError, ValueError):
                client.send(replies)
        return [fd for fd in ready if fd in also]

    def close(self) -> None:
        """Close all sockets."""
        for client, _ in self._clients.values():
            client.close()
        for listener, address in self._listeners.values():
            listener.close()
            if not address.startswith("unix:@"):
                Path(address.removeprefix("unix:")).unlink(missing_ok=True)

    def _answer(self, fd: int, now_ns: int) -> None:
        client, address = self._clients[fd]
        try:
            replies = self.buses.take(address, client.receive(), now_ns)
            self._taken(now_ns)
            if self.buses.late_s:
                self._count += 1
                heapq.heappush(self._late, (now_ns + round(self.buses.late_s * 1e9), self._count, client, replies))
            else:
                client.send(replies)
        except OSError:
            client.close()
            del self._clients[fd]

    def _taken(self, now_ns: int) -> None:
        """Called after the frames of a bus were taken, for those who watch them."""
