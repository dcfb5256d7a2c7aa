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
    from openarm_bringup.bags.bag import Bag as Bag
    from openarm_bringup.bags.bag import BagWriter as BagWriter
    from openarm_bringup.bags.bag import open_bag as open_bag
    from openarm_bringup.outcome import Outcome as Outcome
    from openarm_bringup.supervision.graph import Graph as Graph
    from openarm_bringup.supervision.graph import load_graph as load_graph
    from openarm_bringup.supervision.runs import RunRecord as RunRecord
    from openarm_bringup.supervision.runs import new_run_dir as new_run_dir
    from openarm_bringup.supervision.runs import running as running
    from openarm_bringup.supervision.session import running_graph as running_graph
    from openarm_bringup.supervision.supervisor import Supervisor as Supervisor

__getattr__, __dir__ = attach(__name__, __file__)
