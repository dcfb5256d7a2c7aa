# SPDX-License-Identifier: Apache-2.0
"""What a node needs to take part in a lock-step: its clock is simulated time, and it counts what it sends.

Outside a lock-step (the parameter `lockstep` is false) all of this is an ordinary `rclpy` node.
"""
# Neither action class of rclpy says when it sends; the methods that do are its own.
# pyright: reportPrivateUsage=false

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from copy import copy
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.action import ActionClient, ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.client import Client
from rclpy.clock import Clock, ClockType, ROSClock
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.time import Time
from rclpy.waitable import Waitable

TICK_TOPIC, ACK_TOPIC = "/sim/tick", "/sim/ack"
#: Not counted: the topics of the lock-step itself, and what does not change while it runs.
UNCOUNTED = frozenset({TICK_TOPIC, ACK_TOPIC, "/tf_static"})
#: Each participant answers each tick once.
QOS_TICK = QoSProfile(depth=100)
#: Reliable topics keep at least so many messages: all that can come between two ticks.
_DEPTH = 20

#: What goes to the server of an action, and what comes from it.
ACTION_REQUESTS = {"goal": "goal_request", "cancel": "cancel_request", "result": "result_request"}
ACTION_ANSWERS = {
    "goal": "goal_response",
    "cancel": "cancel_response",
    "result": "result_response",
    "feedback": "feedback",
}


class NamedActionServer(ActionServer):
    """An action server that knows its name, so that a lock-step can count what it sends."""

    def __init__(self, node: Node, action_type: Any, action_name: str, *args: Any, **kwargs: Any) -> None:
        self.action_name = action_name
        super().__init__(node, action_type, action_name, *args, **kwargs)


class Books:
    """What a node in lock-step has sent, and the channel of each thing that it receives with."""

    def __init__(self) -> None:
        self.sent: Counter[str] = Counter()
        self.latched: set[str] = set()
        self._channels: dict[int, str] = {}
        self._parked: list[Subscription] = []

    def enter(self, entity: object, channel: str) -> None:
        """Say which channel a subscription, service, client or action receives from (or begins the name of)."""
        self._channels[id(entity)] = channel

    def channel(self, entity: object) -> str | None:
        """The channel of an entity; None when it is handled whenever something comes."""
        return self._channels.get(id(entity))

    def park(self, subscription: Subscription) -> None:
        """Let a subscription receive, but call nobody."""
        self._parked.append(subscription)

    def parked(self, subscription: Subscription) -> bool:
        """Whether it is parked."""
        return any(subscription is item for item in self._parked)

    def unpark(self, kind: type, topic: str) -> Subscription | None:
        """Take a parked subscription of a topic back, if there is one."""
        for i, subscription in enumerate(self._parked):
            if subscription.msg_type is kind and subscription.topic_name == topic:
                return self._parked.pop(i)
        return None

    def count(self, fn: Callable[..., Any], channel: str) -> Callable[..., Any]:
        """Wrap a function that sends one message on a channel."""
        self.sent.setdefault(channel, 0)

        def counted(*args: Any, **kwargs: Any) -> Any:
            result = fn(*args, **kwargs)
            self.sent[channel] += 1
            return result

        return counted

    def count_coroutine(self, fn: Callable[..., Any], channel: str) -> Callable[..., Any]:
        """Wrap a coroutine function that sends one message on a channel."""
        self.sent.setdefault(channel, 0)

        async def counted(*args: Any) -> Any:
            result = await fn(*args)
            self.sent[channel] += 1
            return result

        return counted


