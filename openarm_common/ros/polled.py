# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that are polled: of a topic that comes more often than it is needed."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

from rclpy.callback_groups import CallbackGroup
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


class Unspun(CallbackGroup):
    """Keeps its members out of executors."""

    def can_execute(self, entity: object) -> bool:
        """Never."""
        return False

    def beginning_execution(self, entity: object) -> bool:
        """Never."""
        return False

    def ending_execution(self, entity: object) -> None:
        """Do nothing: none begins."""


class Polled:
    """A subscription that is polled; whoever spins its node does not see it.

    Args:
        node: Owns it.
        source: Topic that is subscribed to.
    """

    def __init__(self, node: Node, source: Source) -> None:
        self._node, self._source = node, source
        # The callback is never called.
        self.subscription: Any = node.create_subscription(
            source.kind, source.topic, lambda _: None, source.qos, callback_group=Unspun()
        )
        self._received_at = time.monotonic()

    def take(self) -> list[Any]:
        """All messages that wait."""
        return [message for message, _ in self.take_timed()]

    def take_timed(self) -> list[tuple[Any, float]]:
        """All messages that wait, and when each arrived, s of the monotonic clock."""
        taken: list[tuple[Any, float]] = []
        handle, kind = self.subscription.handle, self.subscription.msg_type
        with handle:
            while (one := handle.take_message(kind, False)) is not None:
                taken.append((one[0], one[1]["received_timestamp"] * 1e-9))
        if taken:
            self._received_at = now = time.monotonic()
            wall = time.time()
            return [(message, now - max(0.0, wall - at)) for message, at in taken]
        return []

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
        self._node.destroy_subscription(self.subscription)
