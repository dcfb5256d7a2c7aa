# SPDX-License-Identifier: Apache-2.0
"""Servers that show that they live, and clients that notice within a lease when they do not.

The status topic of an action, and the topic `~/_alive` of a node for its services, are offered with automatic
liveliness: the middleware asserts it from a thread of its own, so a process that computes is alive, and one that was
killed or stopped is not. A client whose server offers no liveliness (another vendor's) works as with rclpy's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from action_msgs.msg import GoalStatusArray
from rclpy import action
from rclpy.duration import Duration
from rclpy.event_handler import QoSLivelinessChangedInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile

from openarm_common.errors import Code, OpenArmError


@dataclass(frozen=True)
class Lease:
    """How fast the death of a publisher is noticed.

    Attributes:
        offered: s; Fast DDS asserts liveliness every two thirds of it.
        accepted: s without an assertion after which the publisher counts as gone.
    """

    offered: float
    accepted: float

    def offer(self, profile: QoSProfile) -> QoSProfile:
        """Let publishers with this profile show that they live."""
        return _automatic(profile, self.offered)

    def watch(self, profile: QoSProfile) -> QoSProfile:
        """Let subscriptions with this profile notice when they do not."""
        return _automatic(profile, self.accepted)


#: Of servers, and owners of goals: six assertions have to be missing, so that a loaded machine raises no alarm.
LEASE = Lease(0.3, 1.3)


def _automatic(profile: QoSProfile, seconds: float) -> QoSProfile:
    profile.liveliness = LivelinessPolicy.AUTOMATIC
    profile.liveliness_lease_duration = Duration(seconds=seconds)
    return profile


def latest() -> QoSProfile:
    """Return the profile of a status that late subscribers receive; rcl_action's, and that of owners."""
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def owner_topic(action_name: str) -> str:
    """Return the topic on which the client of a trajectory controller publishes the id of the goal that it sends."""
    return f"{action_name.rpartition('/')[0]}/owner"


def alive_topic(node_name: str) -> str:
    """Return the hidden topic on which nothing is published: that its publisher is alive shows that the node is.

    Args:
        node_name: Fully qualified.
    """
    return f"{node_name}/_alive"


class Watch:
    """Notices when the publisher of a topic dies, which discovery says up to 20 s later.

    Args:
        node: Owner.
        kind: Type of the topic.
        topic: Offered by `LEASE`.
        what: Names its publisher where its node is not known.
    """

    def __init__(self, node: Node, kind: Any, topic: str, what: str) -> None:
        self._node, self._topic, self._what = node, topic, what
        #: Publishers that live, and deaths so far.
        self.alive = self.deaths = 0
        self._who = ""
        events = SubscriptionEventCallbacks(liveliness=self._on_liveliness, use_default_callbacks=False)
        self._subscription = node.create_subscription(
            kind, topic, lambda _: None, LEASE.watch(latest()), event_callbacks=events
        )

    def destroy(self) -> None:
        """End it."""
        self._node.destroy_subscription(self._subscription)

    def begin(self) -> Callable[[], str]:
        """Return a function that says who has died since this call: the node's name; "" while it lives."""
        self._look()
        before = self.deaths
        return lambda: (self._who or self._what) if self.deaths != before else ""

    def _on_liveliness(self, event: QoSLivelinessChangedInfo) -> None:
        self._look()
        if event.alive_count < self.alive:
            self.deaths += 1
        self.alive = event.alive_count

    def _look(self) -> None:
        """Keep the name of the node: the graph may have lost it when it is asked for."""
        for info in self._node.get_publishers_info_by_topic(self._topic):
            if not info.node_name.startswith("_"):
                self._who = f"the node {info.node_name}"


class ActionServer(action.ActionServer):
    """An action server whose clients notice its death; arguments as `rclpy.action.ActionServer`."""

    def __init__(self, node: Node, kind: Any, name: str, execute: Callable[..., Any], **kwargs: Any) -> None:
        status = LEASE.offer(latest())
        super().__init__(node, kind, name, execute, status_pub_qos_profile=status, **kwargs)


class ActionClient(action.ActionClient):
    """An action client that knows when its server has died.

    Args:
        node: Owner.
        kind: Type of the action.
        name: Of the action.
    """

    def __init__(self, node: Node, kind: Any, name: str) -> None:
        super().__init__(node, kind, name)
        self.name = name
        topic = f"{node.resolve_topic_name(name)}/_action/status"
        self._watch = Watch(node, GoalStatusArray, topic, f"the server of {name}")

    def destroy(self) -> None:
        """Take the client down."""
        self._watch.destroy()
        super().destroy()

    def server_is_ready(self) -> bool:
        """Whether a server is in the graph that is not known to be dead."""
        return bool(super().server_is_ready()) and (self._watch.alive > 0 or self._watch.deaths == 0)

    def watch(self) -> Callable[[], str]:
        """Return a function that says who has died since this call: the node's name; "" while its server lives."""
        return self._watch.begin()


def check_alive(died: Callable[[], str], what: str, code: Code = Code.NOT_READY) -> None:
    """Raise when a server has died.

    Args:
        died: Of `ActionClient.watch`.
        what: Was asked of it.
        code: Of the error.

    Raises:
        OpenArmError: Naming the node.
    """
    if who := died():
        raise OpenArmError(code, f"{what}: {who} is gone; ask again when it is back (openarm ps)")
