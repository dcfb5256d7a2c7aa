# SPDX-License-Identifier: Apache-2.0
"""Hears what the hands hold, as motion tells it by markers on links."""

from __future__ import annotations

from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from openarm_common.errors import OpenArmError
from openarm_common.robot.held import HeldBox
from openarm_common.ros.convert import held_from_msg
from openarm_common.ros.node import QOS_LATCHED


class HeldListener:
    """Keeps what the hands hold; a message that is none is warned of, and changes nothing.

    Args:
        node: The node that subscribes (a message a grasp).
        topic: Markers on links.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self.boxes: tuple[HeldBox, ...] = ()
        self._node, self._topic = node, topic
        node.create_subscription(MarkerArray, topic, self._on_held, QOS_LATCHED)

    def _on_held(self, message: MarkerArray) -> None:
        try:
            self.boxes = held_from_msg(message)
        except OpenArmError as error:
            self._node.get_logger().warning(f"{self._topic}: {error.message}")
