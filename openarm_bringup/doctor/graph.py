# SPDX-License-Identifier: Apache-2.0
"""Checks of a graph that runs: its nodes as the supervisor sees them, what they say of themselves, and their rates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from openarm_bringup.doctor.checks import Finding

if TYPE_CHECKING:
    from openarm_bringup.supervision.runs import RunRecord

#: Topics that come at a steady rate whenever their node runs: Hz, and which node they are of.
RATES: Mapping[str, tuple[float, str]] = {
    "/joint_states": (100.0, "mujoco_bridge"),
    "/clock": (100.0, "mujoco_bridge"),
    "/tf": (50.0, "mujoco_bridge"),
}
#: Less than this share of the rate is an error, less than the second a note.
_LATE, _SLOW = 0.5, 0.9


@dataclass(frozen=True)
class Heard:
    """What was heard of a graph.

    Args:
        rates: Hz by topic, of those of RATES that have a publisher.
        said: By node: whether it says on /diagnostics that all is well, and what it says.
        nodes: Names of all nodes that were met, one entry a participant.
    """

    rates: Mapping[str, float]
    said: Mapping[str, tuple[bool, str]]
    nodes: Sequence[str]


def check_nodes(run: RunRecord) -> list[Finding]:
    """Judge each node by its state: given up, on its way, or often restarted."""
    findings: list[Finding] = []
    for name, node in run.nodes.items():
        where = f"node {name}"
        look = f"`openarm logs {name}` tells why"
        if node.state == "ready" and not node.restarts:
            continue
        if node.state == "ready":
            findings.append(Finding(where, "note", f"ready, after {node.restarts} restarts", look))
        elif node.state in ("failed", "stopped", "exited"):
            advice = f"{look}; Ctrl-C and `openarm up {run.graph}` start it again"
            findings.append(Finding(where, "error", node.state, advice))
        else:
            findings.append(Finding(where, "note", node.state, f"wait, or look: {look}"))
    if not findings:
        findings.append(
            Finding("nodes", "ok", f"all {len(run.nodes)} nodes of {run.graph} are ready, none was restarted")
        )
    return findings


def check_heard(run: RunRecord, heard: Heard) -> list[Finding]:
    """Judge what the graph of a run says of itself."""
    if not heard.nodes:
        advice = (
            "a firewall, or a container without --network=host, keeps processes apart; see `openarm logs supervisor`"
        )
        return [Finding("graph", "error", f"no node of {run.graph} is met in domain {run.domain}", advice)]
    return [*_rates(run, heard), *_diagnostics(run, heard), *_clash(run, heard)]


def _rates(run: RunRecord, heard: Heard) -> list[Finding]:
    findings: list[Finding] = []
    for topic, (rate, node) in RATES.items():
        if node not in run.nodes or run.nodes[node].state != "ready":
            continue
        got = heard.rates.get(topic, 0.0)
        seen = f"{got:.0f} Hz of {rate:.0f}"
        if got >= _SLOW * rate:
            findings.append(Finding(topic, "ok", seen))
        else:
            level = "error" if got < _LATE * rate else "note"
            advice = "the machine is too busy for real time (`openarm ps` shows by what), or simulated time is held"
            findings.append(Finding(topic, level, seen, advice))
    return findings


def _diagnostics(run: RunRecord, heard: Heard) -> list[Finding]:
    ready = run.ready_nodes
    findings = [
        Finding(f"node {name}", "error", f"says: {heard.said[name][1]}", f"`openarm logs {name}` tells more")
        for name in ready
        if name in heard.said and not heard.said[name][0]
    ]
    silent = [name for name in ready if name not in heard.said]
    for name in silent:
        advice = f"it hangs or starves: `openarm ps`, `openarm logs {name}`"
        findings.append(Finding(f"node {name}", "note", "says nothing on /diagnostics", advice))
    if not findings:
        findings.append(Finding("diagnostics", "ok", f"{len(ready)} nodes say that all is well"))
    return findings


def _clash(run: RunRecord, heard: Heard) -> list[Finding]:
    """Two graphs in one domain: nodes with the same name, which no graph has."""
    # One that was killed and started again is met twice until the others have forgotten it.
    own = {name for name, node in run.nodes.items() if not node.restarts}
    twice = sorted(name for name, count in Counter(heard.nodes).items() if count > 1 and name in own)
    if not twice:
        return [Finding("domain clash", "ok", f"no node is twice in domain {run.domain}")]
    advice = "another graph is in the same domain: stop it, or start one with --domain"
    return [Finding("domain clash", "error", f"more than one of {', '.join(twice)} in domain {run.domain}", advice)]
