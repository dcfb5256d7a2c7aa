# SPDX-License-Identifier: Apache-2.0
"""Node `foxglove`: every topic of the graph, as raw CDR, and every service, to Foxglove's websocket.

A topic is subscribed to only while a client of the websocket is; no message is deserialised but /robot_description,
whose meshes Foxglove fetches from here. Stamps of the stream are those of /clock where there is one.
"""

from __future__ import annotations

import os
import threading
import time
from typing import Any

import foxglove
from foxglove.websocket import Capability, ChannelView, Client, ServerListener
from pydantic import Field
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from openarm_bringup.bags.definitions import full_definition
from openarm_bringup.messages import interface
from openarm_bringup.view.assets import Assets
from openarm_bringup.view.guard import LOOPBACK, Guard
from openarm_bringup.view.proxy import Proxy, hidden_address
from openarm_bringup.view.viz import TOKEN_VARIABLE
from openarm_common.config import Config
from openarm_common.errors import OpenArmError
from openarm_common.ros.client import BackgroundNode
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import BaseNode, offered_qos, run
from openarm_common.ros.polled import Polled, Source

_ENCODING, _SCHEMA = "cdr", "ros2msg"
_DESCRIPTION = "/robot_description"


class FoxgloveConfig(Config):
    """Address, and who may connect."""

    port: int = Field(default=8765, ge=0, le=65535, description="on the loopback address; 0 takes any that is free")
    origins: tuple[str, ...] = Field(
        default=("https://app.foxglove.dev", "file://"), description="pages that may connect, with the token"
    )
    service_timeout: float = Field(default=600.0, gt=0.0, description="longest wait for the answer of a service, s")


