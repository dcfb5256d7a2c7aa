# SPDX-License-Identifier: Apache-2.0
"""At what rate images are needed, for a camera that makes no more than that.

A node that takes fewer images than come says so on /image_rates (`BaseNode.take_images_at`). Whoever says nothing, as
`ros2 topic hz`, RViz and recorders do, takes all.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from openarm_interfaces.msg import ImageRates
from rclpy.node import Node

from openarm_common.ros.actions import full_name
from openarm_common.ros.node import IMAGE_RATES, QOS_STATIC_TF
from openarm_common.ros.polled import Polled, Source


class WantedRates:
    """Knows who subscribes to images, and how many of them each takes.

    Args:
        node: Node of the publishers of the images; an executor that spins it does not see this.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._said = Polled(node, Source(ImageRates, IMAGE_RATES, QOS_STATIC_TF))
        #: By node and topic, Hz.
        self._rates: dict[tuple[str, str], float] = {}

    def poll(self) -> None:
        """Take what nodes have said."""
        for message in self._said.take():
            self._rates |= {(message.node, t): rate for t, rate in zip(message.topics, message.rates, strict=False)}

    def of(self, topics: Iterable[str]) -> float:
        """Return the largest rate at which any of these topics is subscribed to, Hz: infinite: all; 0: not at all."""
        subscribers = [(info, t) for t in topics for info in self._node.get_subscriptions_info_by_topic(t)]
        return max((self._rates.get((full_name(info), topic), math.inf) for info, topic in subscribers), default=0.0)
