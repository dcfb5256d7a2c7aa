# SPDX-License-Identifier: Apache-2.0
"""Asks the ROS graph whether a node is ready: one probe node for the whole supervisor.

A killed process stays in the discovery data of the others until its lease ends, so endpoints are told apart by their
identifiers: those that were there before a (re)start do not count.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import ListParameters
from rclpy.client import Client
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from openarm_bringup.messages import interface
from openarm_bringup.supervision.graph import Ready
from openarm_common.ros.actions import ServerWatch
from openarm_common.ros.client import ContextNode
from openarm_common.ros.node import reliable
from openarm_common.ros.polled import Polled, Source

#: Time that a service gets to answer before it is asked again, s.
_ASK_AGAIN_S = 2.0


class _Listing:
    """A question for the parameters of a node, of which nothing waits for the answer."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self._answer: Any = None
        self._asked = 0.0

    def names(self) -> frozenset[str] | None:
        """Return the names when they have come; until then, see that the question is put."""
        if self._answer is not None and self._answer.done():
            return frozenset(self._answer.result().result.names)
        # A response is lost when the server has not matched the client's reader yet; then it is asked again.
        if self.client.service_is_ready() and time.monotonic() - self._asked > _ASK_AGAIN_S:
            self._answer, self._asked = self.client.call_async(ListParameters.Request()), time.monotonic()
        return None


class ReadinessClient(ContextNode):
    """The probe of a supervisor. Not for use from two threads at once.

    Args:
        environ: ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE of the graph.
    """

    def __init__(self, environ: Mapping[str, str]) -> None:
        os.environ.update(environ)  # rmw reads the discovery range from the process environment
        super().__init__(f"openarm_probe_{os.getpid()}", domain=int(environ["ROS_DOMAIN_ID"]))
        self._waiting: dict[str, Subscription] = {}
        self._received: set[str] = set()
        self._watches: dict[str, ServerWatch] = {}
        self._listing: dict[str, _Listing] = {}
        self._diagnostics = Polled(self._node, Source(DiagnosticArray, "/diagnostics", reliable(100)))
        self._troubles: dict[str, str] = {}
        self._stop = self._node.create_client(Trigger, "/stop")

    def known(self, conditions: Sequence[Ready]) -> frozenset[str]:
        """Return the endpoints that fulfil the conditions now; call it before a process is started."""
        for condition in conditions:
            self._received.discard(condition.name)
            self._end_waiting(condition.name)
        return frozenset(gid for condition in conditions for gid in self._endpoints(condition))

    def unmet(self, conditions: Sequence[Ready], old: frozenset[str]) -> tuple[str, ...]:
        """Return the conditions that do not hold yet, not counting endpoints in `old`."""
        self._spin()
        return tuple(str(condition) for condition in conditions if not self._met(condition, old))

    def silence(self, node: str) -> float:
        """Return for how long a node whose process lives has shown no sign of life, s."""
        if node not in self._watches:
            self._watches[node] = ServerWatch(self._node, "", node, f"/{node}")
        return self._watches[node].silence

    def trouble(self, node: str) -> str:
        """Return what a node last said on /diagnostics if it was a warning or an error; else empty."""
        for message in self._diagnostics.take():
            for status in message.status:
                bad = status.level not in (DiagnosticStatus.OK, DiagnosticStatus.STALE)
                self._troubles[status.name.partition(":")[0]] = status.message if bad else ""
        return self._troubles.get(node, "")

    def parameters(self, node: str) -> frozenset[str] | None:
        """Return the names of a node's parameters; None as long as it has not answered: call it again then."""
        if node not in self._listing:
            self._listing[node] = _Listing(self._node.create_client(ListParameters, f"/{node}/list_parameters"))
        self._spin()
        listing = self._listing[node]
        if (names := listing.names()) is not None:
            self._node.destroy_client(listing.client)
            del self._listing[node]
        return names

    def emergency_stop(self, seconds: float) -> str:
        """Let the joints hold; return the answer of who commands them, or why there is none within so long."""
        if not self.spin_until(self._stop.service_is_ready, seconds):
            return "no node offers /stop"
        answer = self._stop.call_async(Trigger.Request())
        if not self.spin_until(answer.done, seconds):
            return f"/stop did not answer within {seconds:g} s"
        return str(answer.result().message)

    def _spin(self) -> None:
        for _ in range(4):
            self._executor.spin_once(timeout_sec=0.0)

    def _met(self, condition: Ready, old: frozenset[str]) -> bool:
        if condition.kind == "message":
            return self._has_message(condition.name, old)
        return bool(self._endpoints(condition) - old)

    def _endpoints(self, condition: Ready) -> set[str]:
        name = condition.name
        if condition.kind in ("topic", "message"):
            infos = self._node.get_publishers_info_by_topic(name)
        else:
            # rclpy lists no endpoints of services; their request topics are ordinary topics below.
            service = name if condition.kind == "service" else f"{name}/_action/send_goal"
            infos = self._node.get_subscriptions_info_by_topic(f"rq{service}Request", no_mangle=True)
        return {bytes(info.endpoint_gid).hex() for info in infos}

    def _has_message(self, topic: str, old: frozenset[str]) -> bool:
        if topic in self._received:
            return True
        if topic not in self._waiting:
            infos = self._node.get_publishers_info_by_topic(topic)
            new = next((info for info in infos if bytes(info.endpoint_gid).hex() not in old), None)
            if new is not None:
                kind, profile = interface(new.topic_type), _like(new.qos_profile)
                self._waiting[topic] = self._node.create_subscription(
                    kind, topic, lambda _: self._receive(topic), profile, raw=True
                )
        return False

    def _receive(self, topic: str) -> None:
        self._received.add(topic)
        self._end_waiting(topic)

    def _end_waiting(self, topic: str) -> None:
        if topic in self._waiting:
            self._node.destroy_subscription(self._waiting.pop(topic))


def _like(offered: QoSProfile) -> QoSProfile:
    """Return a profile that the publisher can serve, with its latched message if it keeps one."""
    return QoSProfile(depth=1, reliability=offered.reliability, durability=offered.durability)
