# SPDX-License-Identifier: Apache-2.0
"""A proxy that authorises connections to a websocket server, then passes frames in both directions.

The SDK's server checks neither a token nor `Origin` nor `Host`, so it listens where a page can't find it, on a random
address of the 2^24 in 127.0.0.0/8 and a random port, and only this proxy knows it.
"""

from __future__ import annotations

import asyncio
import secrets
import threading
from contextlib import AsyncExitStack

import aiohttp
from aiohttp import WSMsgType, web

from openarm_bringup.view.gate import listening, one_answer
from openarm_bringup.view.guard import LOOPBACK, Guard
from openarm_common.errors import Code, OpenArmError


def hidden_address() -> str:
    """A random loopback address."""
    a, b, c = secrets.token_bytes(3)
    return f"127.{a}.{b}.{1 + c % 254}"


class Proxy:
    """Listens in a thread of its own until it is closed.

    Args:
        guard: Authorises requests.
        port: TCP port on the loopback address; 0 takes any that is free.
        inner: `ws://` address of the server behind.

    Raises:
        OpenArmError: ENVIRONMENT, when it can't listen.
    """

    def __init__(self, guard: Guard, port: int, inner: str) -> None:
        self._guard, self._inner = guard, inner
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)
        self._thread.start()
        app = web.Application()
        app.router.add_get("/", self._connect)
        app.on_response_prepare.append(one_answer)
        self._open = AsyncExitStack()
        try:
            opening = self._open.enter_async_context(listening(app, LOOPBACK, port, shutdown_s=0.5))
            self.port = asyncio.run_coroutine_threadsafe(opening, self._loop).result(10.0)
        except OSError as error:
            self.close()
            raise OpenArmError(Code.ENVIRONMENT, f"can't listen on {LOOPBACK}:{port}: {error.strerror}") from error

    def close(self) -> None:
        """Close all connections and stop listening."""
        asyncio.run_coroutine_threadsafe(self._open.aclose(), self._loop).result(10.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout=5.0)
        self._loop.close()

    async def _connect(self, request: web.Request) -> web.StreamResponse:
        host, origin = request.headers.get("Host"), request.headers.get("Origin")
        try:
            self._guard.check_host(host)
            if origin is not None:  # programs that are no browser send none
                self._guard.check_origin(origin, host)
            self._guard.check_token(request.query.get("token"))
        except OpenArmError as error:
            return web.json_response({"code": error.code, "message": error.message}, status=403)
        asked = request.headers.get("Sec-WebSocket-Protocol", "")
        protocols = [name.strip() for name in asked.split(",") if name.strip()]
        async with aiohttp.ClientSession() as session:
            try:
                inner = await session.ws_connect(self._inner, protocols=protocols, max_msg_size=0)
            except aiohttp.WSServerHandshakeError as error:
                return web.Response(status=error.status, text=f"the server behind refuses: {error.message}")
            chosen = [inner.protocol] if inner.protocol else []
            outer = web.WebSocketResponse(protocols=chosen, max_msg_size=2**20, compress=False)
            await outer.prepare(request)
            directions = [asyncio.create_task(_pass(inner, outer)), asyncio.create_task(_pass(outer, inner))]
            _, rest = await asyncio.wait(directions, return_when=asyncio.FIRST_COMPLETED)
            for task in rest:
                task.cancel()
            await asyncio.gather(*directions, return_exceptions=True)
            await inner.close()
            await outer.close()
        return outer


_Socket = aiohttp.ClientWebSocketResponse | web.WebSocketResponse


async def _pass(source: _Socket, sink: _Socket) -> None:
    async for message in source:
        if message.type is WSMsgType.BINARY:
            await sink.send_bytes(message.data)
        elif message.type is WSMsgType.TEXT:
            await sink.send_str(message.data)
