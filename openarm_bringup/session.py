# SPDX-License-Identifier: Apache-2.0
"""A graph that runs for as long as a piece of work takes, with signals and what is shown of it."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from openarm_bringup import environment
from openarm_bringup.graph import Graph
from openarm_bringup.keeper import Probe
from openarm_bringup.supervisor import Event, Supervisor

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
        from openarm_bringup.readiness_client import ReadinessClient

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
