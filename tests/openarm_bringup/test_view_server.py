# SPDX-License-Identifier: Apache-2.0
"""Who may open the page, listen to it and move the robot with it; what it is sent; when the graph is looked at."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hashlib
import inspect
import json
import re
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

import aiohttp
import pytest

from openarm_bringup.view import gate
from openarm_bringup.view.gate import listening
from openarm_bringup.view.guard import Guard
from openarm_bringup.view.server import PAGE, Confirmation, Item, Order, Reset, ViewServer
from openarm_common.errors import Code, OpenArmError
from tests.conftest import DEADLINE_S


@dataclass
class Graph:
    """Notes what is asked of it."""

    layers: tuple[str, ...] = ("states", "robot", "image:overhead")
    wanted: frozenset[str] = frozenset()
    asked: list[Any] = field(default_factory=list)
    go_on: threading.Event = field(default_factory=threading.Event)

    def want(self, layers: frozenset[str]) -> None:
        self.wanted = layers

    def pick(self, order: Order) -> dict[str, Any]:
        self.asked.append(order)
        self.go_on.wait(60.0)
        return {"success": True, "code": "OK", "message": "placed"}

    def confirm(self, answer: Confirmation) -> tuple[bool, str]:
        self.asked.append(answer)
        return answer.accept, f"plan {answer.plan_id!r}"

    def cancel(self) -> tuple[bool, str]:
        self.asked.append("cancel")
        return False, "no grasp runs"

    def stop(self) -> tuple[bool, str]:
        self.asked.append("stop")
        return True, "the arms hold"

    def release(self) -> tuple[bool, str]:
        self.asked.append("release")
        return True, "released"

    def reset(self, order: Reset) -> tuple[bool, str]:
        self.asked.append(order)
        raise OpenArmError(Code.NOT_READY, "no service /sim/reset_world")


class Bench:
    """A server that listens, and a browser's way of asking it."""

    def __init__(self, server: ViewServer, graph: Graph, session: aiohttp.ClientSession, port: int) -> None:
        self.server, self.graph, self.session = server, graph, session
        self.url, self.token = f"http://127.0.0.1:{port}", server.guard.token
        self.origin = {"Origin": self.url}

    async def get(self, path: str, **headers: str) -> tuple[int, str]:
        async with self.session.get(self.url + path, headers=headers) as response:
            return response.status, await response.text()

    async def post(self, path: str, body: Any, *, token: str | None = None, **headers: str) -> tuple[int, Any]:
        known = {"Authorization": f"Bearer {self.token if token is None else token}", **self.origin, **headers}
        known = {name: value for name, value in known.items() if value}
        async with self.session.post(self.url + path, data=json.dumps(body), headers=json_body(known)) as response:
            text = await response.text()
            return response.status, json.loads(text) if text.startswith("{") else text

    def socket(self, *, token: str | None = None, **headers: str) -> Any:
        path = f"{self.url}/socket?token={self.token if token is None else token}"
        return self.session.ws_connect(path, headers={**self.origin, **headers})


def json_body(headers: dict[str, str]) -> dict[str, str]:
    return {"Content-Type": "application/json", **headers}


@asynccontextmanager
async def serving(host: str = "127.0.0.1") -> AsyncIterator[Bench]:
    graph = Graph()
    server = ViewServer(Guard(host), {"robot": {}, "cameras": [], "states": []}, graph)
    async with listening(server.app(), "127.0.0.1", 0, 0.2) as port, aiohttp.ClientSession() as session:
        try:
            yield Bench(server, graph, session, port)
        finally:
            graph.go_on.set()


def with_bench(test: Callable[..., Awaitable[None]]) -> Callable[..., None]:
    """Make a test of a coroutine whose first argument is a bench."""

    def run(**given: Any) -> None:
        async def main() -> None:
            async with serving() as bench:
                await asyncio.wait_for(test(bench, **given), 120.0)

        asyncio.run(main())

    signature = inspect.signature(test)
    functools.update_wrapper(run, test)
    del run.__wrapped__  # whose first argument is no fixture
    run.__signature__ = signature.replace(parameters=list(signature.parameters.values())[1:])  # type: ignore[attr-defined]
    return run


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(DEADLINE_S):
        while not condition():
            await asyncio.sleep(0.01)


