# SPDX-License-Identifier: Apache-2.0
"""`openarm view`: a web page that shows the graph, with a button for a grasp."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from openarm_bringup.commands.connect import Domain, join_graph
from openarm_bringup.outcome import Outcome, console
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_bringup.view.server import ViewServer


def view(
    *,
    port: int = 8088,
    host: str = "127.0.0.1",
    open_: Annotated[bool, Parameter(name="--open")] = False,
    domain: Domain = None,
) -> Outcome:
    """Serve a page that shows the graph and requests grasps, until Ctrl-C.

    The printed address holds a token, new each time: whoever has it can move the robot.

    Args:
        port: TCP port; 0 takes any that is free.
        host: Address to listen on. Beyond this machine the token is sent unencrypted; prefer `ssh -L`.
        open_: Open the page in a browser.
    """
    import asyncio

    join_graph(domain)
    address = asyncio.run(_serve(host, port, open_))
    return Outcome(True, f"the page at {address} is closed")


async def _serve(host: str, port: int, show: bool) -> str:
    import asyncio
    import webbrowser

    from openarm_bringup.view.gate import listening

    loop = asyncio.get_running_loop()
    stop: asyncio.Future[None] = loop.create_future()

    def end(error: BaseException | None = None) -> None:
        if not stop.done():
            stop.set_result(None) if error is None else stop.set_exception(error)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, end)
    with make_server(host, end) as server, TemporaryDirectory(prefix="openarm_view_") as folder:  # of this user alone
        try:
            async with listening(server.app(), host, port) as taken:
                address = f"http://{f'[{host}]' if ':' in host else host}:{taken}/"
                url = f"{address}#{server.guard.token}"
                console().print(f"the page is at {url}", markup=False, soft_wrap=True)
                if show:
                    webbrowser.open(redirect(Path(folder), url).as_uri())
                await stop
        except OSError as error:
            text = f"can't listen on {host}:{port}: {error.strerror}; choose another with --port or --host"
            raise OpenArmError(Code.ENVIRONMENT, text) from error
    return address


def redirect(folder: Path, url: str) -> Path:
    """Write a page that leads to an address: the command line of a browser can be read by all users, a file can't."""
    page = folder / "open.html"
    page.touch(mode=0o600)
    page.write_text(f'<!doctype html><meta http-equiv="refresh" content="0;url={url}">', encoding="utf-8")
    return page


@contextmanager
def make_server(host: str, on_end: Callable[[BaseException], None]) -> Iterator[ViewServer]:
    """Make the server of the page and the thread that observes the graph; within a running asyncio loop.

    Args:
        host: Address that the server will listen on.
        on_end: Called in the loop with what ended the thread too early.
    """
    import asyncio

    from openarm_bringup.view.guard import Guard
    from openarm_bringup.view.ros.page import GraphView
    from openarm_bringup.view.server import ViewServer
    from openarm_bringup.view.wire import robot_meshes, robot_shapes
    from openarm_common.camera.cameras import spectator_camera
    from openarm_grasp.requests.states import State

    loop = asyncio.get_running_loop()
    graph = GraphView(
        lambda item: loop.call_soon_threadsafe(server.put, item),
        lambda error: loop.call_soon_threadsafe(on_end, error),
    )
    hello = {
        "robot": robot_shapes(graph.description),
        "cameras": [camera.name for camera in graph.cameras],
        "for_people": spectator_camera(),
        "arms": graph.description.arm_names,
        "states": [state.value for state in State],
    }
    server = ViewServer(Guard(host), hello, graph, robot_meshes(graph.description))
    with graph:
        yield server
