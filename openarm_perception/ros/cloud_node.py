# SPDX-License-Identifier: Apache-2.0
"""Node `cloud`: depth images to point clouds, each camera only while someone subscribes to a cloud of it.

The cloud of a camera is in its optical frame, the merged one of all cameras in the base frame. They are published
without the robot, or not at all, where `self_filter` is on.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2

from openarm_common.camera.cameras import depth_camera
from openarm_common.camera.depth_view import DepthView
from openarm_common.camera.stream import Frame
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.camera_stream import CameraStream, camera_topics
from openarm_common.ros.convert import cloud_from_points
from openarm_common.ros.images import color_of, depth_of, is_rectified, lens_from_info
from openarm_common.ros.node import QOS_SENSOR, BaseNode, run
from openarm_common.ros.tf import RobotStateListener
from openarm_perception.config import CloudNodeConfig
from openarm_perception.detection.robot import RobotFinder
from openarm_perception.geometry.depth import Deprojector, DepthLimits, Points
from openarm_perception.geometry.filters import CloudFilter
from openarm_perception.geometry.merge import CloudMerger


class _Camera:
    """The points of one camera, for its own cloud or for the merged one.

    Args:
        node: Node that publishes them.
        name: Name of the camera.
        finder: Finds the robot in images; None: it stays in the cloud.
        publish: Takes each frame and its points; what raises is reported.
        merged: Whether they are for the merged cloud: valid points, and the pose of the camera is needed.
    """

    def __init__(
        self,
        node: CloudNode,
        name: str,
        finder: RobotFinder | None,
        publish: Callable[[Frame[Any], Points], None],
        *,
        merged: bool = False,
    ) -> None:
        camera, config = depth_camera(name), node.config
        self._node, self._name, self._finder, self._publish = node, name, finder, publish
        self._deprojector = Deprojector(DepthLimits(near=camera.near, far=camera.far))
        self._deproject = (
            self._deprojector.organised if config.organised and not merged else self._deprojector.valid_points
        )
        color = {"color": config.color_topic} if config.color and not merged else {}
        topics = camera_topics(name, depth=config.depth_topic, info=config.info_topic, **color)
        moving = merged and any(joint.type != "fixed" for joint in node.description.chain(camera.parent))
        self.stream = CameraStream(
            node, node.states if finder or merged else None, topics, camera.optical_frame,
            joints="required" if finder else "optional" if moving else "none",
            max_rate=config.merged_rate if merged else 0.0, on_frame=self._take, on_refusal=self._refuse,
        )  # fmt: skip
        self._removed: dict[str, int] = {}
        self._frames = 0
        self._elapsed_ms = 0.0
        self.fault = ""

    def follow_demand(self, wanted: bool) -> None:
        """Subscribe to the camera while its points are wanted."""
        self.stream.poll()
        self.stream.listen(wanted)
        self.fault = self.fault if self.stream.listening else ""

    def _take(self, frame: Frame[Any]) -> None:
        try:
            started = time.perf_counter()
            lens = lens_from_info(frame.items["info"], rectified=is_rectified(self._node.config.depth_topic))
            depth, intrinsics = depth_of(frame.items["depth"], lens), lens.intrinsics
            pixels = self._node.filter.depth(depth)
            if self._finder is not None:
                limits = self._deprojector.limits
                view = DepthView(pixels, intrinsics, frame.posture.T_base_frame, limits.near, limits.far)
                robot, self._removed = self._finder.find(view, frame.posture.joints, frame.posture.held)
                pixels = np.where(robot, pixels.dtype.type(0), pixels)
            self._publish(frame, self._deproject(pixels, intrinsics))
            self._elapsed_ms = (time.perf_counter() - started) * 1e3
        except OpenArmError as error:
            self._refuse(error)
            return
        self.fault = ""
        self._frames += 1

    def _refuse(self, error: OpenArmError) -> None:
        reason = error.message
        if error.code is not Code.BAD_IMAGE:
            need = "the robot cannot be cut out" if self._finder else "its pose in the base frame is not known"
            reason = f"{need}: {reason}"
        self.fault = f"{self._name}: frame refused: {reason}"
        self._node.get_logger().warning(self.fault, throttle_duration_sec=5.0)

    def values(self, prefix: str = "") -> dict[str, object]:
        """Return the values for /diagnostics."""
        name = prefix + self._name
        removed = {f"{name}_removed/{link}": n for link, n in self._removed.items()}
        given_up = {f"{name}_{key}": n for key, n in self.stream.frames.given_up().items()}
        return {f"{name}_frames": self._frames, f"{name}_ms": f"{self._elapsed_ms:.2f}", **given_up, **removed}


class CloudNode(BaseNode[CloudNodeConfig]):
    """Publishes clouds on demand."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("cloud", CloudNodeConfig, **kwargs)
        config = self.config
        self.filter = CloudFilter(config.filter)
        finder = RobotFinder(self.description, config.self_filter) if config.self_filter.enabled else None
        self.states = RobotStateListener(
            self,
            self.description,
            joints=False,
            depth=100,
            wait=config.transform_wait,
            held_topic=config.held_topic if finder else "",
        )
        if finder is not None:
            self.states.follow_mounts(finder.mount)
        self._merged = self.create_publisher(PointCloud2, config.merged_topic, QOS_SENSOR)
        self._merger = CloudMerger(config.cameras, config.merged_age)
        self._points = {
            name: self.create_publisher(PointCloud2, config.points_topic.format(camera=name), QOS_SENSOR)
            for name in config.cameras
        }
        self._cameras = {name: _Camera(self, name, finder, self._publisher(name)) for name in config.cameras}
        self._parts = {name: _Camera(self, name, finder, self._adder(name), merged=True) for name in config.cameras}
        self.create_timer(0.1, self._follow_demand, clock=self.steady_clock)

    def _publisher(self, name: str) -> Callable[[Frame[Any], Points], None]:
        def publish(frame: Frame[Any], points: Points) -> None:
            points = self.filter.points(points)
            rgb = None
            if "color" in frame.items:
                lens = lens_from_info(frame.items["info"], rectified=is_rectified(self.config.color_topic))
                rgb = color_of(frame.items["color"], lens)
            self._points[name].publish(cloud_from_points(points, frame.frame_id, frame.t_ns, rgb))

        return publish

    def _adder(self, name: str) -> Callable[[Frame[Any], Points], None]:
        def add(frame: Frame[Any], points: Points) -> None:
            merged = self._merger.add(name, frame.t_ns, points, frame.posture.T_base_frame)
            if merged is not None:
                t_ns, cloud = merged
                self._merged.publish(cloud_from_points(self.filter.points(cloud), self.description.base, t_ns))

        return add

    def waiting_ns(self, camera: str) -> int | None:
        """Return the stamp of the newest frame of a camera that waits for the posture of the robot."""
        return self._cameras[camera].stream.frames.waiting_ns

    def _follow_demand(self) -> None:
        merged = self._merged.get_subscription_count() > 0
        if not merged:
            self._merger.clear()
        for name, camera in self._cameras.items():
            camera.follow_demand(self._points[name].get_subscription_count() > 0)
            self._parts[name].follow_demand(merged)
        faults = list(dict.fromkeys(c.fault for c in (*self._cameras.values(), *self._parts.values()) if c.fault))
        active = [name for name, camera in self._cameras.items() if camera.stream.listening]
        active += [self.config.merged_topic] if merged else []
        message = "; ".join(faults) or (f"clouds of {', '.join(active)}" if active else "idle: no subscribers")
        values = {key: value for camera in self._cameras.values() for key, value in camera.values().items()}
        if merged:
            values |= {key: value for part in self._parts.values() for key, value in part.values("merged_").items()}
        self.diagnose(not faults, message, **values)


def main() -> None:
    """Run the node."""
    run(CloudNode)


if __name__ == "__main__":
    main()