# --- who may
WRONG = {
    "no token": ({"token": ""}, "no token; open the whole address that was printed"),
    "wrong token": ({"token": "x" * 32}, "wrong token"),
    "foreign origin": ({"Origin": "https://evil.example"}, "the page 'https://evil.example' may not ask"),
    "another port of this machine": ({"Origin": "http://127.0.0.1:1"}, "may not ask"),
    "hidden origin": ({"Origin": "null"}, "may not ask"),
    "no origin": ({"Origin": ""}, "may not ask"),
    "rebound name": ({"Host": "evil.example:8088", "Origin": "http://evil.example:8088"}, "was called 'evil.example'"),
    "rebound name with a dot": (
        {"Host": "localhost.evil.example", "Origin": "http://localhost.evil.example"},
        "called",
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
@with_bench
async def test_who_may_not_gets_403_and_nothing_is_asked_of_the_robot(bench: Bench, wrong: str) -> None:
    headers, why = WRONG[wrong]
    for path, body in (("/pick", {"label": "red"}), ("/cancel", {}), ("/reset", {})):
        status, answer = await bench.post(path, body, **headers)
        assert (status, answer["success"]) == (403, False)
        assert why in answer["message"]
    with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
        async with bench.socket(**headers):
            pass
    assert refused.value.status == 403
    assert bench.graph.asked == []
    assert bench.graph.wanted == frozenset()


@with_bench
async def test_the_page_itself_has_one_of_our_names_and_shows_nothing_without_the_token(bench: Bench) -> None:
    """The token comes after the # of the address, which no server gets."""
    for name in ("localhost:8088", "[::1]:8088"):
        status, text = await bench.get("/", Host=name)
        assert (status, bench.token in text) == (200, False)
    for name in ("evil.example", "192.168.1.2:8088", "127.0.0.1.evil.example", "[::1", "@127.0.0.1"):
        status, text = await bench.get("/", Host=name)
        assert status == 403, name
        assert "answers to" in text
    for path in ("/socket", f"/socket?token={bench.token[:-1]}", f"/socket?other={bench.token}"):
        assert (await bench.get(path, **bench.origin))[0] == 403
    async with bench.session.post(f"{bench.url}/stop?token={bench.token}", headers=bench.origin) as response:
        assert response.status == 403  # an address that is kept somewhere moves nothing


@with_bench
async def test_only_json_can_ask(bench: Bench) -> None:
    """A form of another page can't send that type without asking first."""
    status, _ = await bench.post("/pick", {"label": "red"}, **{"Content-Type": "text/plain"})
    assert status == 415
    assert bench.graph.asked == []


def test_beyond_this_machine_addresses_are_known_by_number_and_by_the_name_given() -> None:
    guard = Guard("robot.lan")
    for host in ("robot.lan:8088", "10.0.0.7:8088", "localhost"):
        guard.check_host(host)
    for host in ("evil.example", "", None, "robot.lan.evil.example"):
        with pytest.raises(OpenArmError, match="answers to"):
            guard.check_host(host)


def test_a_page_of_others_may_speak_when_it_was_named() -> None:
    guard = Guard(origins=("https://app.example.org",))
    guard.check_origin("https://app.example.org", "127.0.0.1:1")
    with pytest.raises(OpenArmError, match="may not ask"):
        guard.check_origin("https://app.example.org.evil.example", "127.0.0.1:1")


def test_a_token_is_new_each_time_and_never_short() -> None:
    assert Guard().token != Guard().token
    assert len(Guard().token) >= 32
    with pytest.raises(OpenArmError, match="at least 16"):
        Guard(token="secret")


@with_bench
async def test_every_answer_forbids_scripts_of_others(bench: Bench) -> None:
    for path in ("/", "/view.js", "/nothing", "/socket"):
        async with bench.session.get(bench.url + path) as response:
            policy = response.headers["Content-Security-Policy"]
            assert "default-src 'none'" in policy
            assert "script-src 'self'" in policy
            assert "unsafe" not in policy
            assert response.headers["X-Content-Type-Options"] == "nosniff"


def test_labels_can_only_become_text() -> None:
    """Data of the graph reaches the page through textContent and attributes; nothing makes markup or code of it."""
    scripts = [path.read_text(encoding="utf-8") for path in PAGE.glob("*.js")]
    assert len(scripts) == 3
    for text in scripts:
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|new Function", text)
    page = (PAGE / "index.html").read_text(encoding="utf-8")
    assert not re.search(r"<script(?![^>]*\bsrc=)|\son\w+=|\sstyle=|https?://", page)


def test_vendored_files_are_those_that_are_named() -> None:
    """What came unchanged from the package has the checksum listed next to it."""
    said = (PAGE / "vendor" / "README.md").read_text(encoding="utf-8")
    for name in ("three.module.min.js", "three.core.min.js"):
        data = (PAGE / "vendor" / name).read_bytes()
        assert re.search(rf"`build/{name}` \(sha256\s+{hashlib.sha256(data).hexdigest()}\)", said), name
    assert "MIT" in (PAGE / "vendor" / "LICENSE").read_text(encoding="utf-8")


# --- what is shown
@with_bench
async def test_a_page_gets_what_it_wants_and_the_graph_is_looked_at_only_while_it_does(bench: Bench) -> None:
    async with bench.socket() as socket:
        assert (await socket.receive_json())["kind"] == "hello"
        await until(lambda: bench.graph.wanted == {"states"})
        await socket.send_json({"want": ["robot"]})
        await until(lambda: bench.graph.wanted == {"states", "robot"})
        bench.server.put(Item("image:overhead", "image:overhead", b"not wanted"))
        bench.server.put(Item("robot", "robot", b"wanted"))
        assert await socket.receive_bytes() == b"wanted"
        await socket.send_json({"want": []})
        await until(lambda: bench.graph.wanted == {"states"})
    await until(lambda: bench.graph.wanted == frozenset())


@with_bench
async def test_a_page_that_comes_later_gets_the_newest_of_each(bench: Bench) -> None:
    for text in ("old", "new"):
        bench.server.put(Item("states", "grasp", text))
    async with bench.socket() as socket:
        await socket.receive_json()
        assert await socket.receive_str() == "new"


@pytest.mark.parametrize("message", ['{"want": ["everything"]}', '{"want": 3}', "}{"])
@with_bench
async def test_a_page_that_sends_nonsense_is_answered_and_closed(bench: Bench, message: str) -> None:
    async with bench.socket() as socket:
        await socket.receive_json()
        await socket.send_str(message)
        closing = await socket.receive()
        assert closing.type is aiohttp.WSMsgType.CLOSE
        assert closing.data == aiohttp.WSCloseCode.POLICY_VIOLATION
        assert closing.extra


# --- what is asked
@with_bench
async def test_a_pick_is_asked_once_at_a_time_and_its_outcome_is_shown(bench: Bench) -> None:
    status, answer = await bench.post("/pick", {"label": "red", "arm": "left", "dry_run": True})
    assert (status, answer["success"]) == (202, True)
    await until(lambda: bench.graph.asked)
    assert bench.graph.asked == [Order(label="red", arm="left", dry_run=True)]
    status, answer = await bench.post("/pick", {"label": "blue"})
    assert (status, answer["code"]) == (409, "BUSY")
    bench.graph.go_on.set()
    async with bench.socket() as socket:
        async with asyncio.timeout(DEADLINE_S):
            while (message := await socket.receive_json()).get("running", True):
                pass
        assert message == {"kind": "outcome", "running": False, "success": True, "code": "OK", "message": "placed"}


@pytest.mark.parametrize(
    ("path", "body", "why"),
    [
        ("/pick", {"label": "red", "arm": "third"}, "arm"),
        ("/pick", {"label": "x" * 65}, "label"),
        ("/pick", {"speed": 9}, "speed"),
        ("/pick", {"confirm": "perhaps"}, "confirm"),
        ("/confirm", {"plan_id": "4adc"}, "accept"),
        ("/confirm", {"plan_id": "x" * 65, "accept": True}, "plan_id"),
        ("/reset", {"scene": "../../etc/passwd"}, "scene"),
        ("/reset", {"seed": -1}, "seed"),
    ],
)
@with_bench
async def test_a_wrong_request_is_refused_by_the_name_of_what_is_wrong(
    bench: Bench, path: str, body: dict[str, Any], why: str
) -> None:
    status, answer = await bench.post(path, body)
    assert (status, answer["code"]) == (400, "INVALID_ARGUMENT")
    assert f"{path}:{why}" in answer["message"]
    assert bench.graph.asked == []


@pytest.mark.requirement("P-20", "R-25")
@with_bench
async def test_the_plan_that_waits_is_confirmed_or_rejected_from_the_page(bench: Bench) -> None:
    await bench.post("/pick", {"label": "red", "confirm": True})
    await until(lambda: bench.graph.asked)
    status, answer = await bench.post("/confirm", {"plan_id": "4adc", "accept": True})
    assert (status, answer) == (200, {"success": True, "code": "OK", "message": "plan '4adc'"})
    assert not (await bench.post("/confirm", {"plan_id": "4adc", "accept": False}))[1]["success"]
    assert (await bench.post("/confirm", {"plan_id": "4adc", "accept": True}, token="no"))[0] == 403
    answers = [Confirmation(plan_id="4adc", accept=accept) for accept in (True, False)]
    assert bench.graph.asked == [Order(label="red", confirm=True), *answers]


@with_bench
async def test_what_the_graph_refuses_is_said(bench: Bench) -> None:
    assert await bench.post("/cancel", {}) == (200, {"success": False, "code": "REFUSED", "message": "no grasp runs"})
    assert (await bench.post("/reset", {"scene": "demo"}))[1]["code"] == "NOT_READY"


@with_bench
async def test_files_outside_of_the_page_are_not_there(bench: Bench) -> None:
    wrong = ("/../server.py", "/%2e%2e/server.py", "/page/../server.py", "/vendor/../../server.py")
    for path in (*wrong, "/vendor", "/vendor/", "/index.html", "/nothing"):
        assert (await bench.get(path))[0] == 404, path
    for path in ("/view.js", "/vendor/three.module.min.js"):
        assert (await bench.get(path))[0] == 200, path


MALFORMED: dict[str, bytes] = {
    "bad JSON": b"}{",
    "bad UTF-8": b'{"label": "\xff\xfe", "scene": "\xff", "plan_id": "\xff"}',
    "a lone surrogate": rb'{"label": "\ud800", "scene": "\ud800", "plan_id": "\ud800"}',
    "deep": b"[" * 2000 + b"]" * 2000,
    "a list": b"[]",
    "null": b"null",
    "wrong types": b'{"label": 3, "arm": {}, "scene": [], "seed": "x", "plan_id": 1, "accept": "perhaps"}',
    "seed of 2^63": b'{"seed": 9223372036854775808}',
    "seed of many digits": b'{"seed": ' + b"9" * 3000 + b"}",
    "seed NaN": b'{"seed": NaN}',
    "unknown key": b'{"speed": 9}',
    "long text": b'{"label": "' + b"x" * 3000 + b'", "scene": "' + b"x" * 900 + b'"}',
    "oversized": b'{"label": "' + b"x" * 100_000 + b'"}',
}


@with_bench
async def test_no_malformed_request_keeps_others_from_their_answer(bench: Bench) -> None:
    known = json_body({"Authorization": f"Bearer {bench.token}", **bench.origin})
    for path in ("/pick", "/confirm", "/reset"):
        for name, body in MALFORMED.items():
            async with bench.session.post(bench.url + path, data=body, headers=known) as response:
                text = await response.text()
                assert 400 <= response.status < 500, (path, name, response.status, text)
                assert "Traceback" not in text
    assert bench.graph.asked == []
    for path, status in (("/cancel", 200), ("/stop", 200), ("/release", 200), ("/reset", 200), ("/pick", 202)):
        assert (await bench.post(path, {}))[0] == status, path


@with_bench
async def test_requests_that_wait_hold_up_neither_cancel_nor_stop(bench: Bench) -> None:
    bench.graph.reset = lambda order: (bench.graph.go_on.wait(60.0), "late")  # type: ignore[method-assign]
    waiting = [asyncio.create_task(bench.post("/reset", {})) for _ in range(40)]
    await until(lambda: sum(task.done() for task in waiting) == 38)
    assert {task.result()[0] for task in waiting if task.done()} == {409}
    assert (await bench.post("/cancel", {}))[1]["message"] == "no grasp runs"
    assert (await bench.post("/stop", {}))[1]["message"] == "the arms hold"
    bench.graph.go_on.set()
    assert sorted([(await task)[0] for task in waiting])[:2] == [200, 200]


# --- what is no request
HEAD = b"POST /stop HTTP/1.1\r\nHost: localhost\r\n"
#: What is sent, and the statuses that fit; the connection ends in each case.
NO_HTTP = {
    "no request line": (b"\x00\xff\x16\x03\x01 nonsense\r\n\r\n", (400,)),
    "unknown method": (b"BREW / HTTP/1.1\r\nHost: localhost\r\n\r\n", (400, 403, 405)),
    "another version": (b"GET / HTTP/9.9\r\nHost: localhost\r\n\r\n", (400, 505)),
    "negative length": (HEAD + b"Content-Length: -1\r\n\r\n", (400,)),
    "length in words": (HEAD + b"Content-Length: many\r\n\r\n", (400,)),
    "huge length": (HEAD + b"Content-Length: 99999999999999999999\r\n\r\n", (400, 403, 413)),
    "two lengths": (HEAD + b"Content-Length: 1\r\nContent-Length: 2\r\n\r\n12", (400,)),
    "chunks that are none": (HEAD + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n", (400, 403)),
    "NUL in a header": (b"GET / HTTP/1.1\r\nHost: local\x00host\r\n\r\n", (400, 403)),
    "header of a megabyte": (b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 2**20 + b"\r\n\r\n", (400, 431)),
    "no host": (b"GET / HTTP/1.1\r\n\r\n", (400, 403)),
}


@pytest.mark.parametrize("case", NO_HTTP)
def test_what_is_no_request_is_answered_without_a_traceback(case: str, caplog: pytest.LogCaptureFixture) -> None:
    sent, statuses = NO_HTTP[case]

    async def test(bench: Bench) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", int(bench.url.rpartition(":")[2]))
        writer.write(sent)
        with contextlib.suppress(ConnectionError):
            await writer.drain()
            answer = await reader.read()
            assert int(answer.split()[1]) in statuses, answer[:200]
        writer.close()
        assert (await bench.post("/cancel", {}))[0] == 200
        assert bench.graph.asked == ["cancel"]

    with_bench(test)()
    assert [record.getMessage() for record in caplog.records if record.exc_info] == []


@with_bench
async def test_connections_that_ask_nothing_keep_no_one_out(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """More than are taken, some silent, some in the middle of a head; a page asks meanwhile, and they are closed."""
    monkeypatch.setattr(gate, "HEAD_S", 1.0)
    port = int(bench.url.rpartition(":")[2])
    idle = [await asyncio.open_connection("127.0.0.1", port) for _ in range(2 * gate.MOST)]
    for _, writer in idle[::2]:
        writer.write(b"GET / HTTP/1.1\r\nHost: local")
    assert (await bench.post("/stop", {}))[0] == 200
    async with bench.socket() as socket:
        assert json.loads((await socket.receive()).data)["kind"] == "hello"
        async with asyncio.timeout(DEADLINE_S):
            for reader, writer in idle:
                with contextlib.suppress(ConnectionError):
                    while await reader.read(4096):
                        pass
                writer.close()
        assert not socket.closed
