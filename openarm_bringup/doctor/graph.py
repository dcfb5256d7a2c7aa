# SPDX-License-Identifier: Apache-2.0
"""Checks of a running graph: state of its nodes, their diagnostics and rates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from openarm_bringup.doctor.checks import Finding, error, note, ok
from openarm_bringup.supervision.runs import RECORDINGS, recordings

if TYPE_CHECKING:
    from openarm_bringup.supervision.runs import RunRecord

#: Topics that are published at a steady rate whenever their node runs: Hz, and the node.
RATES: Mapping[str, tuple[float, str]] = {
    "/joint_states": (100.0, "mujoco_bridge"),
    "/clock": (100.0, "mujoco_bridge"),
    "/tf": (50.0, "mujoco_bridge"),
}
#: Less than this share of the rate is an error, less than the second a note.
_LATE, _SLOW = 0.5, 0.9


@dataclass(frozen=True)
class GraphStatus:
    """What was received from a graph.

    Args:
        rates: Hz by topic, of those of RATES that have a publisher.
        diagnostics: Report on /diagnostics by node: whether it is OK, and its message.
        nodes: Names of all discovered nodes, one entry a participant.
    """

    rates: Mapping[str, float]
    diagnostics: Mapping[str, tuple[bool, str]]
    nodes: Sequence[str]


def check_nodes(run: RunRecord) -> list[Finding]:
    """Check the state of each node: given up, starting, or often restarted."""
    findings: list[Finding] = []
    for name, node in run.nodes.items():
        where = f"node {name}"
        look = f"`openarm logs {name}` shows why"
        if node.state == "ready" and not node.restarts:
            continue
        if node.state == "ready":
            findings.append(note(where, f"ready, after {node.restarts} restarts", look))
        elif node.state in ("failed", "stopped", "exited"):
            advice = f"{look}; Ctrl-C and `openarm up {run.graph}` start it again"
            findings.append(error(where, node.state, advice))
        else:
            findings.append(note(where, node.state, f"wait; {look}"))
    if not findings:
        findings.append(ok("nodes", f"all {len(run.nodes)} nodes of {run.graph} are ready, none was restarted"))
    return findings


def check_status(run: RunRecord, status: GraphStatus) -> list[Finding]:
    """Check rates, diagnostics and names of the nodes of a run."""
    if not status.nodes:
        advice = (
            "a firewall, or a container without --network=host, keeps processes apart; see `openarm logs supervisor`"
        )
        return [error("graph", f"no node of {run.graph} is discovered in domain {run.domain}", advice)]
    return [*_rates(run, status), *_diagnostics(run, status), *_clash(run, status)]


def check_recordings(run_dir: Path) -> Finding:
    """List the flight recordings of a run: what failed requests have left."""
    found = recordings(run_dir / RECORDINGS)
    if not found:
        return ok("recordings", f"{run_dir.name}: no request has failed")
    names = ", ".join(path.name for path in found)
    return note("recordings", f"{run_dir.name}: {names}", f"`openarm check {found[-1]}` shows the newest")


def _rates(run: RunRecord, status: GraphStatus) -> list[Finding]:
    findings: list[Finding] = []
    for topic, (rate, node) in RATES.items():
        if node not in run.nodes or run.nodes[node].state != "ready":
            continue
        got = status.rates.get(topic, 0.0)
        observed = f"{got:.0f} Hz of {rate:.0f}"
        if got >= _SLOW * rate:
            findings.append(ok(topic, observed))
        else:
            level = "error" if got < _LATE * rate else "note"
            advice = "the machine is too busy for real time (`openarm ps` shows by what), or simulated time is held"
            findings.append(Finding(topic, level, observed, advice))
    return findings


def _diagnostics(run: RunRecord, status: GraphStatus) -> list[Finding]:
    ready = run.ready_nodes
    findings = [
        error(f"node {name}", f"reports: {status.diagnostics[name][1]}", f"`openarm logs {name}` shows more")
        for name in ready
        if name in status.diagnostics and not status.diagnostics[name][0]
    ]
    silent = [name for name in ready if name not in status.diagnostics]
    for name in silent:
        advice = f"it hangs or starves: `openarm ps`, `openarm logs {name}`"
        findings.append(note(f"node {name}", "is silent on /diagnostics", advice))
    if not findings:
        findings.append(ok("diagnostics", f"{len(ready)} nodes report OK"))
    return findings


def _clash(run: RunRecord, status: GraphStatus) -> list[Finding]:
    """Find two graphs in one domain, by nodes with the same name."""
    # A restarted node is discovered twice until the lease of the killed process ends.
    own = {name for name, node in run.nodes.items() if not node.restarts}
    twice = sorted(name for name, count in Counter(status.nodes).items() if count > 1 and name in own)
    if not twice:
        return [ok("domain clash", f"no node is twice in domain {run.domain}")]
    advice = "another graph is in the same domain: stop it, or start one with --domain"
    return [error("domain clash", f"more than one of {', '.join(twice)} in domain {run.domain}", advice)]
