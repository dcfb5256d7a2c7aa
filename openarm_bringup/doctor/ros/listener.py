# SPDX-License-Identifier: Apache-2.0
"""Rates and diagnostics of a running graph, for `openarm node health` and `openarm doctor`."""

from __future__ import annotations

import time
from collections import Counter
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from openarm_bringup.commands.connect import graph_peer
from openarm_bringup.doctor.graph import RATES, GraphStatus
from openarm_bringup.messages import interface
from openarm_bringup.supervision import runs
from openarm_common.ros.node import QOS_COMMAND

#: Long enough for the rates, and for two rounds of /diagnostics where a node is silent in the first, s.
_RATES_S, _LISTEN_S = 1.2, 2.5


def listen(domain: int | None) -> GraphStatus:
    """Subscribe to a graph for a few seconds.

    Args:
        domain: ROS_DOMAIN_ID; None: of the only one.

    Raises:
        OpenArmError: NOT_READY, when no node is discovered.
    """
    counts, first = Counter[str](), dict[str, float]()
    diagnostics: dict[str, tuple[bool, str]] = {}

    def note(message: DiagnosticArray) -> None:
        for status in message.status:
            good = status.level in (DiagnosticStatus.OK, DiagnosticStatus.STALE)  # stale: nothing reported yet
            diagnostics[status.name.partition(":")[0]] = (good, status.message)

    with graph_peer(domain) as peer:
        names = [name for name, _ in peer.node.get_node_names_and_namespaces() if not name.startswith("_")]
        for topic, kind in peer.topics().items():
            if topic in RATES:
                count: Any = partial(_count, counts, first, topic)
                peer.node.create_subscription(interface(kind), topic, count, peer.offered(topic), raw=True)
        peer.node.create_subscription(DiagnosticArray, "/diagnostics", note, QOS_COMMAND)
        enough, expected = time.monotonic() + _RATES_S, _ready(peer.node.context.get_domain_id())
        peer.spin_until(lambda: time.monotonic() > enough and expected <= diagnostics.keys(), _LISTEN_S)
        now = time.monotonic()
    # From the first one on: until then the publisher did not know of this subscriber.
    rates = {topic: (n - 1) / (now - first[topic]) for topic, n in counts.items()}
    return GraphStatus(rates, diagnostics, names)


def _ready(domain: int) -> set[str]:
    """Return the nodes that the supervisor of this machine knows to be ready."""
    return {name for run in runs.running() if run.domain == domain for name in run.ready_nodes}


def _count(counts: Counter[str], first: dict[str, float], topic: str, _: bytes) -> None:
    first.setdefault(topic, time.monotonic())
    counts[topic] += 1
