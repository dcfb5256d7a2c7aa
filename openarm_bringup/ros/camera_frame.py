# SPDX-License-Identifier: Apache-2.0
"""One frame of a depth camera: of the running graph, or from a bag."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.qos import qos_profile_sensor_data
from tf2_msgs.msg import TFMessage

from openarm_bringup.bags.bag import open_bag
from openarm_bringup.bags.ros.messages import contents, message_of, messages_of
from openarm_bringup.messages import interface
from openarm_bringup.ros.peer import Frames
from openarm_common.camera.lens import Lens
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import ContextNode
from openarm_common.ros.node import QOS_STATIC_TF
from openarm_perception.frames.images import Frame
from openarm_perception.geometry.depth import UNLIMITED
from openarm_perception.ros.frames import CameraTopics, FrameBuilder, camera_topics

#: Frames of a bag that are tried, where the first ones can't be read.
_FAULTS = 30


@dataclass(frozen=True)
class CameraChoice:
    """Which camera, and what its depth is.

    Attributes:
        camera: Namespace or a part of it; "": the only one.
        color: Topic of the colour image; "": found by the names that drivers use.
        depth: Topic of the depth image, likewise.
        info: Topic of the CameraInfo of the colour image, likewise.
        lens: Lens of the colour camera; None: its CameraInfo says it.
        depth_scale: Metres of a count of depth; None as for `metres`.
    """

    camera: str = ""
    color: str = ""
    depth: str = ""
    info: str = ""
    lens: Lens | None = None
    depth_scale: float | None = None

    def topics(self, kinds: Mapping[str, str]) -> CameraTopics:
        """Return its topics among those that there are, types by topic; errors as `camera_topics`."""
        known = self.lens is not None
        return camera_topics(kinds, self.camera, color=self.color, depth=self.depth, info=self.info, known=known)

    def builder(self, topics: CameraTopics, frames: Frames) -> FrameBuilder:
        """Return a builder of frames of these topics."""
        return FrameBuilder(topics, UNLIMITED, self.depth_scale, self.lens, frames.between)


class _Camera(ContextNode):
    """Receives the first frame of a camera."""

    def __init__(self) -> None:
        super().__init__("perceive", bare=True)
        self._frames = Frames()
        self._frame: Frame | None = None
        self._fault: OpenArmError | None = None

    def frame(self, chosen: CameraChoice, timeout: float) -> Frame:
        self._node.create_subscription(TFMessage, "/tf_static", self._take_static, QOS_STATIC_TF)
        self.spin_until(partial(self._topics, chosen), timeout)
        kinds = self._kinds()
        topics = self._topics(chosen) or chosen.topics(kinds)  # raises: says what there is
        builder = chosen.builder(topics, self._frames)
        for topic in filter(None, topics):
            take = partial(self._take, builder, topic)
            self._node.create_subscription(interface(kinds[topic]), topic, take, qos_profile_sensor_data)
        self.spin_until(lambda: self._frame or (self._fault and self._fault.code is not Code.NO_TRANSFORM), timeout)
        if self._frame is not None:
            return self._frame
        raise self._fault or OpenArmError(Code.TIMEOUT, f"no frame within {timeout:g} s: {builder.missing()}")

    def _kinds(self) -> dict[str, str]:
        return {name: kinds[0] for name, kinds in self._node.get_topic_names_and_types()}

    def _topics(self, chosen: CameraChoice) -> CameraTopics | None:
        try:
            return chosen.topics(self._kinds())
        except OpenArmError:
            return None

    def _take_static(self, message: TFMessage) -> None:
        self._frames.add(message, 0, True)

    def _take(self, builder: FrameBuilder, topic: str, message: Any) -> None:
        try:
            self._frame = self._frame or builder.take(topic, message)
        except OpenArmError as error:
            self._fault = error


def frame_of_graph(chosen: CameraChoice, timeout: float) -> Frame:
    """Return the next frame of a camera of the running graph.

    Args:
        chosen: Which camera.
        timeout: Longest wait for topics, and for the frame, s.

    Raises:
        OpenArmError: NOTHING_DETECTED or INVALID_ARGUMENT, as `camera_topics`; TIMEOUT; BAD_IMAGE; NO_TRANSFORM.
    """
    with _Camera() as listener:
        return listener.frame(chosen, timeout)


def frame_of_bag(path: Path, chosen: CameraChoice, start_s: float) -> Frame:
    """Return the first frame of a camera in a bag.

    Args:
        path: Folder of rosbag2, or a file of it.
        chosen: Which camera.
        start_s: Only from this long after the first message on.

    Raises:
        OpenArmError: NOTHING_DETECTED or INVALID_ARGUMENT, as `camera_topics`, for what is no bag, or when it has no
            such frame; BAD_IMAGE; NO_TRANSFORM.
    """
    with open_bag(path) as bag:
        topics = chosen.topics({topic: kind for topic, (kind, _) in bag.topics.items()})
        frames = Frames()
        with contents(bag):
            for message in messages_of(bag, ["/tf_static"])["/tf_static"]:
                frames.add(message, 0, True)
            builder = chosen.builder(topics, frames)
            # camera_info may have come once, before the time that is asked for
            for info in filter(None, (topics.info, topics.depth_info)):
                for record in bag.records([info]):
                    builder.take(record.topic, message_of(bag, record))
                    break
            faults: list[OpenArmError] = []
            for record in bag.records([topic for topic in topics if topic], start_s):
                try:
                    frame = builder.take(record.topic, message_of(bag, record))
                except OpenArmError as error:  # a later one may be whole
                    faults.append(error)
                    frame = None
                if frame is not None:
                    return frame
                if len(faults) >= _FAULTS:
                    break
            if faults:
                raise faults[0]
    raise OpenArmError(Code.INVALID_ARGUMENT, f"{path} has no frame from {start_s:g} s on: {builder.missing()}")
