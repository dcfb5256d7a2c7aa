# SPDX-License-Identifier: Apache-2.0
"""The streams of a camera (or of another sensor) subscribed to while they are wanted, as frames with postures."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from openarm_common.camera.stream import Frame, FrameStream
from openarm_common.errors import OpenArmError
from openarm_common.robot.posture import JointNeed
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import QOS_NEWEST, BaseNode, best_effort
from openarm_common.ros.polled import Polled, Source
from openarm_common.ros.tf import RobotStateListener

#: Of streams that wait: of the newest stamp, some may still be on their way.
_WAITING = best_effort(2)


def camera_topics(camera: str, **topics: str) -> dict[str, tuple[type, str]]:
    """Return the message type and topic of the streams `color`, `depth` and `info` of a camera.

    A topic of image_transport that ends in /compressed or /compressedDepth has compressed images.

    Args:
        camera: Its name, filled in for {camera}.
        topics: Topics of the streams.
    """
    named = {stream: topic.format(camera=camera) for stream, topic in topics.items()}
    return {stream: (CameraInfo if stream == "info" else _kind(topic), topic) for stream, topic in named.items()}


def _kind(topic: str) -> type:
    return CompressedImage if topic.endswith(("/compressed", "/compressedDepth")) else Image


class CameraStream:
    """Subscribes on demand and gives frames, each when its posture is known.

    Args:
        node: Node that subscribes.
        states: States of the robot; None: frames need no posture.
        topics: Message type and topic of each stream.
        frame_id: Coordinate frame that every message must have; empty: any.
        pose_of: Same as for `FrameStream`.
        joints: Whether the joints are needed; if so, joint states are subscribed to with the streams.
        capacity: Same as for `FrameStream`, and so is `max_rate`.
        max_rate: Hz.
        on_frame: Takes each frame as soon as its posture is known; without it, messages wait in the middleware, the
            newest two of each stream, until `take`.
        on_refusal: Takes what was refused.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        states: RobotStateListener | None,
        topics: Mapping[str, tuple[type, str]],
        frame_id: str = "",
        *,
        pose_of: str = "",
        joints: JointNeed = "none",
        capacity: int = 5,
        max_rate: float = 0.0,
        on_frame: Callable[[Frame[Any]], None] | None = None,
        on_refusal: Callable[[OpenArmError], None] = lambda _: None,
    ) -> None:
        self._node = node
        self._states = states
        self._topics = dict(topics)
        self._joints = joints != "none"
        self._on_frame, self.on_refusal = on_frame, on_refusal
        self._inputs: list[Subscription] = []
        self._waiting: dict[str, Polled] = {}
        tracker = states.tracker if states is not None else None
        self.frames: FrameStream[Any] = FrameStream(
            tuple(topics), tracker, frame_id, pose_of=pose_of, joints=joints, capacity=capacity, max_rate=max_rate
        )
        if max_rate:
            node.take_images_at(max_rate, [topic for _, topic in self._topics.values()])
        if states is not None and on_frame is not None:
            states.watch(self.poll)

    @property
    def listening(self) -> bool:
        """Whether the streams are subscribed to."""
        return bool(self._inputs)

    def listen(self, on: bool) -> None:
        """Subscribe, or stop and forget what waits; a camera without a subscriber draws nothing."""
        if on == self.listening:
            return
        if self._states is not None and self._joints:
            self._states.enable(on, self)
        if not on:
            for subscription in self._inputs:
                self._node.destroy_subscription(subscription)
            self._inputs.clear()
            self._waiting.clear()
            self.frames.clear()
        elif self._on_frame is None:
            sources = {stream: Source(kind, topic, _WAITING) for stream, (kind, topic) in self._topics.items()}
            self._waiting = {stream: Polled(self._node, source) for stream, source in sources.items()}
            self._inputs = [waiting.subscription for waiting in self._waiting.values()]
        else:
            self._inputs = [
                self._node.create_subscription(kind, topic, self._adder(stream), QOS_NEWEST)
                for stream, (kind, topic) in self._topics.items()
            ]

    def take(self) -> Frame[Any] | None:
        """Take the newest frame whose posture is known; refusals go to `on_refusal`."""
        if self._states is not None:
            self._states.poll()
        for stream, waiting in self._waiting.items():
            for message, received_at in waiting.take_timed():
                self._add(stream, message, received_at)
        try:
            return self.frames.take(time.monotonic())
        except OpenArmError as error:
            self.on_refusal(error)
            return None

    def poll(self) -> None:
        """Give the frames that are complete to `on_frame`; call it now and then, as what is waited for may not come."""
        while self._on_frame is not None and (frame := self.take()) is not None:
            self._on_frame(frame)

    def _adder(self, stream: str) -> Callable[[Any], None]:
        def add(message: Any) -> None:
            if self._add(stream, message, time.monotonic()):
                self.poll()

        return add

    def _add(self, stream: str, message: Any, received_at: float) -> bool:
        """Add a message; return False when it was refused."""
        head = message.header
        try:
            self.frames.add(stream, stamp_to_ns(head.stamp), head.frame_id, message, received_at)
        except OpenArmError as error:
            self.on_refusal(error)
            return False
        return True
