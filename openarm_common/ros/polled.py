# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that are polled: of a topic that comes more often than it is needed."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.qos import QoSProfile

from openarm_common.ros.node import QOS_NEWEST


class Source(NamedTuple):
    """A topic.

    Attributes:
        kind: Type of the messages.
        topic: Absolute name.
        qos: Quality of service.
        silence: It is a fault when nothing has come for longer than this, s; 0: it may be silent.
    """

    kind: Any
    topic: str
    qos: QoSProfile = QOS_NEWEST
    silence: float = 0.0


class Polled:
    """A subscription that is polled; its node is not spun.

    Args:
        node: Owns it.
        source: What is subscribed to.
    """

    def __init__(self, node: Node, source: Source) -> None:
        self._node, self._source = node, source
        # The callback is never called.
        self._subscription: Any = node.create_subscription(source.kind, source.topic, lambda _: None, source.qos)
        self._received_at = time.monotonic()

    def take(self) -> list[Any]:
        """All messages that wait."""
        taken: list[Any] = []
        handle, kind = self._subscription.handle, self._subscription.msg_type
        with handle:
            while (one := handle.take_message(kind, False)) is not None:
                taken.append(one[0])
        if taken:
            self._received_at = time.monotonic()
        return taken

    def newest(self) -> Any | None:
        """The newest message that waits, or None when nothing has come."""
        taken = self.take()
        return taken[-1] if taken else None

    @property
    def fault(self) -> str:
        """Says so when the source has been silent for too long, else empty."""
        silent, limit = time.monotonic() - self._received_at, self._source.silence
        return f"nothing on {self._source.topic} for {silent:.0f} s" if limit and silent > limit else ""

    def close(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)
