# SPDX-License-Identifier: Apache-2.0
"""Node `cloud`: depth images to point clouds in the optical frame; each camera only while somebody wants its points."""

from __future__ import annotations

import time
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from openarm_common.camera.depth_view import DepthView
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import cloud_from_points, image_to_array, intrinsics_from_info, stamp_to_ns
from openarm_common.ros.node import QOS_NEWEST, QOS_SENSOR, BaseNode, run
from openarm_common.ros.tf import Posture, RobotStateListener
from openarm_perception.config import CloudNodeConfig, camera_of
from openarm_perception.detection.matching import StampMatcher
from openarm_perception.geometry.depth import Deprojector, DepthImage, DepthLimits
from openarm_perception.geometry.filters import CloudFilter
from openarm_perception.ros.convert import check_frames
from openarm_perception.ros.robot_listener import RobotInView


class _Camera:
    """The streams of one camera."""

    def __init__(self, node: CloudNode, name: str) -> None:
        camera = camera_of(name)
        self._node = node
        self._name = name
        self._frame_id = camera.optical_frame
        self._deprojector = Deprojector(DepthLimits(near=camera.near, far=camera.far))
        self._robot = RobotInView(node, node.config.self_filter, node.config.held_topic) if node.states else None
        #: A frame that waits for the robot's posture at its stamp, and since when.
        self._waiting: tuple[int, dict[str, Image | CameraInfo], float] | None = None
        self._filter = CloudFilter(node.config.filter)
        streams = ("depth", "info", "color") if node.config.color else ("depth", "info")
        self._matcher: StampMatcher[Image | CameraInfo] = StampMatcher(streams, self._on_frame)
        self._inputs: list[Subscription] = []
        topic = node.config.points_topic.format(camera=name)
        self._points = node.create_publisher(PointCloud2, topic, QOS_SENSOR)
        self.frames = 0
        self.fault = ""
        self.elapsed_ms = 0.0

    @property
    def active(self) -> bool:
        return bool(self._inputs)

    @property
    def waiting_ns(self) -> int | None:
        """Stamp of the frame that waits for the robot's posture."""
        return self._waiting[0] if self._waiting else None

    def follow_demand(self) -> None:
        """Listen to the camera while somebody wants its points."""
        wanted = self._points.get_subscription_count() > 0
        if wanted and not self._inputs:
            self._subscribe("depth", Image, self._node.config.depth_topic)
            self._subscribe("info", CameraInfo, self._node.config.info_topic)
            if self._node.config.color:
                self._subscribe("color", Image, self._node.config.color_topic)
        elif not wanted and self._inputs:
            for subscription in self._inputs:
                self._node.destroy_subscription(subscription)
            self._inputs.clear()
            self._matcher.clear()
            self._waiting = None
            self.fault = ""

    def _subscribe(self, stream: str, kind: type[Image | CameraInfo], topic: str) -> None:
        def add(message: Image | CameraInfo) -> None:
            self._matcher.add(stream, stamp_to_ns(message.header.stamp), message)

        name = topic.format(camera=self._name)
        self._inputs.append(self._node.create_subscription(kind, name, add, QOS_NEWEST))

    def _on_frame(self, t_ns: int, messages: dict[str, Image | CameraInfo]) -> None:
        if self._robot is None:
            self._publish(t_ns, messages, None)
        elif self._waiting is None:
            self._waiting = (t_ns, messages, time.monotonic())
            self.try_waiting()

    def try_waiting(self) -> None:
        """Publish the frame that waits, once the robot's posture at its stamp is known.

        A cloud with the robot in it is not published for one without.
        """
        if self._waiting is None or self._node.states is None:
            return
        t_ns, messages, since = self._waiting
        try:
            posture = self._node.states.posture(self._frame_id, t_ns, since, joints=True)
        except OpenArmError as error:
            self._waiting = None
            self._refuse(f"the robot cannot be cut out: {error.message}")
            return
        if posture is not None:
            self._waiting = None
            self._publish(t_ns, messages, posture)

    def _refuse(self, reason: str) -> None:
        self.fault = f"{self._name}: frame refused: {reason}"
        self._node.get_logger().warning(self.fault, throttle_duration_sec=5.0)

    def _publish(self, t_ns: int, messages: dict[str, Image | CameraInfo], posture: Posture | None) -> None:
        """Publish the cloud of a frame, without the robot when its posture is given."""
        depth, info = cast(Image, messages["depth"]), cast(CameraInfo, messages["info"])
        try:
            check_frames(messages, self._frame_id)
            started = time.perf_counter()
            deproject = self._deprojector.organised if self._node.config.organised else self._deprojector.valid_points
            pixels = self._filter.depth(cast(DepthImage, image_to_array(depth)))
            intrinsics = intrinsics_from_info(info)
            if self._robot is not None and posture is not None:
                limits = self._deprojector.limits
                view = DepthView(pixels, intrinsics, posture.T_base_frame, limits.near, limits.far)
                robot = self._robot.find(view, posture.joints)
                pixels = np.where(robot, pixels.dtype.type(0), pixels)
            points = self._filter.points(deproject(pixels, intrinsics))
            rgb = self._colors(cast(Image, messages["color"]), points.shape) if "color" in messages else None
            self.elapsed_ms = (time.perf_counter() - started) * 1e3
        except OpenArmError as error:
            self._refuse(error.message)
            return
        self._points.publish(cloud_from_points(points, self._frame_id, t_ns, rgb))
        self.fault = ""
        self.frames += 1

    def values(self) -> dict[str, object]:
        """What /diagnostics says of the camera."""
        removed = self._robot.values(f"{self._name}_") if self._robot else {}
        return {f"{self._name}_frames": self.frames, f"{self._name}_ms": f"{self.elapsed_ms:.2f}", **removed}

    @staticmethod
    def _colors(message: Image, shape: tuple[int, ...]) -> NDArray[np.uint8]:
        rgb = cast("NDArray[np.uint8]", image_to_array(message))
        if message.encoding not in ("rgb8", "bgr8") or rgb.shape[:2] != shape[:2]:
            raise OpenArmError(
                Code.BAD_IMAGE,
                f"colour image is {message.width}x{message.height} {message.encoding}; expected rgb8 or bgr8 of the"
                f" depth's {shape[1]}x{shape[0]}",
            )
        return rgb if message.encoding == "rgb8" else rgb[..., ::-1]