class LockstepNode(Node):
    """A node that can take part in a lock-step.

    In one, a subscription that is destroyed goes on receiving unheard, and one that is made again for the same topic is
    that one: when the first message comes then does not depend on how fast the two sides find each other. Make what is
    needed now and then once in the constructor.

    Args:
        name: Node name.
        kwargs: Passed to `rclpy.node.Node`.
    """

    books: Books | None = None

    def __init__(self, name: str, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        taking_part = ParameterDescriptor(
            description="whether the node takes part in a lock-step: simulated time waits for it", read_only=True
        )
        if self.declare_parameter("lockstep", False, taking_part).value:
            self.books = Books()
        #: Never stands still, whatever time is simulated.
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        #: Of deadlines and of what is done at a steady pace: the wall clock; in lock-step, simulated time.
        self.wall_clock = self.steady_clock if self.books is None else ROSClock()
        self._stamp_ns = self._passed_ns = 0
        if self.books is not None:
            for clock in (self.wall_clock, self.get_clock()):
                with clock.handle:
                    clock.handle.set_ros_time_override_is_enabled(True)

    @property
    def lockstep(self) -> bool:
        """Whether the node takes part in a lock-step."""
        return self.books is not None

    def monotonic(self) -> float:
        """Seconds on `wall_clock`; for deadlines."""
        return time.monotonic() if self.books is None else self._passed_ns * 1e-9

    def lockstep_missing(self) -> str:
        """What the node needs besides its channels before it can begin; for those that need something."""
        return ""

    def pass_time(self, t_ns: int) -> None:
        """Let simulated time come to `t_ns`; after a reset of the simulation the clock of deadlines goes on."""
        self._passed_ns += max(0, t_ns - self._stamp_ns)
        self._stamp_ns = t_ns
        for clock, now_ns in ((self.wall_clock, self._passed_ns), (self.get_clock(), t_ns)):
            if isinstance(clock, ROSClock):
                clock.set_ros_time_override(Time(nanoseconds=now_ns, clock_type=ClockType.ROS_TIME))

    # --- what rclpy makes, counted
    def create_publisher(self, msg_type: Any, topic: str, qos_profile: QoSProfile | int, **kwargs: Any) -> Publisher:
        """As `Node`; in lock-step reliable and counted."""
        books = self.books
        if books is None:
            return super().create_publisher(msg_type, topic, qos_profile, **kwargs)
        publisher = super().create_publisher(msg_type, topic, lossless(qos_profile), **kwargs)
        if publisher.topic_name not in UNCOUNTED:
            publisher.publish = books.count(publisher.publish, publisher.topic_name)  # pyright: ignore
        return publisher

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], qos_profile: QoSProfile | int, **kwargs: Any
    ) -> Subscription:
        """As `Node`; in lock-step reliable."""
        books = self.books
        if books is None:
            return super().create_subscription(msg_type, topic, callback, qos_profile, **kwargs)
        kept = books.unpark(msg_type, self.resolve_topic_name(topic))
        if kept is not None:
            kept.callback = callback
            return kept
        qos = lossless(qos_profile)
        subscription = super().create_subscription(msg_type, topic, callback, qos, **kwargs)
        channel = subscription.topic_name
        if channel not in UNCOUNTED:
            books.enter(subscription, channel)
        if qos.durability is DurabilityPolicy.TRANSIENT_LOCAL:
            books.latched.add(channel)
        return subscription

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """As `Node`; in lock-step it goes on receiving unheard."""
        if self.books is None:
            return super().destroy_subscription(subscription)
        self.books.park(subscription)
        return True

    def destroy_node(self) -> None:
        """As `Node`; nothing is kept any more."""
        self.books = None
        super().destroy_node()

    def create_client(self, *args: Any, **kwargs: Any) -> Client:
        """As `Node`; in lock-step counted."""
        client = super().create_client(*args, **kwargs)
        if self.books is not None:
            client.call_async = self.books.count(client.call_async, f"{client.service_name}/request")
            self.books.enter(client, f"{client.service_name}/response")
        return client

    def create_service(self, *args: Any, **kwargs: Any) -> Service:
        """As `Node`; in lock-step counted."""
        service = super().create_service(*args, **kwargs)
        if self.books is not None:
            service.send_response = self.books.count(service.send_response, f"{service.service_name}/response")
            self.books.enter(service, f"{service.service_name}/request")
        return service

    def add_waitable(self, waitable: Waitable) -> None:
        """As `Node`; in lock-step actions are counted."""
        super().add_waitable(waitable)
        if self.books is None:
            return
        if isinstance(waitable, NamedActionServer):
            _count_server(waitable, self.books)
        elif isinstance(waitable, ActionServer):
            raise TypeError("in lock-step, action servers are openarm_common.ros.lockstep_node.NamedActionServer")
        elif isinstance(waitable, ActionClient):
            _count_client(waitable, self.books)


def lossless(qos_profile: QoSProfile | int) -> QoSProfile:
    """The same, but reliable, and deep enough for what comes between two ticks."""
    qos = QoSProfile(depth=qos_profile) if isinstance(qos_profile, int) else copy(qos_profile)
    qos.reliability = ReliabilityPolicy.RELIABLE
    if qos.durability is not DurabilityPolicy.TRANSIENT_LOCAL:
        qos.depth = max(qos.depth, _DEPTH)
    return qos


def _count_client(client: ActionClient, books: Books) -> None:
    name: str = client._action_name
    client.send_goal_async = books.count(client.send_goal_async, f"{name}/goal_request")
    client._cancel_goal_async = books.count(client._cancel_goal_async, f"{name}/cancel_request")
    client._get_result_async = books.count(client._get_result_async, f"{name}/result_request")
    books.enter(client, name)


def _count_server(server: NamedActionServer, books: Books) -> None:
    name = server.action_name
    server._execute_goal_request = books.count_coroutine(server._execute_goal_request, f"{name}/goal_response")
    server._execute_cancel_request = books.count_coroutine(server._execute_cancel_request, f"{name}/cancel_response")
    server._send_result_response = books.count(server._send_result_response, f"{name}/result_response")
    books.sent.setdefault(f"{name}/feedback", 0)

    def accepted(handle: ServerGoalHandle) -> None:
        handle.publish_feedback = books.count(handle.publish_feedback, f"{name}/feedback")
        handle.execute()

    server.register_handle_accepted_callback(accepted)
    books.enter(server, name)
