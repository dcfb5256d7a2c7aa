# SPDX-License-Identifier: Apache-2.0
"""One frame of a depth camera: of the running graph, or from a bag."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from openarm_bringup.bags.bag import open_bag
from openarm_bringup.bags.ros.messages import contents, message_of
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import ContextNode
from openarm_perception.frames.images import Frame
from openarm_perception.geometry.depth import DepthLimits
from openarm_perception.ros.frames import CameraTopics, FrameBuilder, camera_topics


class _Camera(ContextNode):
    """Receives the first frame of a camera."""

    def __init__(self) -> None:
        super().__init__("perceive", bare=True)
        self._frame: Frame | None = None
        self._fault: OpenArmError | None = None

    def frame(self, camera: str, limits: DepthLimits, depth_scale: float, timeout: float) -> Frame:
        self.spin_until(partial(self._topics, camera), timeout)
        topics = self._topics(camera) or camera_topics(self._names(), camera)  # raises: says what there is
        builder = FrameBuilder(topics, limits, depth_scale)
        for topic, kind in zip(topics, (Image, Image, CameraInfo), strict=True):
            take = partial(self._take, builder, topic)
            self._node.create_subscription(kind, topic, take, qos_profile_sensor_data)
        self.spin_until(lambda: self._frame or self._fault, timeout)
        if self._fault is not None:
            raise self._fault
        if self._frame is None:
            raise OpenArmError(Code.TIMEOUT, f"no frame within {timeout:g} s: {builder.missing()}")
        return self._frame

    def _names(self) -> set[str]:
        return {name for name, _ in self._node.get_topic_names_and_types()}

    def _topics(self, camera: str) -> CameraTopics | None:
        try:
            return camera_topics(self._names(), camera)
        except OpenArmError:
            return None

    def _take(self, builder: FrameBuilder, topic: str, message: Any) -> None:
        try:
            self._frame = self._frame or builder.take(topic, message)
        except OpenArmError as error:
            self._fault = error


def frame_of_graph(camera: str, limits: DepthLimits, depth_scale: float, timeout: float) -> Frame:
    """Return the next frame of a camera of the running graph.

    Args:
        camera: Namespace or a part of it; "": the only one.
        limits: Depths that count.
        depth_scale: Metres of a count of integer depth.
        timeout: Longest wait for topics, and for the frame, s.

    Raises:
        OpenArmError: NOTHING_DETECTED or INVALID_ARGUMENT, as `camera_topics`; TIMEOUT; BAD_IMAGE.
    """
    with _Camera() as listener:
        return listener.frame(camera, limits, depth_scale, timeout)


def frame_of_bag(path: Path, camera: str, limits: DepthLimits, depth_scale: float, start_s: float) -> Frame:
    """Return the first frame of a camera in a bag.

    Args:
        path: rosbag2 folder or MCAP file.
        camera: Namespace or a part of it; "": the only one.
        limits: Depths that count.
        depth_scale: Metres of a count of integer depth.
        start_s: Only from this long after the first message on.

    Raises:
        OpenArmError: NOTHING_DETECTED or INVALID_ARGUMENT, as `camera_topics`, for what is no bag, or when it has no
            such frame; BAD_IMAGE.
    """
    with open_bag(path) as bag:
        topics = camera_topics(bag.topics, camera)
        builder = FrameBuilder(topics, limits, depth_scale)
        # camera_info may have come once, before the time that is asked for
        infos = bag.records([topics.info])
        with contents(bag):
            for record in infos:
                builder.take(record.topic, message_of(bag, record))
                break
            for record in bag.records(list(topics), start_s):
                frame = builder.take(record.topic, message_of(bag, record))
                if frame is not None:
                    return frame
    raise OpenArmError(Code.INVALID_ARGUMENT, f"{path} has no frame from {start_s:g} s on: {builder.missing()}")
