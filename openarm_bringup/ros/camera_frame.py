# SPDX-License-Identifier: Apache-2.0
"""One frame of a depth camera: of the running graph, or from a bag."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.qos import qos_profile_sensor_data
from tf2_msgs.msg import TFMessage

from openarm_bringup.bags.bag import open_bag
from openarm_bringup.bags.ros.messages import contents, message_of, messages_of
from openarm_bringup.messages import interface
from openarm_bringup.ros.peer import Frames
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import ContextNode
from openarm_common.ros.node import QOS_STATIC_TF
from openarm_perception.frames.images import Frame
from openarm_perception.geometry.depth import UNLIMITED
from openarm_perception.ros.frames import CameraChoice, CameraTopics, FrameBuilder, camera_topics

#: Frames of a bag that are nearer in time are passed over, ns.
_PERIOD_NS = 60_000_000


class _Camera(ContextNode):
    """Receives the first frame of a camera."""

    def __init__(self) -> None:
        super().__init__("perceive", bare=True)
        self._frames = Frames()
        self._frame: Frame | None = None

    def frame(self, chosen: CameraChoice, timeout: float) -> Frame:
        self._node.create_subscription(TFMessage, "/tf_static", self._take_static, QOS_STATIC_TF)
        self.spin_until(partial(self._topics, chosen), timeout)
        kinds = self._kinds()
        topics = self._topics(chosen) or camera_topics(kinds, chosen)  # raises: says what there is
        builder = FrameBuilder(topics, UNLIMITED, chosen, self._frames.between)
        for topic in filter(None, topics):
            take = partial(self._take, builder, topic)
            self._node.create_subscription(interface(kinds[topic]), topic, take, qos_profile_sensor_data)
        # transforms may come later than frames
        self.spin_until(
            lambda: self._frame or (builder.given_up and builder.faults[-1].code is not Code.NO_TRANSFORM), timeout
        )
        if self._frame is None:
            raise builder.failure(Code.TIMEOUT, f"no frame within {timeout:g} s")
        return self._frame

    def _kinds(self) -> dict[str, str]:
        return {name: kinds[0] for name, kinds in self._node.get_topic_names_and_types()}

    def _topics(self, chosen: CameraChoice) -> CameraTopics | None:
        try:
            return camera_topics(self._kinds(), chosen)
        except OpenArmError:
            return None

    def _take_static(self, message: TFMessage) -> None:
        self._frames.add(message, 0, True)

    def _take(self, builder: FrameBuilder, topic: str, message: Any) -> None:
        try:
            self._frame = self._frame or builder.take(topic, message)
        except OpenArmError as error:
            builder.faults.append(error)


def frame_of_graph(chosen: CameraChoice, timeout: float) -> Frame:
    """Return the next frame of a camera of the running graph.

    Args:
        chosen: Name of the camera.
        timeout: Longest wait for topics, and for the frame, s.

    Raises:
        OpenArmError: NOTHING_DETECTED or INVALID_ARGUMENT, as `camera_topics`; TIMEOUT; BAD_IMAGE; NO_TRANSFORM.
    """
    with _Camera() as listener:
        return listener.frame(chosen, timeout)


def frames_of_bag(path: Path, chosen: CameraChoice, start_s: float, count: int = 1) -> Iterator[tuple[int, Frame]]:
    """Give frames of a camera in a bag, with the times they were recorded at, ns; one at least, at 15 Hz at most.

    Args:
        path: Folder of rosbag2, or a file of it.
        chosen: Name of the camera.
        start_s: Only from this long after the first message on.
        count: Most frames.

    Raises:
        OpenArmError: NOTHING_DETECTED or INVALID_ARGUMENT, as `camera_topics`, for what is no bag, or when it has no
            such frame; BAD_IMAGE; NO_TRANSFORM.
    """
    with open_bag(path) as bag:
        topics = camera_topics({topic: kind for topic, (kind, _) in bag.topics.items()}, chosen)
        frames = Frames()
        with contents(bag):
            for message in messages_of(bag, ["/tf_static"])["/tf_static"]:
                frames.add(message, 0, True)
            builder = FrameBuilder(topics, UNLIMITED, chosen, frames.between)
            # camera_info may have come once, before the time that is asked for
            for info in filter(None, (topics.info, topics.depth_info)):
                for record in bag.records([info]):
                    builder.take(record.topic, message_of(bag, record))
                    break
            given, last_ns = 0, -_PERIOD_NS
            for record in bag.records([topic for topic in topics if topic], start_s):
                try:
                    frame = builder.take(record.topic, message_of(bag, record))
                except OpenArmError as error:
                    builder.faults.append(error)
                    frame = None
                if frame is not None and record.t_ns - last_ns >= _PERIOD_NS:
                    yield record.t_ns, frame
                    given, last_ns = given + 1, record.t_ns
                if given >= count or builder.given_up:
                    break
    if not given:
        raise builder.failure(Code.INVALID_ARGUMENT, f"{path} has no frame from {start_s:g} s on")
