# SPDX-License-Identifier: Apache-2.0
"""A graph that runs for as long as a piece of work takes, with signals and what is shown of it."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from openarm_bringup.supervision import environment
from openarm_bringup.supervision.graph import Graph
from openarm_bringup.supervision.keeper import Probe
from openarm_bringup.supervision.supervisor import Event, Supervisor

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@asynccontextmanager
async def running_graph(
    graph: Graph, run_dir: Path, listener: Callable[[Event], None] | None = None
) -> AsyncIterator[Supervisor]:
    """Start a graph; at the end of the block, or at Ctrl-C, stop it.

    Yields the supervisor while the nodes are still starting: `await supervisor.wait_ready()`.
    """
    ros = environment.ros_environment(graph)

    def make_probe() -> Probe:
        from openarm_bringup.supervision.ros.readiness import ReadinessClient

        return ReadinessClient(ros)

    supervisor = Supervisor(graph, run_dir, make_probe, listener=listener)
    loop = asyncio.get_running_loop()
    for number in SIGNALS:
        loop.add_signal_handler(number, supervisor.ask_stop)
    try:
        await supervisor.start()
        yield supervisor
    finally:
        try:
            await supervisor.stop()
        finally:
            for number in SIGNALS:
                loop.remove_signal_handler(number)


def in_thread(work: Callable[[], None], name: str) -> asyncio.Future[None]:
    """Run in a daemon thread of that name: an abandoned wait inside it can't keep the process from ending."""
    loop = asyncio.get_running_loop()
    future: asyncio.Future[None] = loop.create_future()

    def tell(error: BaseException | None) -> None:
        if not future.done():
            future.set_result(None) if error is None else future.set_exception(error)

    def run() -> None:
        error: BaseException | None = None
        try:
            work()
        except BaseException as caught:  # handed to whoever awaits
            error = caught
        if not loop.is_closed():
            loop.call_soon_threadsafe(tell, error)

    threading.Thread(target=run, name=name, daemon=True).start()
    return future
