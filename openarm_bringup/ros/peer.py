# SPDX-License-Identifier: Apache-2.0
"""A node for the length of one command: it inspects a graph, subscribes and asks, and waits with deadlines."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from itertools import count
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile
from tf2_msgs.msg import TFMessage

from openarm_bringup.messages import to_data
from openarm_bringup.suggest import unknown
from openarm_bringup.supervision import runs
from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.actions import ActionClient
from openarm_common.ros.client import ContextNode
from openarm_common.ros.convert import transform_to_matrix
from openarm_common.ros.node import QOS_STATIC_TF, QOS_TF, offered_qos

#: Discovery is complete after this long without a change, s, and at the latest after the second.
_QUIET_S = 0.6
_DISCOVERY_S = 8.0
#: Longest wait for a first node, where no supervisor of this machine has recorded a graph, s.
_FIRST_NODE_S = 4.0
#: Services that every node has.
_OF_ALL_NODES = ("rcl_interfaces/srv/", "type_description_interfaces/srv/")
_ANSWER_S = 5.0
_NUMBERS = count()


class Peer(ContextNode):
    """A hidden node; a context manager, in which the nodes that run are discovered.

    Args:
        context: Context from `new_context`, where many peers share what is discovered; without it one of its own.
        check: Called whenever it waits; what it raises is raised there.
        settled: True once what is discovered does not grow any more.

    Raises:
        OpenArmError: NOT_READY, on entering, when no node runs.
    """

    def __init__(
        self, context: Context | None = None, *, check: Callable[[], None] | None = None, settled: bool = False
    ) -> None:
        name = f"_openarm_cli_{os.getpid()}_{next(_NUMBERS)}"  # hidden, as those of ros2cli
        super().__init__(name, bare=True, context=context)
        self.node = self._node
        self._check, self._settled = check, settled

    def __enter__(self) -> Peer:
        try:
            self._discover()
        except BaseException:
            self.close()
            raise
        return self

    def _discover(self) -> None:
        began = changed = time.monotonic()
        before: Any = None
        domain = self._context.get_domain_id()
        there = {f"/{name}" for run in runs.running() if run.domain == domain for name in run.ready_nodes}
        while (now := time.monotonic()) - began < (_DISCOVERY_S if there else _FIRST_NODE_S):
            known = (self.nodes(), self.topics(), self.services())
            if known != before:
                before, changed = known, now
            quiet = self._settled or now - changed > _QUIET_S
            if quiet and known[0] and (there <= set(known[0]) or now - began > _DISCOVERY_S / 2):
                return
            self.spin_until(lambda: False, 0.05)
        if not self.nodes():
            reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
            raise OpenArmError(
                Code.NOT_READY,
                f"no node is discovered in domain {domain} (ROS_AUTOMATIC_DISCOVERY_RANGE={reach}); start a graph with "
                "`openarm up`, or set both as they are set where it runs (--domain N says the domain, too)",
            )

    def spin_until(self, condition: Callable[[], Any], seconds: float) -> bool:
        """Handle what arrives until a condition holds; return whether it did in time."""
        if self._check is None:
            return super().spin_until(condition, seconds)
        check = self._check
        return super().spin_until(lambda: check() or condition(), seconds)

    def nodes(self) -> list[str]:
        """Full names of the nodes, without hidden ones."""
        found = self.node.get_node_names_and_namespaces()
        return sorted({f"{space.rstrip('/')}/{name}" for name, space in found if not name.startswith("_")})

    def topics(self) -> dict[str, str]:
        """Type by topic, without those of actions."""
        return {name: kinds[0] for name, kinds in self.node.get_topic_names_and_types() if "/_action/" not in name}

    def services(self, *, all_: bool = True) -> dict[str, str]:
        """Type by service, without those of actions and of hidden nodes; `all_` includes those that every node has."""
        found = {name: kinds[0] for name, kinds in self.node.get_service_names_and_types()}
        names = [name for name in found if "/_action/" not in name and "/_openarm_" not in name]
        return {name: found[name] for name in names if all_ or not found[name].startswith(_OF_ALL_NODES)}

    def actions(self) -> dict[str, str]:
        """Type by action."""
        end = "/_action/feedback"
        return {
            name.removesuffix(end): kinds[0].removesuffix("_FeedbackMessage")
            for name, kinds in self.node.get_topic_names_and_types()
            if name.endswith(end)
        }

    def find(self, what: Literal["node", "topic", "service", "action"], name: str) -> tuple[str, str]:
        """Return the full name of something in the graph, and its type; the leading slash may be left out.

        Raises:
            OpenArmError: INVALID_ARGUMENT, with suggestions.
        """
        ask = {"topic": self.topics, "service": self.services, "action": self.actions}
        known = ask[what]() if what in ask else dict.fromkeys(self.nodes(), "")
        full = name if name.startswith("/") else f"/{name}"
        if full not in known:
            raise unknown(what, full, [other for other in known if not known[other].startswith(_OF_ALL_NODES)])
        return full, known[full]

    def offered(self, topic: str) -> QoSProfile:
        """The quality of service with which every publisher of a topic is received."""
        return offered_qos(self.node, topic, 100)

    def endpoints(self, topic: str, *, publish: bool) -> list[dict[str, str]]:
        """Node, reliability and durability of each publisher or subscriber of a topic, without hidden nodes."""
        ask = self.node.get_publishers_info_by_topic if publish else self.node.get_subscriptions_info_by_topic
        rows = [
            {
                "node": f"{info.node_namespace.rstrip('/')}/{info.node_name}",
                "reliability": info.qos_profile.reliability.name.lower(),
                "durability": info.qos_profile.durability.name.lower(),
            }
            for info in ask(topic)
            if not info.node_name.startswith("_")
        ]
        return sorted(rows, key=lambda row: row["node"])

    def action_client(self, kind: Any, name: str) -> ActionClient:
        """A client of an action whose server answers.

        Raises:
            OpenArmError: NOT_READY, when it does not.
        """
        client = ActionClient(self.node, kind, name)
        self.wait_for(client.server_is_ready, name)
        return client

    def wait_for(self, server_is_ready: Callable[[], bool], name: str) -> None:
        """Wait for the server of a client.

        Raises:
            OpenArmError: NOT_READY, when it does not answer.
        """
        if not self.spin_until(server_is_ready, _ANSWER_S):
            raise OpenArmError(Code.NOT_READY, f"{name} does not answer")

    def wait_delivered(self, publisher: Any) -> None:
        """Wait until reliable subscribers have what was published, or do not answer."""
        publisher.wait_for_all_acked(Duration(seconds=_ANSWER_S))

    def parameters(self, node: str) -> ParametersOf:
        """The parameters of a node.

        Raises:
            OpenArmError: INVALID_ARGUMENT for an unknown node, NOT_READY when it does not answer.
        """
        return ParametersOf(self, self.find("node", node)[0])

    def frames(self, seconds: float, enough: Callable[[Frames], object] = lambda _: False) -> Frames:
        """Return what is published on /tf and /tf_static within a time, s, or until it is enough."""
        frames = Frames()
        for topic, static, qos in (("/tf_static", True, QOS_STATIC_TF), ("/tf", False, QOS_TF)):

            def add(message: TFMessage, info: Mapping[str, Any], static: bool = static) -> None:
                frames.add(message, info["publication_sequence_number"], static)

            self.node.create_subscription(TFMessage, topic, add, qos)
        self.spin_until(lambda: enough(frames), seconds)
        return frames


class Frames:
    """The tree of frames as it is published.

    Attributes:
        edges: Parent, pose in it and whether it is fixed, of each frame.
        clashes: Fault of a frame that has more than one publisher or parent, by its name.
    """

    def __init__(self) -> None:
        self.edges: dict[str, tuple[str, NDArray[np.float64], bool]] = {}
        self.clashes: dict[str, str] = {}
        self._last: dict[str, int] = {}

    def names(self) -> set[str]:
        """Names of all frames."""
        return self.edges.keys() | {parent for parent, _, _ in self.edges.values()}

    def add(self, message: TFMessage, number: int, static: bool) -> None:
        """Add a message; `number` counts those of its publisher: with two publishers of a frame it goes back."""
        for edge in message.transforms:
            name, parent = edge.child_frame_id, edge.header.frame_id
            T = transform_to_matrix(edge.transform)
            if name in self.edges:
                before, T_before, was_static = self.edges[name]
                if before != parent:
                    self.clashes[name] = f"has the parents {before} and {parent}"
                elif was_static != static:
                    self.clashes[name] = "is published on /tf and on /tf_static"
                elif number <= self._last[name] and (not static or not np.array_equal(T, T_before)):
                    self.clashes[name] = f"has two publishers on {'/tf_static' if static else '/tf'}"
            self.edges[name] = (parent, T, static)
            self._last[name] = number

    def between(self, target: str, source: str) -> NDArray[np.float64] | None:
        """Return the pose (4, 4) of a frame in another one; None where no edges tie them."""
        to_root = {frame: self._in_root(frame) for frame in (target, source)}
        if to_root[target][0] != to_root[source][0]:
            return None
        return se3.inverse(to_root[target][1]) @ to_root[source][1]

    def _in_root(self, frame: str) -> tuple[str, NDArray[np.float64]]:
        """Return the frame above which there is none, and the pose in it."""
        named, T, seen = {name.lstrip("/"): edge for name, edge in self.edges.items()}, np.eye(4), set[str]()
        while frame in named and frame not in seen:
            seen.add(frame)
            parent, T_parent_frame, _ = named[frame]
            frame, T = parent.lstrip("/"), T_parent_frame @ T
        return frame, T


class ParametersOf:
    """The parameters of a node that runs.

    Args:
        peer: Node that asks.
        node: Full name.
    """

    def __init__(self, peer: Peer, node: str) -> None:
        self.node = node
        self._peer = peer
        self._client = AsyncParameterClient(peer.node, node)
        peer.wait_for(self._client.services_are_ready, f"the parameter service of {node}")
        self.names: list[str] = sorted(peer.result(self._client.list_parameters(), _ANSWER_S, node).result.names)

    def get(self, names: list[str]) -> dict[str, Any]:
        """Values by name.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for a name that the node does not have, with suggestions.
        """
        self._check(names)
        answer = self._peer.result(self._client.get_parameters(names), _ANSWER_S, self.node)
        values = (to_data(parameter_value_to_python(value)) for value in answer.values)
        return dict(zip(names, values, strict=True))

    def set(self, name: str, value: Any) -> tuple[bool, str]:
        """Set one; return whether the node accepted it, and why not.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for a name that the node does not have, with suggestions.
        """
        self._check([name])
        future = self._client.set_parameters([Parameter(name, value=value)])
        result = self._peer.result(future, _ANSWER_S, self.node).results[0]
        return result.successful, result.reason

    def _check(self, names: list[str]) -> None:
        for name in names:
            if name not in self.names:
                raise unknown(f"parameter of {self.node}", name, self.names)