class CloudNode(BaseNode[CloudNodeConfig]):
    """Publishes clouds while asked to."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("cloud", CloudNodeConfig, **kwargs)
        #: Where the robot is; None when it is left in the clouds.
        self.states: RobotStateListener | None = None
        if self.config.self_filter.enabled:
            wait = self.config.transform_wait
            self.states = RobotStateListener(
                self, self.description, joints=False, depth=100, wait=wait, on_news=self._try_waiting
            )
        self._cameras = {name: _Camera(self, name) for name in self.config.cameras}
        self.create_timer(0.1, self._follow_demand, clock=self.steady_clock)

    def waiting_ns(self, camera: str) -> int | None:
        """Stamp of the frame of a camera that waits for the robot's posture."""
        return self._cameras[camera].waiting_ns

    def _try_waiting(self) -> None:
        for camera in self._cameras.values():
            camera.try_waiting()

    def _follow_demand(self) -> None:
        self._try_waiting()  # what is waited for may never come
        for camera in self._cameras.values():
            camera.follow_demand()
        faults = [camera.fault for camera in self._cameras.values() if camera.fault]
        active = [name for name, camera in self._cameras.items() if camera.active]
        message = "; ".join(faults) or (f"clouds of {', '.join(active)}" if active else "idle: nobody listens")
        if self.states is not None:
            self.states.enable(bool(active))
        values = {key: value for camera in self._cameras.values() for key, value in camera.values().items()}
        self.diagnose(not faults, message, **values)


def main() -> None:
    """Run the node."""
    run(CloudNode)


if __name__ == "__main__":
    main()
