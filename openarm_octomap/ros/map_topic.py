# SPDX-License-Identifier: Apache-2.0
"""A map of another program as a topic: of octomap_server, of a MoveIt with its own map, or from a bag."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from octomap_msgs.msg import Octomap

from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.codec import decode
from openarm_common.printable import brief
from openarm_common.ros.node import QOS_LATCHED, BaseNode
from openarm_common.ros.tf import RobotStateListener
from openarm_common.types import Array
from openarm_octomap.mapper import Mapper

#: Until the frame of a map is looked up again, s.
_AGAIN_S = 1.0


class MapTopic:
    """Replaces the map by each message of a topic.

    Args:
        node: Its node.
        mapper: The map.
        states: Knows the frames.
        topic: Latched.
        show: Publishes a map that a message has changed.

    Attributes:
        text: State of the newest message; empty before the first.
        fault: Why it is not in the map; empty when it is.

    Raises:
        OpenArmError: CONFIG_INVALID, for a topic that the node itself publishes.
    """

    def __init__(
        self, node: BaseNode[Any], mapper: Mapper, states: RobotStateListener, topic: str, show: Callable[[], None]
    ) -> None:
        self._topic = node.resolve_topic_name(topic)
        if self._topic in (node.resolve_topic_name(name) for name in ("octomap_binary", "octomap_full")):
            text = f"map_topic is {self._topic}, which this node publishes itself; expected the topic of another map"
            raise OpenArmError(Code.CONFIG_INVALID, f"{text}, such as /octomap_server/octomap_full")
        self.text = self.fault = ""
        self._node, self._mapper, self._states, self._show = node, mapper, states, show
        self._waiting: Octomap | None = None
        node.create_subscription(Octomap, self._topic, self._on_map, QOS_LATCHED)
        node.create_timer(_AGAIN_S, self._on_timer, clock=node.steady_clock)

    async def _on_map(self, message: Octomap) -> None:
        self._waiting = None
        try:
            T_base_map = self._pose(message.header.frame_id)
            self.text = await self._node.in_thread(self._take, message, T_base_map)
        except OpenArmError as error:
            self.fault = f"{self._topic}: {error.message}"
            self._waiting = message if error.code is Code.NO_TRANSFORM else None  # it may come later
            self._node.refuse(self._topic, error)
            return
        self.fault = ""
        self._node.get_logger().info(f"{self._topic} replaces the map: {self.text}")
        self._show()

    async def _on_timer(self) -> None:
        if self._waiting is not None and self._states.buffer.knows(self._waiting.header.frame_id):
            await self._on_map(self._waiting)

    def _take(self, message: Octomap, T_base_map: Array | None) -> str:
        data = np.frombuffer(message.data, np.uint8)
        leaves = decode(data, message.resolution, binary=message.binary, tree=message.id)
        return self._mapper.take(leaves, T_base_map).text

    def _pose(self, frame: str) -> Array | None:
        """Return the pose (4, 4) of the map's frame in the base frame; None where they are the same."""
        base, buffer = self._node.description.base, self._states.buffer
        try:
            moves = buffer.moves(frame)
        except OpenArmError as error:
            how = f"ros2 run tf2_ros static_transform_publisher --frame-id {base} --child-frame-id {brief(frame)}"
            raise OpenArmError(
                Code.NO_TRANSFORM, f"{error.message}; publish where it is: {how} --x X --y Y --z Z"
            ) from error
        if moves:
            text = f"map in frame {brief(frame)}, which moves with the robot; expected one that is fixed to {base}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        T_base_map = buffer.lookup(base, frame, 0)
        return None if np.allclose(T_base_map, np.eye(4), atol=1e-6) else T_base_map
