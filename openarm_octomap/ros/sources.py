# SPDX-License-Identifier: Apache-2.0
"""The sources of the map, whose frames wait until an update takes them: depth images of a camera, or clouds."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2

from openarm_common.camera.cameras import CameraConfig
from openarm_common.camera.stream import Frame
from openarm_common.errors import OpenArmError
from openarm_common.robot.posture import JointNeed
from openarm_common.ros.camera_stream import CameraStream, camera_topics
from openarm_common.ros.convert import points_from_cloud
from openarm_common.ros.images import depth_of, is_rectified, lens_from_info
from openarm_common.ros.node import BaseNode
from openarm_common.ros.tf import RobotStateListener
from openarm_octomap.grid import CloudScan, DepthScan
from openarm_octomap.mapper import Frame as MapFrame

Scan = DepthScan | CloudScan


class MapSource:
    """A stream of frames and what became of them.

    Args:
        name: Name of the camera or cloud.
        stream: Its frames.
        to_scan: Makes the scan of a frame; raises OpenArmError where it does not fit.

    Attributes:
        used: Frames that are in the map.
        refused: Frames that did not fit.
        late: Updates for which no frame had a joint state or transform.
        fault: Why the last one could not be used; empty when it could.
        used_at_ns: Monotonic clock when one was last used; 0 before.
        used_t_ns: Its stamp.
    """

    def __init__(self, name: str, stream: CameraStream, to_scan: Callable[[Frame[Any]], Scan]) -> None:
        self.name = name
        self.used = self.refused = self.late = 0
        self.fault = ""
        self.used_at_ns = self.used_t_ns = 0
        self._stream, self._to_scan = stream, to_scan
        stream.on_refusal = self._refuse

    def take(self) -> MapFrame | None:
        """Take the newest frame whose posture is known; None when there is none.

        What can't be used is counted, and named in `fault`.
        """
        frame = self._stream.take()
        if frame is None:
            self.late += self.waiting
            return None
        try:
            return MapFrame(self.name, frame.t_ns, self._to_scan(frame), frame.posture.joints)
        except OpenArmError as error:
            self.refused += 1
            self._refuse(error)
            return None

    def listen(self, on: bool) -> None:
        """Subscribe, or stop."""
        self._stream.listen(on)
        self.fault = ""

    def forget(self) -> None:
        """Forget the frames that wait: the map was replaced after them."""
        self._stream.frames.clear()

    @property
    def waiting(self) -> bool:
        """Whether a frame waits for an update."""
        return self._stream.frames.waiting_ns is not None

    def took(self, t_ns: int) -> None:
        """Note that a frame is in the map."""
        self.used += 1
        self.fault = ""
        self.used_t_ns, self.used_at_ns = t_ns, time.monotonic_ns()

    def age_s(self) -> float:
        """Return the seconds of wall clock since a frame was last used; infinite before the first."""
        return (time.monotonic_ns() - self.used_at_ns) * 1e-9 if self.used_at_ns else float("inf")

    @property
    def incomplete(self) -> int:
        """Images without a CameraInfo of the same stamp, and the other way round."""
        return self._stream.frames.counts["incomplete"]

    def missing(self) -> str:
        """Name the streams of which nothing has come, where others have."""
        frames = self._stream.frames
        return f"{self.name}: no {' and no '.join(frames.silent)} yet" if frames.silent and frames.received else ""

    def _refuse(self, error: OpenArmError) -> None:
        self.fault = f"{self.name}: {error.message}"


def depth_source(
    node: BaseNode[Any], states: RobotStateListener, camera: CameraConfig, topics: Mapping[str, str], joints: JointNeed
) -> MapSource:
    """Return the source of the depth images of a camera, in its optical frame.

    Args:
        node: Node that subscribes.
        states: States of the robot.
        camera: The camera.
        topics: `depth` and `info`, with {camera} for its name.
        joints: Whether the joints are needed, to cut the robot out.
    """
    rectified = is_rectified(topics["depth"])

    def to_scan(frame: Frame[Any]) -> DepthScan:
        lens = lens_from_info(frame.items["info"], rectified=rectified)
        depth = depth_of(frame.items["depth"], lens)
        return DepthScan(depth, lens.intrinsics, frame.posture.T_base_frame, camera.near, camera.far)

    inputs = camera_topics(camera.name, **topics)
    return MapSource(camera.name, CameraStream(node, states, inputs, camera.optical_frame, joints=joints), to_scan)


def cloud_source(node: BaseNode[Any], states: RobotStateListener, topic: str, joints: JointNeed) -> MapSource:
    """Return the source of clouds in any known frame, whose origin is taken for that of the rays.

    Args:
        node: Node that subscribes.
        states: States of the robot.
        topic: Topic of the clouds.
        joints: Whether the joints are needed, to cut the robot out.
    """

    def to_scan(frame: Frame[Any]) -> CloudScan:
        points = points_from_cloud(frame.items["cloud"]).reshape(-1, 3)
        T_base_frame = frame.posture.T_base_frame
        finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        in_base = finite @ T_base_frame[:3, :3].T + T_base_frame[:3, 3]
        return CloudScan(in_base.astype(np.float32), T_base_frame[:3, 3])

    return MapSource(topic, CameraStream(node, states, {"cloud": (PointCloud2, topic)}, joints=joints), to_scan)
