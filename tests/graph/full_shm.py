# SPDX-License-Identifier: Apache-2.0
"""Run by test_small_shm in a mount namespace of its own: octomap dies while /dev/shm is full, and there is room later.

Prints one line of JSON: the states of octomap since it was killed, the nodes that were not ready all the time, and
what the running graph said of itself at the end.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from openarm_bringup.supervision import runs
from openarm_bringup.supervision.graph import Restart, load_graph
from openarm_bringup.supervision.keeper import NodeState
from openarm_bringup.supervision.session import running_graph
from openarm_common.domain import reserve_domain

FILLER = Path("/dev/shm/filler")
LIMIT_S = 90.0


def fill() -> None:
    """Leave no room in /dev/shm, which is of this namespace alone."""
    with FILLER.open("wb", buffering=0) as file:
        try:
            while file.write(bytes(2**16)):
                pass
        except OSError:
            return


async def main() -> None:
    graph = load_graph("map", overrides={"domain": reserve_domain()})
    impatient = graph.node("octomap").model_copy(update={"restart": Restart(backoff=0.2, max=1, retry=2.0)})
    graph = graph.model_copy(update={"nodes": {**graph.nodes, "octomap": impatient}})
    states: list[str] = []
    others: set[str] = set()
    with tempfile.TemporaryDirectory() as folder:
        async with running_graph(graph, Path(folder)) as supervisor:

            async def until(done: Callable[[], bool]) -> None:
                end = time.monotonic() + LIMIT_S
                while not done():
                    if time.monotonic() > end:
                        raise SystemExit(f"not within {LIMIT_S:g} s: {states}, {supervisor.states()}")
                    await asyncio.sleep(0.05)
                    now = {name: state.value for name, state in supervisor.states().items()}
                    if states[-1:] != [now["octomap"]]:
                        states.append(now["octomap"])
                    others.update(name for name, state in now.items() if name != "octomap" and state != "ready")

            await supervisor.wait_ready()
            fill()
            os.kill(supervisor.pid("octomap"), signal.SIGKILL)
            await until(lambda: NodeState.FAILED.value in states)
            FILLER.unlink()
            await until(lambda: states[-1] == NodeState.READY.value)
            (record,) = [record for record in runs.running() if record.domain == graph.domain]
    sys.stdout.write(json.dumps({"states": states, "others": sorted(others), "health": record.health}) + "\n")


if __name__ == "__main__":
    asyncio.run(main())
