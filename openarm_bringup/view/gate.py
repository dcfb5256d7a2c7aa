# SPDX-License-Identifier: Apache-2.0
"""A listener that no client can occupy: bounded connections, each with a short time for its request's head."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from aiohttp import web

#: Connections at the same time, and how long the head of a request may take, s.
MOST, HEAD_S = 64, 5.0
#: Of aiohttp: it says of each request that is no HTTP what the answer says too, with a traceback.
_MALFORMED = logging.getLogger(f"{__name__}.malformed")
_MALFORMED.disabled = True


@asynccontextmanager
async def listening(app: web.Application, host: str, port: int, shutdown_s: float = 1.0) -> AsyncIterator[int]:
    """Serve an application that closes the connection after each answer; give the port.

    When there are `MOST` connections, a new one takes the place of the oldest whose request has not come yet.

    Args:
        app: Application that answers.
        host: Address to listen on.
        port: TCP port; 0 takes any that is free.
        shutdown_s: Longest wait for what is being answered at the end.

    Raises:
        OSError: When it can't listen there.
    """
    runner = web.AppRunner(app, access_log=None, logger=_MALFORMED, shutdown_timeout=shutdown_s)
    await runner.setup()
    gates: dict[Gate, None] = {}
    try:
        make = runner.server
        assert make is not None  # it is set up
        server = await asyncio.get_running_loop().create_server(lambda: Gate(make(), gates), host, port)
        try:
            yield server.sockets[0].getsockname()[1]
        finally:
            server.close()
    finally:
        await runner.cleanup()


class Gate(asyncio.Protocol):
    """Passes a connection on to the protocol that serves it.

    Args:
        inner: Serves it.
        gates: Gates of all connections, the oldest first.
    """

    def __init__(self, inner: asyncio.Protocol, gates: dict[Gate, None]) -> None:
        self._inner, self._gates = inner, gates
        self._transport: asyncio.Transport | None = None
        self._late: asyncio.TimerHandle | None = None
        self._end = b""
        #: Whether the head of the request has come.
        self.asked = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the place of one that asks nothing, where all are taken."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._inner.connection_made(transport)
        if len(self._gates) >= MOST:
            idle = next((gate for gate in self._gates if not gate.asked), None)
            if idle is None:
                transport.write(b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
                transport.close()
                return
            idle.shut()
        self._gates[self] = None
        self._late = asyncio.get_running_loop().call_later(HEAD_S, self.shut)

    def data_received(self, data: bytes) -> None:
        """Pass it on, and notice the end of the head."""
        if not self.asked:
            self._end = (self._end + data)[-max(4, len(data) + 3) :]
            if b"\r\n\r\n" in self._end:
                self._ask()
        self._inner.data_received(data)

    def _ask(self) -> None:
        self.asked, self._end = True, b""
        if self._late is not None:
            self._late.cancel()

    def shut(self) -> None:
        """Close a connection that asks nothing."""
        self._gates.pop(self, None)
        if self._transport is not None:
            self._transport.abort()

    def eof_received(self) -> bool | None:
        """Pass it on."""
        return self._inner.eof_received()

    def connection_lost(self, exc: Exception | None) -> None:
        """Make room."""
        self._gates.pop(self, None)
        if self._late is not None:
            self._late.cancel()
        self._inner.connection_lost(exc)

    def pause_writing(self) -> None:
        """Pass it on."""
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        """Pass it on."""
        self._inner.resume_writing()


async def one_answer(_: web.Request, response: web.StreamResponse) -> None:
    """End the connection after an answer that is no websocket; for `on_response_prepare`."""
    if not isinstance(response, web.WebSocketResponse):
        response.force_close()
        response.headers["Connection"] = "close"  # the headers are made by now
