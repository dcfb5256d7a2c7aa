# SPDX-License-Identifier: Apache-2.0
"""Rates and diagnostics of a running graph, for `openarm doctor`."""

from __future__ import annotations

import os
import time
from collections import Counter
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from openarm_bringup.doctor.graph import RATES, GraphStatus
from openarm_bringup.messages import interface
from openarm_bringup.ros.peer import Peer
from openarm_bringup.supervision.discovery import variables
from openarm_bringup.supervision.runs import RunRecord
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import QOS_COMMAND

#: Long enough for the rates, and for two rounds of /diagnostics where a node is silent in the first, s.
_RATES_S, _LISTEN_S = 1.2, 2.5


def listen(run: RunRecord) -> GraphStatus:
    """Subscribe to the graph of a run for a few seconds."""
    try:
        return _listen(run)
    except OpenArmError as error:
        if error.code != Code.NOT_READY:
            raise
        return GraphStatus({}, {}, [])  # no node is discovered: a finding, not a failure of this command


def _listen(run: RunRecord) -> GraphStatus:
    os.environ.update(variables(run.domain, run.discovery))
    counts, first = Counter[str](), dict[str, float]()
    diagnostics: dict[str, tuple[bool, str]] = {}

    def note(message: DiagnosticArray) -> None:
        for status in message.status:
            good = status.level in (DiagnosticStatus.OK, DiagnosticStatus.STALE)  # stale: nothing reported yet
            diagnostics[status.name.partition(":")[0]] = (good, status.message)

    with Peer() as peer:
        names = [name for name, _ in peer.node.get_node_names_and_namespaces() if not name.startswith("_")]
        for topic, kind in peer.topics().items():
            if topic in RATES:
                count: Any = partial(_count, counts, first, topic)
                peer.node.create_subscription(interface(kind), topic, count, peer.offered(topic), raw=True)
        peer.node.create_subscription(DiagnosticArray, "/diagnostics", note, QOS_COMMAND)
        enough, expected = time.monotonic() + _RATES_S, set(run.ready_nodes)
        peer.spin_until(lambda: time.monotonic() > enough and expected <= diagnostics.keys(), _LISTEN_S)
        now = time.monotonic()
    # From the first one on: until then the publisher did not know of this subscriber.
    rates = {topic: (n - 1) / (now - first[topic]) for topic, n in counts.items()}
    return GraphStatus(rates, diagnostics, names)


def _count(counts: Counter[str], first: dict[str, float], topic: str, _: bytes) -> None:
    first.setdefault(topic, time.monotonic())
    counts[topic] += 1
