# SPDX-License-Identifier: Apache-2.0
"""Drawings of a graph: Mermaid for a README, plain text for a terminal."""

from __future__ import annotations

from openarm_bringup.supervision.graph import Graph


def edges(graph: Graph) -> list[tuple[str, str, tuple[str, ...]]]:
    """Return (giver, taker, names) for every pair of nodes that meet over something offered and used."""
    found: list[tuple[str, str, tuple[str, ...]]] = []
    for giver, offer in graph.nodes.items():
        for taker, use in graph.nodes.items():
            shared = tuple(name for name in offer.offers if name in use.uses)
            if shared and giver != taker:
                found.append((giver, taker, shared))
    return found


def mermaid(graph: Graph) -> str:
    """Return the data flow as a Mermaid flowchart."""
    lines = ["flowchart LR"]
    lines += [f'  {name}["{name}"]' for name in graph.nodes]
    lines += [f'  {giver} -- "{"<br/>".join(names)}" --> {taker}' for giver, taker, names in edges(graph)]
    return "\n".join(lines)


def text(graph: Graph) -> str:
    """Return the nodes in the order of their start, with what each offers and which nodes use it."""
    width = max(map(len, graph.nodes))
    lines = [f"{graph.name}: {graph.description}".rstrip(": ")]
    for name in (name for level in graph.levels() for name in level):
        spec = graph.nodes[name]
        lines.append(f"  {name:<{width}}  {spec.module or ' '.join(spec.command)}")
        if spec.needs:
            lines.append(f"      after {', '.join(spec.needs)}")
        for offer in spec.offers:
            takers = [taker for taker, use in graph.nodes.items() if offer in use.uses and taker != name]
            lines.append(f"      {offer}" + (f" → {', '.join(takers)}" if takers else ""))
    return "\n".join(lines)
