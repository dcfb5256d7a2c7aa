# SPDX-License-Identifier: Apache-2.0
"""A graph that runs for as long as a piece of work takes, and is stopped by signals."""

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
from openarm_common.errors import Code, OpenArmError

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@asynccontextmanager
async def running_graph(
    graph: Graph, run_dir: Path, listener: Callable[[Event], None] | None = None, *, ends: bool = False
) -> AsyncIterator[Supervisor]:
    """Start a graph; at the end of the block, or at Ctrl-C, stop it.

    Clients that are made in this process once it is ready meet the graph: its domain and discovery are set in the
    environment.

    Args:
        graph: Graph to run.
        run_dir: Folder for logs and parameters.
        listener: Is called with every change of a node.
        ends: After the block this process ends, as `Supervisor.stop` says.

    Yields:
        The supervisor, while the nodes are still starting: `await supervisor.wait_ready()`.
    """
    ros = {**environment.ros_environment(graph), environment.PROFILE: environment.profile_of(graph)}

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
            await supervisor.stop(ends=ends)
        finally:
            for number in SIGNALS:
                loop.remove_signal_handler(number)


async def work_until_stopped(
    supervisor: Supervisor, work: Callable[[], None], cancel: Callable[[], object], grace: float = 10.0
) -> None:
    """Do blocking work in a thread while a graph runs; when the graph is to stop, cancel the work.

    Args:
        supervisor: Supervisor of the graph, which is ready.
        work: Runs in a daemon thread: an abandoned wait inside it can't keep the process from ending.
        cancel: Asks the work to end.
        grace: Longest wait for that, s.

    Raises:
        OpenArmError: Whatever the work raises; CANCELLED, at Ctrl-C; why a node was given up that the graph needs.
    """
    job = _in_thread(work)
    stopping = asyncio.create_task(supervisor.wait_stop_asked())
    try:
        await asyncio.wait([job, stopping], return_when=asyncio.FIRST_COMPLETED)
        if not job.done():
            cancel()
            await asyncio.wait([job], timeout=grace)
            stopping.result()
            raise OpenArmError(Code.CANCELLED, "stopped by Ctrl-C")
        job.result()
    finally:
        stopping.cancel()


def _in_thread(work: Callable[[], None]) -> asyncio.Future[None]:
    """Run in a daemon thread: an abandoned wait inside it can't keep the process from ending."""
    loop = asyncio.get_running_loop()
    future: asyncio.Future[None] = loop.create_future()

    def finish(error: BaseException | None) -> None:
        if not future.done():
            future.set_result(None) if error is None else future.set_exception(error)

    def run() -> None:
        error: BaseException | None = None
        try:
            work()
        except BaseException as caught:  # raised where it is awaited
            error = caught
        if not loop.is_closed():
            loop.call_soon_threadsafe(finish, error)

    threading.Thread(target=run, name="work", daemon=True).start()
    return future
