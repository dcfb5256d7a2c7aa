# SPDX-License-Identifier: Apache-2.0
"""Graphs of nodes, their supervision, the command line, bags and visualisation.

Example:
    >>> import asyncio
    >>> from openarm_bringup import load_graph, new_run_dir, running_graph
    >>> async def start() -> None:
    ...     graph = load_graph("sim", overrides={"seed": 3}, sets=["grasp.velocity_scale=0.3"])
    ...     async with running_graph(graph, new_run_dir()) as supervisor:
    ...         print(f"ready after {await supervisor.wait_ready():.1f} s")
    >>> asyncio.run(start())  # doctest: +SKIP

`Graph.config` gives the configuration of a node of a graph to code that runs the node's core in process. The command
line is `openarm_bringup.cli`.
"""

from typing import TYPE_CHECKING

from openarm_common.lazy import attach

if TYPE_CHECKING:
    from openarm_bringup.bags.bag import Bag, BagWriter, open_bag
    from openarm_bringup.outcome import Outcome
    from openarm_bringup.supervision.graph import Graph, load_graph
    from openarm_bringup.supervision.runs import RunRecord, new_run_dir, running
    from openarm_bringup.supervision.session import running_graph
    from openarm_bringup.supervision.supervisor import Supervisor

__all__ = [
    "Bag",
    "BagWriter",
    "Graph",
    "Outcome",
    "RunRecord",
    "Supervisor",
    "load_graph",
    "new_run_dir",
    "open_bag",
    "running",
    "running_graph",
]

__getattr__, __dir__ = attach(__name__, __file__)
