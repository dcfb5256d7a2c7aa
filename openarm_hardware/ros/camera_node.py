# SPDX-License-Identifier: Apache-2.0
"""Base of the nodes of cameras: the topics of the simulated ones, and /diagnostics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from sensor_msgs.msg import CameraInfo, Image, Imu

from openarm_common.ros.convert import header, info_from_intrinsics, vector
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_SENSOR, BaseNode, until_shutdown
from openarm_hardware.cameras.config import CameraNodeConfig
from openarm_hardware.cameras.feed import CameraFeed
from openarm_hardware.cameras.source import CameraFrame, CameraSource

ConfigT = TypeVar("ConfigT", bound=CameraNodeConfig)


class CameraNode(BaseNode[ConfigT]):
    """Publishes `/CAMERA/color/image_raw`, `/CAMERA/depth/image_raw`, their camera_info, and `/CAMERA/imu`.

    Depth is aligned to colour, in mm. Pictures are without distortion, and become messages only while someone listens.

    Args:
        name: Name of the node.
        model: Model of its parameters.
        source: Makes the camera of the parameters.
        silent_s: Same as for `CameraFeed`.
        kwargs: Arguments of the node.

    Raises:
        OpenArmError: Same as the camera's constructor.
    """

    def __init__(
        self,
        name: str,
        model: type[ConfigT],
        source: Callable[[ConfigT], CameraSource],
        *,
        silent_s: float = 2.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(name, model, **kwargs)
        self._source, camera = source(self.config), self.config.camera
        self._frame = f"{camera}_color_optical_frame"
        kinds = ("color", "depth") if self._source.has_depth else ("color",)
        self._streams = {
            kind: (
                self.create_publisher(Image, f"/{camera}/{kind}/image_raw", QOS_SENSOR),
                self.create_publisher(CameraInfo, f"/{camera}/{kind}/camera_info", QOS_SENSOR),
            )
            for kind in kinds
        }
        self._imu = self.create_publisher(Imu, f"/{camera}/imu", QOS_SENSOR) if self._source.has_depth else None
        self._feed = CameraFeed(self._source, self._publish, silent_s)
        self._before = 0
        self.create_timer(self.REPORT_PERIOD_S, self._report, clock=self.steady_clock)
        self._feed.start()

    def close(self) -> None:
        """Close the camera, then as every node."""
        self._feed.close()
        super().close()

    def _publish(self, frame: CameraFrame) -> None:
        """Publish a picture, in the thread of the feed."""
        with until_shutdown(self.context):
            self._publish_stream("color", frame.color, "rgb8", frame.t_ns)
            if frame.depth is not None:
                self._publish_stream("depth", frame.depth, "16UC1", frame.t_ns)
            if self._imu is not None and _heard(self._imu):
                for reading in frame.imu:
                    message = Imu(header=header(f"{self.config.camera}_imu_optical_frame", reading.t_ns))
                    message.orientation_covariance[0] = -1.0  # it knows none
                    message.angular_velocity = vector(reading.gyro)
                    message.linear_acceleration = vector(reading.acceleration)
                    self._imu.publish(message)

    def _publish_stream(self, kind: str, pixels: NDArray[np.generic], encoding: str, t_ns: int) -> None:
        image, info = self._streams[kind]
        if _heard(image):
            image.publish(array_to_image(pixels, encoding, self._frame, t_ns))
        if _heard(info):
            info.publish(info_from_intrinsics(self._source.intrinsics, self._frame, t_ns))

    def _report(self) -> None:
        feed = self._feed
        rate, self._before = (feed.frames - self._before) / self.REPORT_PERIOD_S, feed.frames
        values = {
            "device": feed.device,
            "pictures": feed.frames,
            "pictures_per_s": f"{rate:.1f}",
            "opened": feed.opened,
        }
        slow = 0.0 < rate < 0.8 * self.config.rate
        if feed.fault or not slow:
            self.diagnose(not feed.fault, feed.fault or "running", **values)
        else:
            text = f"{rate:.0f} pictures a second, expected {self.config.rate:g}; is it plugged into USB 3?"
            self.diagnose_warning(text, **values)


def _heard(publisher: Publisher) -> bool:
    return publisher.get_subscription_count() > 0
