# SPDX-License-Identifier: Apache-2.0
"""The web server of `openarm view`: the page, a websocket that shows, and requests that ask.

Every page gets the newest of what it wants, as fast as it takes it: what a slow one misses is not queued. Each request
passes a `Guard`.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections import defaultdict
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from aiohttp import WSCloseCode, WSMsgType, web
from pydantic import AfterValidator, Field, ValidationError

from openarm_bringup.view.gate import one_answer
from openarm_bringup.view.guard import Guard
from openarm_common.config import Config, describe_faults
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import known_arm

if TYPE_CHECKING:
    from openarm_bringup.view.ros.page import GraphView

PAGE = Path(__file__).parent / "page"
#: What every page gets while it is open.
ALWAYS = frozenset({"states"})
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self';"
        " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
_MAX_PAGES = 8
_MAX_BYTES = 4096
#: Requests of one kind that are answered at the same time; each kind has threads of its own.
_MOST_AT_ONCE = 2
_LOG = logging.getLogger(__name__)


class Order(Config):
    """A grasp that a page asks for."""

    label: str = Field(default="", max_length=64, description="what to pick; empty = the best detection")
    arm: Annotated[str, AfterValidator(known_arm)] = "auto"
    dry_run: bool = False
    confirm: bool = False


class Confirmation(Config):
    """The answer of a person to the plan that waits."""

    plan_id: str = Field(max_length=64, description="of the plan")
    accept: bool = Field(description="execute it; false: end the request")


class Reset(Config):
    """A reset of the simulation that a page asks for."""

    scene: str = Field(default="", max_length=64, pattern=r"^[A-Za-z0-9_]*$", description="empty = the present one")
    seed: int = Field(default=0, ge=0, lt=2**63, description="of a random scene")


class Wants(Config):
    """Layers that a page wants."""

    want: tuple[str, ...] = Field(max_length=32)


class Item(NamedTuple):
    """Something new: of the newest of each key, a page gets it when it wants the layer."""

    layer: str
    key: str
    payload: str | bytes


class _Page:
    """One open page."""

    def __init__(self) -> None:
        self.wants: frozenset[str] = ALWAYS
        self.pending: dict[str, str | bytes] = {}
        self.news = asyncio.Event()

    def give(self, key: str, payload: str | bytes) -> None:
        self.pending[key] = payload
        self.news.set()


class ViewServer:
    """Serves pages; made and used in one asyncio loop.

    Args:
        guard: Authorises requests.
        hello: First message to a page: the robot, the cameras, the states of a grasp.
        meshes: And then, a frame: those of the robot.
        view: Observes the graph; its methods but `want` block, and are called in threads.
    """

    def __init__(self, guard: Guard, hello: Mapping[str, Any], view: GraphView, meshes: bytes = b"") -> None:
        self.guard = guard
        self._view = view
        self._hello, self._meshes = json.dumps({"kind": "hello", **hello}), meshes
        self._pages: set[_Page] = set()
        self._kept: dict[str, Item] = {}
        self._picking: asyncio.Task[None] | None = None
        self._threads = defaultdict[str, ThreadPoolExecutor](lambda: ThreadPoolExecutor(_MOST_AT_ONCE))
        self._asked = defaultdict[str, int](int)
        self._files = {str(path.relative_to(PAGE)) for path in PAGE.rglob("*.*")} - {"index.html"}

    def app(self) -> web.Application:
        """The aiohttp application."""
        app = web.Application(client_max_size=_MAX_BYTES, middlewares=[self._check])
        app.on_response_prepare.extend((_add_headers, one_answer))
        app.router.add_get("/", self._page)
        app.router.add_get("/socket", self._socket)
        app.router.add_post("/pick", self._pick)
        app.router.add_post("/confirm", self._confirm)
        app.router.add_post("/reset", self._reset)
        for name, ask in (("cancel", self._view.cancel), ("stop", self._view.stop), ("release", self._view.release)):
            app.router.add_post(f"/{name}", partial(self._urgent, name, ask))
        app.on_cleanup.append(self._end_threads)
        app.router.add_get("/{name:.+}", self._file)
        return app

    def put(self, item: Item) -> None:
        """Take something new; in the loop."""
        self._kept[item.key] = item
        for page in self._pages:
            if item.layer in page.wants:
                page.give(item.key, item.payload)

    # --- authorisation
    @web.middleware
    async def _check(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        host, acts = request.headers.get("Host"), request.method not in ("GET", "HEAD")
        try:
            self.guard.check_host(host)
            if acts or request.path == "/socket":
                self.guard.check_origin(request.headers.get("Origin"), host)
                scheme, _, bearer = request.headers.get("Authorization", "").partition(" ")
                # a script can give a websocket no header
                asked = request.query.get("token") if request.path == "/socket" else None
                self.guard.check_token(asked or (bearer if scheme == "Bearer" else None))
        except OpenArmError as error:
            return web.json_response(_failed(error), status=403)
        try:
            return await handler(request)
        except (web.HTTPException, asyncio.CancelledError):
            raise
        except Exception:
            _LOG.exception("request %s", request.path)
            fault = OpenArmError(Code.INTERNAL, "a defect of this server; its log has the traceback")
            return web.json_response(_failed(fault), status=500)

    # --- layers
    async def _page(self, _: web.Request) -> web.FileResponse:
        return web.FileResponse(PAGE / "index.html")

    async def _file(self, request: web.Request) -> web.FileResponse:
        name = request.match_info["name"]
        if name not in self._files:
            raise web.HTTPNotFound(text=f"there is no {name!r} here")
        return web.FileResponse(PAGE / name)

    async def _socket(self, request: web.Request) -> web.WebSocketResponse:
        if len(self._pages) >= _MAX_PAGES:
            raise web.HTTPServiceUnavailable(text=f"{_MAX_PAGES} pages are open already; close one")
        socket = web.WebSocketResponse(heartbeat=20.0, max_msg_size=_MAX_BYTES, compress=False)
        await socket.prepare(request)
        page = _Page()
        self._pages.add(page)
        sender = asyncio.create_task(self._send(page, socket))
        try:
            async for message in socket:
                if message.type is not WSMsgType.TEXT:
                    break
                try:
                    self._wants(page, Wants.model_validate_json(message.data).want)
                except (ValidationError, OpenArmError) as error:
                    reason = str(error).partition("\n")[0][:120]
                    await socket.close(code=WSCloseCode.POLICY_VIOLATION, message=reason.encode())
        finally:
            self._pages.discard(page)
            sender.cancel()
            await asyncio.gather(sender, return_exceptions=True)
            self._demand()
        return socket

    async def _send(self, page: _Page, socket: web.WebSocketResponse) -> None:
        await socket.send_str(self._hello)
        if self._meshes:
            await socket.send_bytes(self._meshes)
        self._wants(page, ())
        while True:
            await page.news.wait()
            page.news.clear()
            for key in list(page.pending):
                payload = page.pending.pop(key)
                await (socket.send_bytes(payload) if isinstance(payload, bytes) else socket.send_str(payload))

    def _wants(self, page: _Page, layers: tuple[str, ...]) -> None:
        known = self._view.layers
        unknown = [layer for layer in layers if layer not in known]
        if unknown:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no layer {unknown[0]!r}; there are {', '.join(known)}")
        before, page.wants = page.wants, frozenset(layers) | ALWAYS
        for item in self._kept.values():
            if item.layer in page.wants and (item.layer not in before or item.layer in ALWAYS):
                page.give(item.key, item.payload)
        self._demand()

    def _demand(self) -> None:
        """Observe what some page wants; what none wants any more is not kept, it would be stale later."""
        wanted = frozenset[str]().union(*(page.wants for page in self._pages))
        self._kept = {key: item for key, item in self._kept.items() if item.layer in wanted | ALWAYS}
        self._view.want(wanted)

    # --- requests
    async def _pick(self, request: web.Request) -> web.Response:
        order = await _body(request, Order)
        if self._picking is not None and not self._picking.done():
            text = "a grasp that was asked for here is running; cancel it or wait until it has ended"
            return web.json_response(_failed(OpenArmError(Code.BUSY, text)), status=409)
        self._picking = asyncio.create_task(self._do_pick(order))
        return web.json_response({"success": True, "code": Code.OK, "message": "asked"}, status=202)

    async def _do_pick(self, order: Order) -> None:
        self._outcome(running=True, message="", label=order.label)
        try:
            result = await self._in_thread("pick", lambda: self._view.pick(order))
        except OpenArmError as error:
            result = _failed(error)
        except Exception:  # else the page would wait for ever
            _LOG.exception("pick")
            result = _failed(OpenArmError(Code.INTERNAL, "a defect of this server; its log has the traceback"))
        self._outcome(running=False, **result)

    def _outcome(self, **values: Any) -> None:
        self.put(Item("states", "outcome", json.dumps({"kind": "outcome", **values})))

    async def _confirm(self, request: web.Request) -> web.Response:
        answer = await _body(request, Confirmation)
        return await self._answer("confirm", lambda: self._view.confirm(answer))

    async def _urgent(self, kind: str, ask: Callable[[], tuple[bool, str]], _: web.Request) -> web.Response:
        return await self._answer(kind, ask)

    async def _reset(self, request: web.Request) -> web.Response:
        order = await _body(request, Reset)
        return await self._answer("reset", lambda: self._view.reset(order))

    async def _answer(self, kind: str, ask: Callable[[], tuple[bool, str]]) -> web.Response:
        try:
            success, message = await self._in_thread(kind, ask)
        except OpenArmError as error:
            return web.json_response(_failed(error), status=409 if error.code is Code.BUSY else 200)
        return web.json_response({"success": success, "code": Code.OK if success else "REFUSED", "message": message})

    async def _in_thread(self, kind: str, ask: Callable[[], Any]) -> Any:
        """Ask the graph in a thread of this kind of request: no other kind can be before it."""
        if self._asked[kind] >= _MOST_AT_ONCE:
            text = f"{_MOST_AT_ONCE} requests /{kind} wait for their answer; wait until one has it"
            raise OpenArmError(Code.BUSY, text)
        self._asked[kind] += 1
        asked = asyncio.get_running_loop().run_in_executor(self._threads[kind], ask)
        asked.add_done_callback(lambda _: self._asked.update({kind: self._asked[kind] - 1}))
        return await asyncio.shield(asked)

    async def _end_threads(self, _: web.Application) -> None:
        for threads in self._threads.values():
            threads.shutdown(wait=False, cancel_futures=True)


async def _add_headers(_: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(_HEADERS)


async def _body(request: web.Request, model: type[Any]) -> Any:
    if request.content_type != "application/json":
        raise web.HTTPUnsupportedMediaType(text=f"the body is {request.content_type}, expected application/json")
    try:
        return model.model_validate_json(await request.read())
    except ValidationError as error:
        fault = OpenArmError(Code.INVALID_ARGUMENT, describe_faults(error, request.path, model))
        raise web.HTTPBadRequest(text=json.dumps(_failed(fault)), content_type="application/json") from error


def _failed(error: OpenArmError) -> dict[str, Any]:
    return {"success": False, "code": error.code, "message": error.message}
