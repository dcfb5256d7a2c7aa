# SPDX-License-Identifier: Apache-2.0
"""`openarm graph`: check and draw graphs, without starting anything."""

from __future__ import annotations

from typing import Literal

from cyclopts import App

from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code

graph = App(name="graph", help="Check and draw graphs; `openarm graph list` names them.")


@graph.command(name="list")
def list_() -> Outcome:
    """Name the graphs that come with the suite."""
    from openarm_bringup.supervision.graph import graph_names, load_graph

    graphs = {name: load_graph(name).description for name in graph_names()}
    return Outcome(
        True, data={"graphs": graphs}, text="\n".join(f"{name:<14}{about}" for name, about in graphs.items())
    )


@graph.command
def check(graph: str = "sim") -> Outcome:
    """Check a graph file: keys, names, needs, parameter files, modules, shared memory. List what it runs.

    A graph file runs any program as the user who starts it: those that are none of the suite's are named.

    Args:
        graph: Name of a graph, or a file.
    """
    from openarm_bringup.supervision.environment import domain_id
    from openarm_bringup.supervision.graph import load_graph
    from openarm_bringup.supervision.shm import shm_free_mib, shm_need_mib

    loaded = load_graph(graph)
    missing = {name: spec.module for name, spec in loaded.nodes.items() if spec.module and not _exists(spec.module)}
    need, free = shm_need_mib(loaded, extra_participants=4), shm_free_mib()
    foreign = [name for name, spec in loaded.nodes.items() if spec.foreign]
    data = {
        "graph": loaded.name,
        "nodes": list(loaded.nodes),
        "levels": loaded.levels(),
        "domain": domain_id(loaded),
        "shm_need_mib": need,
        "shm_free_mib": round(free, 1),
        "programs": {name: spec.program for name, spec in loaded.nodes.items()},
        "foreign": foreign,
    }
    width = max(map(len, loaded.nodes))
    lines = [f"{name:<{width}}  {spec.program}" for name, spec in loaded.nodes.items()]
    text = "\n".join(line.encode("unicode_escape").decode() for line in lines)  # a line of the table each
    if missing:
        name, module = next(iter(missing.items()))
        message = f"node {name}: there is no module {module}; is the package that holds it installed?"
        return Outcome(False, message, Code.CONFIG_INVALID, data, text)
    message = f"{loaded.name}: {len(loaded.nodes)} nodes, {need:.0f} MiB of /dev/shm ({free:.0f} free): valid"
    if foreign:
        message += f"; not of the suite: {', '.join(foreign)}. Start it only if you trust these programs"
    return Outcome(True, message, data=data, text=text)


@graph.command
def draw(graph: str = "sim", *, form: Literal["text", "mermaid"] = "text") -> Outcome:
    """Draw a graph: nodes in the order of their start, or a Mermaid flowchart for a README.

    Args:
        graph: Name of a graph, or a file.
        form: text or mermaid.
    """
    from openarm_bringup.supervision.draw import edges, mermaid, text
    from openarm_bringup.supervision.graph import load_graph

    loaded = load_graph(graph)
    drawing = mermaid(loaded) if form == "mermaid" else text(loaded)
    return Outcome(True, data={"graph": loaded.name, "drawing": drawing, "edges": edges(loaded)}, text=drawing)


def _exists(module: str) -> bool:
    import importlib.util

    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # the parent package
        return False
