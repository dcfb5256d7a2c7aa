# SPDX-License-Identifier: Apache-2.0
"""Node `cloud`: depth images to point clouds in the optical frame; each camera only while its cloud has subscribers.

A cloud is published without the robot, or not at all, where `self_filter` is on.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image, PointCloud2

from openarm_common.camera.cameras import depth_camera
from openarm_common.camera.depth_view import DepthView
from openarm_common.camera.stream import Frame
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.camera_stream import CameraStream, camera_topics
from openarm_common.ros.convert import cloud_from_points, depth_image, intrinsics_from_info, rgb_image
from openarm_common.ros.node import QOS_SENSOR, BaseNode, run
from openarm_common.ros.tf import RobotStateListener
from openarm_perception.config import CloudNodeConfig
from openarm_perception.detection.robot import RobotFinder
from openarm_perception.geometry.depth import Deprojector, DepthLimits
from openarm_perception.geometry.filters import CloudFilter


class _Camera:
    """The cloud of one camera.

    Args:
        node: That publishes it.
        name: Of the camera.
        states: Of the robot; None: it stays in the cloud.
        finder: Finds it in images.
    """

    def __init__(
        self, node: CloudNode, name: str, states: RobotStateListener | None, finder: RobotFinder | None
    ) -> None:
        camera, config = depth_camera(name), node.config
        self._node, self._name, self._finder = node, name, finder
        self._deprojector = Deprojector(DepthLimits(near=camera.near, far=camera.far))
        self._filter = CloudFilter(config.filter)
        color = {"color": config.color_topic} if config.color else {}
        topics = camera_topics(name, depth=config.depth_topic, info=config.info_topic, **color)
        self.stream = CameraStream(
            node, states, topics, camera.optical_frame, joints="required" if finder else "none",
            on_frame=self._publish, on_refusal=self._refuse,
        )  # fmt: skip
        self._points = node.create_publisher(PointCloud2, config.points_topic.format(camera=name), QOS_SENSOR)
        self._removed: dict[str, int] = {}
        self._frames = 0
        self._elapsed_ms = 0.0
        self.fault = ""

    def follow_demand(self) -> None:
        """Subscribe to the camera while its cloud is subscribed to."""
        self.stream.poll()
        self.stream.listen(self._points.get_subscription_count() > 0)
        self.fault = self.fault if self.stream.listening else ""

    def _publish(self, frame: Frame[Any]) -> None:
        try:
            started = time.perf_counter()
            pixels, rgb = self._filter.depth(depth_image(frame.items["depth"])), None
            intrinsics = intrinsics_from_info(frame.items["info"])
            if self._finder is not None:
                limits = self._deprojector.limits
                view = DepthView(pixels, intrinsics, frame.posture.T_base_frame, limits.near, limits.far)
                robot, self._removed = self._finder.find(view, frame.posture.joints, frame.posture.held)
                pixels = np.where(robot, pixels.dtype.type(0), pixels)
            deproject = self._deprojector.organised if self._node.config.organised else self._deprojector.valid_points
            points = self._filter.points(deproject(pixels, intrinsics))
            if "color" in frame.items:
                rgb = _colors(frame.items["color"], points.shape)
            self._elapsed_ms = (time.perf_counter() - started) * 1e3
        except OpenArmError as error:
            self._refuse(error)
            return
        self._points.publish(cloud_from_points(points, frame.frame_id, frame.t_ns, rgb))
        self.fault = ""
        self._frames += 1

    def _refuse(self, error: OpenArmError) -> None:
        reason = error.message if error.code is Code.BAD_IMAGE else f"the robot cannot be cut out: {error.message}"
        self.fault = f"{self._name}: frame refused: {reason}"
        self._node.get_logger().warning(self.fault, throttle_duration_sec=5.0)

    def values(self) -> dict[str, object]:
        """Return the values for /diagnostics."""
        name = self._name
        removed = {f"{name}_removed/{link}": n for link, n in self._removed.items()}
        given_up = {f"{name}_{key}": n for key, n in self.stream.frames.given_up().items()}
        return {f"{name}_frames": self._frames, f"{name}_ms": f"{self._elapsed_ms:.2f}", **given_up, **removed}


def _colors(message: Image, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    rgb = rgb_image(message)
    if rgb.shape[:2] != shape[:2]:
        raise OpenArmError(
            Code.BAD_IMAGE,
            f"colour image is {message.width}x{message.height}; expected that of the depth, {shape[1]}x{shape[0]}",
        )
    return rgb


class CloudNode(BaseNode[CloudNodeConfig]):
    """Publishes clouds on demand."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("cloud", CloudNodeConfig, **kwargs)
        config, states, finder = self.config, None, None
        if config.self_filter.enabled:
            states = RobotStateListener(
                self,
                self.description,
                joints=False,
                depth=100,
                wait=config.transform_wait,
                held_topic=config.held_topic,
            )
            finder = RobotFinder(self.description, config.self_filter)
        self._cameras = {name: _Camera(self, name, states, finder) for name in config.cameras}
        self.create_timer(0.1, self._follow_demand, clock=self.steady_clock)

    def waiting_ns(self, camera: str) -> int | None:
        """Return the stamp of the newest frame of a camera that waits for the posture of the robot."""
        return self._cameras[camera].stream.frames.waiting_ns

    def _follow_demand(self) -> None:
        for camera in self._cameras.values():
            camera.follow_demand()
        faults = [camera.fault for camera in self._cameras.values() if camera.fault]
        active = [name for name, camera in self._cameras.items() if camera.stream.listening]
        message = "; ".join(faults) or (f"clouds of {', '.join(active)}" if active else "idle: no subscribers")
        values = {key: value for camera in self._cameras.values() for key, value in camera.values().items()}
        self.diagnose(not faults, message, **values)


def main() -> None:
    """Run the node."""
    run(CloudNode)


if __name__ == "__main__":
    main()