class _Listener(ServerListener):
    """Counts subscribers: latched messages are sent again to clients that subscribe later."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.come: set[str] = set()
        self.counts: dict[str, int] = {}

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        with self.lock:
            self.come.add(channel.topic)
            self.counts[channel.topic] = self.counts.get(channel.topic, 0) + 1

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        with self.lock:
            self.counts[channel.topic] -= 1


class FoxgloveNode(BaseNode[FoxgloveConfig]):
    """Advertises what there is, forwards what is asked for."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("foxglove", FoxgloveConfig, **kwargs)
        guard = Guard(origins=self.config.origins, token=os.environ.get(TOKEN_VARIABLE))
        self._listener = _Listener()
        self._assets = Assets()
        self._foxglove = foxglove.Context()
        hidden = hidden_address()
        self._server = foxglove.start_server(
            name="OpenArm",
            host=hidden,
            port=0,
            context=self._foxglove,
            capabilities=[Capability.Services, Capability.Time],
            supported_encodings=[_ENCODING],
            server_listener=self._listener,
            asset_handler=self._assets.read,
            message_backlog_size=256,
        )
        self._proxy = Proxy(guard, self.config.port, f"ws://{hidden}:{self._server.port}/")
        self.port, self.token = self._proxy.port, guard.token
        self._channels: dict[str, tuple[foxglove.Channel, Any]] = {}
        self._unknown: set[str] = set()
        self._forwarded: dict[str, Subscription] = {}
        self._offered: set[str] = set()
        self._ask = BackgroundNode("foxglove_services", timeout=5.0)
        # Polled, so in no executor: a subscription to 100 Hz would cost more than all else here.
        self._time_node = Node("foxglove_clock", context=self.context, start_parameter_services=False)
        self._time = Polled(self._time_node, Source(Clock, "/clock"))
        self._time_ns: int | None = None
        self.create_timer(1.0, self._discover, clock=self.steady_clock)
        self.create_timer(0.05, self._follow_demand, clock=self.steady_clock)
        token = f"${TOKEN_VARIABLE}" if TOKEN_VARIABLE in os.environ else self.token
        self.get_logger().info(f"ws://{LOOPBACK}:{self.port}/?token={token}")

    def close(self) -> None:
        """Close the websocket with all its clients, then the node."""
        self._proxy.close()
        self._server.stop()
        self._ask.close()
        self._time.close()
        self._time_node.destroy_node()
        super().close()

    # --- what there is
    def _discover(self) -> None:
        topics = {name: kinds[0] for name, kinds in self.get_topic_names_and_types() if "/_action/" not in name}
        for topic in self._channels.keys() - topics:
            self._channels.pop(topic)[0].close()
        for topic in topics.keys() - self._channels.keys() - self._unknown:
            self._advertise(topic, topics[topic])
        for topic, subscription in list(self._forwarded.items()):
            # a publisher may have come since, and what it has latched comes with a subscription of its kind only
            if subscription.qos_profile != offered_qos(self, topic, 20):
                self.destroy_subscription(self._forwarded.pop(topic))
        services = {name: kinds[0] for name, kinds in self.get_service_names_and_types() if "/_action/" not in name}
        gone = self._offered - services.keys()
        if gone:
            self._server.remove_services(sorted(gone))
        new = {name: services[name] for name in services.keys() - self._offered}
        self._server.add_services([self._service(name, kind) for name, kind in sorted(new.items())])
        self._offered = set(services)
        self.diagnose(True, f"{len(self._channels)} topics, {len(self._forwarded)} of them forwarded")

    def _advertise(self, topic: str, name: str) -> None:
        try:
            kind = interface(name)
        except OpenArmError as error:
            self._unknown.add(topic)
            self.get_logger().warning(f"{topic} is not shown: {error.message}")
            return
        schema = foxglove.Schema(name=name, encoding=_SCHEMA, data=full_definition(kind).encode())
        channel = foxglove.Channel(topic, schema=schema, message_encoding=_ENCODING, context=self._foxglove)
        self._channels[topic] = channel, kind

    # --- what is forwarded
    def _follow_demand(self) -> None:
        with self._listener.lock:
            wanted = {topic for topic, count in self._listener.counts.items() if count > 0}
            come, self._listener.come = self._listener.come, set()
        for topic in self._forwarded.keys() - (wanted & self._channels.keys()):
            self.destroy_subscription(self._forwarded.pop(topic))
        for topic in wanted & self._channels.keys():
            if topic in come and topic in self._forwarded:  # latched messages come again with a new subscription only
                self.destroy_subscription(self._forwarded.pop(topic))
            if topic not in self._forwarded:
                self._forwarded[topic] = self._forward(topic)
        if self._forwarded:
            clock = self._time.newest()
            self._time_ns = stamp_to_ns(clock.clock) if clock is not None else self._time_ns
            self._server.broadcast_time(self._now_ns())

    def _forward(self, topic: str) -> Subscription:
        channel, kind = self._channels[topic]

        def forward(data: Any) -> None:
            if topic == _DESCRIPTION and kind is String:
                urdf = deserialize_message(data, String).data
                data = serialize_message(String(data=self._assets.describe(urdf)))
            channel.log(data, log_time=self._now_ns())

        return self.create_subscription(kind, topic, forward, offered_qos(self, topic, 20), raw=True)

    def _now_ns(self) -> int:
        return time.time_ns() if self._time_ns is None else self._time_ns

    # --- what is asked
    def _service(self, name: str, kind_name: str) -> foxglove.Service:
        kind = interface(kind_name)

        def answer(request: foxglove.ServiceRequest) -> bytes:
            """Runs in a thread of the SDK."""
            message: Any = deserialize_message(request.payload, kind.Request)
            response = self._ask.call(kind, name, message, self.config.service_timeout)
            return serialize_message(response)

        return foxglove.Service(
            name,
            schema=foxglove.ServiceSchema(
                name=kind_name,
                request=_message_schema(f"{kind_name}_Request", kind.Request),
                response=_message_schema(f"{kind_name}_Response", kind.Response),
            ),
            handler=answer,
        )


def _message_schema(name: str, kind: type[Any]) -> foxglove.MessageSchema:
    schema = foxglove.Schema(name=name, encoding=_SCHEMA, data=full_definition(kind).encode())
    return foxglove.MessageSchema(encoding=_ENCODING, schema=schema)


def main() -> None:
    """Run the node."""
    run(FoxgloveNode)


if __name__ == "__main__":
    main()
