# SPDX-License-Identifier: Apache-2.0
"""What presses on the finger pads, for hands that have sensors there: wrenches on topics, heard while a grasp runs."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.subscription import Subscription

from openarm_common.ros.node import QOS_SENSOR, BaseNode
from openarm_grasp.planning.arms import ARMS

#: A force older than this says nothing, s of wall clock.
_FRESH_S = 0.5
_FINGERS = ("left_finger", "right_finger")


class Pads:
    """Hears the finger pads of both hands.

    Args:
        node: The node that owns the subscriptions.
    """

    def __init__(self, node: BaseNode[Any]) -> None:
        self._node = node
        self._heard: dict[str, tuple[float, float]] = {}
        self._subscriptions: list[Subscription] = []

    def enable(self, on: bool) -> None:
        """Begin to listen, or stop."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()
        self._heard.clear()
        for link in _links() if on else ():
            hear = partial(self._hear, link)
            topic = f"/{link}/contact_wrench"
            self._subscriptions.append(self._node.create_subscription(WrenchStamped, topic, hear, QOS_SENSOR))

    def _hear(self, link: str, message: WrenchStamped) -> None:
        f = message.wrench.force
        self._heard[link] = (time.monotonic(), float(np.linalg.norm((f.x, f.y, f.z))))

    def of(self, arm: str) -> tuple[float, ...]:
        """Newest force on each pad of a hand, N; empty when one is silent."""
        now = time.monotonic()
        heard = [self._heard.get(f"openarm_{arm}_{finger}", (-np.inf, 0.0)) for finger in _FINGERS]
        return tuple(force for _, force in heard) if all(now - at <= _FRESH_S for at, _ in heard) else ()


def _links() -> list[str]:
    return [f"openarm_{arm}_{finger}" for arm in ARMS for finger in _FINGERS]
