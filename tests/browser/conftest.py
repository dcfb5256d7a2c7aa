# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium that is driven over the DevTools protocol."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import os
import shutil
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

_NAMES = ("chromium", "chromium-browser", "google-chrome-stable", "google-chrome", "chrome")
#: Software rendering, nothing from the net, nothing of the user's.
_FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--disable-default-apps", "--disable-extensions", "--no-first-run", "--mute-audio"),
    *("--hide-scrollbars", "--remote-debugging-port=0"),
)


class Tab:
    """A page of the browser."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self._answers: dict[int, asyncio.Future[Any]] = {}
        #: What the page said on its console or threw.
        self.complaints: list[str] = []
        self._reader = asyncio.create_task(self._read())

    async def _read(self) -> None:
        async for message in self._socket:
            data = message.json()
            if "id" in data:
                self._answers.pop(data["id"]).set_result(data)
            elif data["method"] == "Runtime.exceptionThrown":
                details = data["params"]["exceptionDetails"]
                self.complaints.append(details.get("exception", {}).get("description") or details["text"])
            elif data["method"] == "Log.entryAdded" and data["params"]["entry"]["level"] == "error":
                self.complaints.append(data["params"]["entry"]["text"])

    async def do(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol."""
        number = 1 + max(self._answers, default=0)
        answer = self._answers[number] = asyncio.get_running_loop().create_future()
        await self._socket.send_json({"id": number, "method": method, "params": params})
        data = await asyncio.wait_for(answer, 20.0)
        assert "error" not in data, f"{method}: {data['error']['message']}"
        return data["result"]

    async def js(self, expression: str) -> Any:
        """Value of an expression in the page."""
        result = await self.do("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    async def until(self, expression: str, seconds: float = 20.0) -> Any:
        """Wait until an expression is true; fail, with what the page shows, when it does not get so."""
        give_up = asyncio.get_running_loop().time() + seconds
        while not (value := await self.js(expression)):
            if asyncio.get_running_loop().time() > give_up:
                text = await self.js("document.body?.innerText")
                pytest.fail(f"not within {seconds:g} s: {expression}; complaints {self.complaints}; page: {text}")
            await asyncio.sleep(0.05)
        return value

    async def box(self, selector: str) -> dict[str, float]:
        """Where an element is in the window, which is scrolled there."""
        element = f"document.querySelector({selector!r})"
        return await self.js(f"({element}.scrollIntoViewIfNeeded(), {element}.getBoundingClientRect().toJSON())")

    async def click(self, selector: str, *, count: int = 1) -> None:
        """Click the middle of an element, as a mouse does; twice for a double click."""
        x, y = await self._middle(selector)
        for number in range(1, count + 1):
            for kind in ("mousePressed", "mouseReleased"):
                await self.do("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=number)

    async def drag(self, selector: str, right: float, down: float) -> None:
        """Press the left button in the middle of an element, move by so many pixels, and release it."""
        x, y = await self._middle(selector)
        for kind, share in (("mousePressed", 0.0), ("mouseMoved", 0.5), ("mouseMoved", 1.0), ("mouseReleased", 1.0)):
            where = {"x": x + share * right, "y": y + share * down}
            await self.do(
                "Input.dispatchMouseEvent", type=kind, **where, button="left", buttons=int(share < 1.0), clickCount=1
            )

    async def _middle(self, selector: str) -> tuple[float, float]:
        box = await self.box(selector)
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    async def picture(self, path: Path) -> None:
        """Save what the page looks like."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(await self._png())

    async def image(self, selector: str) -> NDArray[np.uint8]:
        """What an element looks like, with what lies on it: (h, w, 3), BGR."""
        box = await self.box(selector)
        clip = {key: box[key] for key in ("x", "y", "width", "height")} | {"scale": 1}
        return cv2.imdecode(np.frombuffer(await self._png(clip=clip), np.uint8), cv2.IMREAD_COLOR)

    async def _png(self, **more: Any) -> bytes:
        return base64.b64decode((await self.do("Page.captureScreenshot", format="png", **more))["data"])

    async def size(self, width: int, height: int, dark: bool = False) -> None:
        """Give the window a size, and the taste of its user."""
        await self.do(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        await self.do("Emulation.setEmulatedMedia", features=[scheme])


OpenTab = Callable[[str], AbstractAsyncContextManager[Tab]]


def find_chromium() -> str | None:
    """The browser of this machine, or $CHROMIUM."""
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, _NAMES)), None)


@asynccontextmanager
async def browser_tab(program: str, profile: Path, url: str) -> AsyncIterator[Tab]:
    """A browser of its own with one page; all of it ends with the block."""
    profile.mkdir(parents=True)
    command = [program, *_FLAGS, f"--user-data-dir={profile}", "about:blank"]
    quiet = asyncio.subprocess.DEVNULL
    process = await asyncio.create_subprocess_exec(*command, stdout=quiet, stderr=quiet, start_new_session=True)
    try:
        port = profile / "DevToolsActivePort"
        async with asyncio.timeout(30.0):
            while not (port.is_file() and port.read_text().count("\n")):
                assert process.returncode is None, f"{program} ended with {process.returncode}"
                await asyncio.sleep(0.05)
        address = f"http://127.0.0.1:{port.read_text().split()[0]}"
        async with aiohttp.ClientSession() as session:
            async with session.get(f"{address}/json/list") as answer:
                target = next(one for one in await answer.json() if one["type"] == "page")
            async with session.ws_connect(target["webSocketDebuggerUrl"], max_msg_size=0) as socket:
                tab = Tab(socket)
                for domain in ("Page", "Runtime", "Log"):
                    await tab.do(f"{domain}.enable")
                await tab.size(1440, 900)
                await tab.do("Page.navigate", url=url)
                await tab.until("document.readyState === 'complete' && location.href !== 'about:blank'")
                yield tab
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        await process.wait()


@pytest.fixture
def open_tab(tmp_path: Path) -> OpenTab:
    """Opens an address in a browser; skips where there is none."""
    program = find_chromium()
    if program is None:
        pytest.skip("no Chromium on this machine: install chromium, or set CHROMIUM to one")
    return lambda url: browser_tab(program, tmp_path / "profile", url)
