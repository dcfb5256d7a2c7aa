# SPDX-License-Identifier: Apache-2.0
"""What the sources of the map send, kept until an update takes it: depth images of a camera, or clouds."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from typing import Generic, TypeVar

import numpy as np
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from openarm_common.camera.cameras import CameraConfig
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import image_to_array, intrinsics_from_info, points_from_cloud, stamp_to_ns
from openarm_common.ros.node import QOS_NEWEST
from openarm_common.ros.tf import RobotStateListener
from openarm_octomap.grid import CloudScan, DepthScan
from openarm_octomap.mapper import Frame

MessageT = TypeVar("MessageT", Image, PointCloud2)

#: Frames kept, of which the newest may be ahead of the joint states, on a busy machine by 0.1 s.
_KEPT = 5


class Source(ABC, Generic[MessageT]):
    """A stream of messages and what became of them.

    Attributes:
        name: Of the camera or cloud.
        used: Frames that are in the map.
        refused: Frames that did not fit.
        late: Updates for which no frame had a joint state or transform.
        fault: Why the last one could not be used; empty when it could.
        used_at_ns: Monotonic clock when one was last used; 0 before.
        used_t_ns: Its stamp.
    """

    def __init__(self, node: Node, name: str) -> None:
        self.name = name
        self.used = self.refused = self.late = 0
        self.fault = ""
        self.used_at_ns = self.used_t_ns = 0
        self._waiting: deque[tuple[MessageT, float]] = deque(maxlen=_KEPT)
        self._node = node
        self._inputs: list[Subscription] = []

    def take(self, states: RobotStateListener, *, filtering: bool) -> Frame | None:
        """The newest frame whose joints and transforms are known at its stamp; None when there is none.

        What can't be used is counted, and named in `fault`.
        """
        for i in range(len(self._waiting) - 1, -1, -1):
            message, since = self._waiting[i]
            t_ns = stamp_to_ns(message.header.stamp)
            try:
                posture = states.posture(message.header.frame_id, t_ns, since, joints=filtering)
            except OpenArmError as error:
                self.fault = f"{self.name}: {error.message}"
                continue
            if posture is None:
                continue
            for _ in range(i + 1):
                self._waiting.popleft()
            try:
                return Frame(self.name, t_ns, self._scan(message, posture.T_base_frame), posture.joints)
            except OpenArmError as error:
                self.refused += 1
                self.fault = f"{self.name}: {error.message}"
                return None
        if self._waiting:
            self.late += 1
        return None

    def listen(self, on: bool) -> None:
        """Listen, or stop; a camera that nobody listens to draws nothing."""
        if on and not self._inputs:
            self._inputs = self._subscribe(self._node)
        elif not on:
            for subscription in self._inputs:
                self._node.destroy_subscription(subscription)
            self._inputs.clear()
            self._waiting.clear()
            self.fault = ""

    @property
    def waiting(self) -> int:
        """Frames that wait for an update."""
        return len(self._waiting)

    def took(self, t_ns: int) -> None:
        """Note that a frame is in the map."""
        self.used += 1
        self.fault = ""
        self.used_t_ns, self.used_at_ns = t_ns, time.monotonic_ns()

    def age_s(self) -> float:
        """Seconds of wall clock since a frame was last used; infinite before the first."""
        return (time.monotonic_ns() - self.used_at_ns) * 1e-9 if self.used_at_ns else float("inf")

    @abstractmethod
    def _scan(self, message: MessageT, T_base_frame: np.ndarray) -> DepthScan | CloudScan:
        """The scan of a message; OpenArmError where it does not fit."""

    @abstractmethod
    def _subscribe(self, node: Node) -> list[Subscription]:
        """Begin to listen."""

    def _keep(self, message: MessageT) -> None:
        self._waiting.append((message, time.monotonic()))


class DepthSource(Source[Image]):
    """Depth images of one camera, in its optical frame."""

    def __init__(self, node: Node, camera: CameraConfig, depth_topic: str, info_topic: str) -> None:
        super().__init__(node, camera.name)
        self._camera = camera
        self._topics = [topic.format(camera=camera.name) for topic in (depth_topic, info_topic)]
        self._info: CameraInfo | None = None

    def _subscribe(self, node: Node) -> list[Subscription]:
        depth, info = self._topics
        return [
            node.create_subscription(Image, depth, self._keep, QOS_NEWEST),
            node.create_subscription(CameraInfo, info, self._on_info, QOS_NEWEST),
        ]

    def _on_info(self, message: CameraInfo) -> None:
        self._info = message

    def _scan(self, message: Image, T_base_frame: np.ndarray) -> DepthScan:
        info, frame = self._info, self._camera.optical_frame
        if info is None:
            raise OpenArmError(Code.NOT_READY, "no CameraInfo yet")
        for what, got in (("depth", message.header.frame_id), ("CameraInfo", info.header.frame_id)):
            if got != frame:
                raise OpenArmError(Code.BAD_IMAGE, f"{what} is in frame {got!r}, expected the optical frame {frame!r}")
        if message.encoding not in ("16UC1", "32FC1"):
            raise OpenArmError(
                Code.BAD_IMAGE, f"depth encoding {message.encoding!r} is not supported; valid: 16UC1, 32FC1"
            )
        depth = image_to_array(message)
        intrinsics = intrinsics_from_info(info)
        return DepthScan(depth, intrinsics, T_base_frame, self._camera.near, self._camera.far)  # type: ignore[arg-type]


class CloudSource(Source[PointCloud2]):
    """Clouds in any known frame, whose origin is taken for that of the rays."""

    def __init__(self, node: Node, topic: str) -> None:
        super().__init__(node, topic)

    def _subscribe(self, node: Node) -> list[Subscription]:
        return [node.create_subscription(PointCloud2, self.name, self._keep, QOS_NEWEST)]

    def _scan(self, message: PointCloud2, T_base_frame: np.ndarray) -> CloudScan:
        points = points_from_cloud(message).reshape(-1, 3)
        finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        in_base = finite @ T_base_frame[:3, :3].T + T_base_frame[:3, 3]
        return CloudScan(in_base.astype(np.float32), T_base_frame[:3, 3])
