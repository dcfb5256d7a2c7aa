# SPDX-License-Identifier: Apache-2.0
"""Forces on the finger pads, for hands that have sensors there: wrenches on topics, received while a grasp runs."""

from __future__ import annotations

import time
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.subscription import Subscription

from openarm_common.ros.node import QOS_SENSOR, BaseNode

#: A force older than this is stale, s of wall clock.
_FRESH_S = 0.5


class Pads:
    """Receives the wrenches on the finger pads of both hands.

    Args:
        node: The node that owns the subscriptions.
    """

    def __init__(self, node: BaseNode[Any]) -> None:
        self._node, self._arms = node, node.description.arms
        self._newest: dict[str, tuple[float, float]] = {}
        self._subscriptions: list[Subscription] = []

    def enable(self, on: bool) -> None:
        """Begin to listen, or stop."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()
        self._newest.clear()
        for link in chain(*(arm.fingers for arm in self._arms.values())) if on else ():
            on_wrench = partial(self._on_wrench, link)
            topic = f"/{link}/contact_wrench"
            self._subscriptions.append(self._node.create_subscription(WrenchStamped, topic, on_wrench, QOS_SENSOR))

    def _on_wrench(self, link: str, message: WrenchStamped) -> None:
        f = message.wrench.force
        self._newest[link] = (time.monotonic(), float(np.linalg.norm((f.x, f.y, f.z))))

    def of(self, arm: str) -> tuple[float, ...]:
        """Newest force on each pad of a hand, N; empty when one is silent."""
        now = time.monotonic()
        newest = [self._newest.get(link, (-np.inf, 0.0)) for link in self._arms[arm].fingers]
        return tuple(force for _, force in newest) if all(now - at <= _FRESH_S for at, _ in newest) else ()
