# SPDX-License-Identifier: Apache-2.0
"""One image of a camera with the joint states around its stamp, listened to only while it is waited for."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, Image

from openarm_calibration.config import CalibrationConfig
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import image_to_array, stamp_to_ns
from openarm_common.ros.node import QOS_NEWEST, BaseNode
from openarm_common.ros.tf import RobotStateListener

#: Between looks at a condition that is waited for, s of wall clock.
_POLL = 0.02


@dataclass
class _Camera:
    """What arrived from the camera while it is listened to."""

    image: Image | None = None
    info: CameraInfo | None = None


class Photographer:
    """Waits for an image that joint states come before and, if possible, after.

    Args:
        node: That subscribes.
        states: Of the robot; listened to only while an image is waited for.
        name: Of the camera.
        config: Timeouts and the gate's window.
    """

    def __init__(self, node: BaseNode[Any], states: RobotStateListener, name: str, config: CalibrationConfig) -> None:
        self._node, self._states, self._name, self._config = node, states, name, config

    async def state(self) -> dict[str, float]:
        """The newest joint state, rad or m.

        Raises:
            OpenArmError: NOT_READY, when none comes in time.
        """
        self._states.enable(True)
        try:
            await wait_until(self._node, lambda: math.isfinite(self._states.age_s()), self._config.state_timeout)
            return self._states.buffer.latest()[1]
        finally:
            self._states.enable(False)

    async def take(self, after: float = 0.0) -> tuple[Image, CameraInfo]:
        """The first image whose stamp has joint states before it, and its info.

        Args:
            after: How long after the image joint states are waited for, s.

        Raises:
            OpenArmError: NOT_READY, when none comes in time.
        """
        seen = _Camera()
        name, config, node = self._name, self._config, self._node
        window_ns = round(config.gate.window * 0.5e9)
        buffer = self._states.buffer

        def pair() -> bool:
            if seen.image is None or seen.info is None:
                return False
            t = stamp_to_ns(seen.image.header.stamp)
            return bool(buffer.between(0, t - window_ns))

        def bracketed() -> bool:
            if seen.image is None:
                return False
            return bool(buffer.between(stamp_to_ns(seen.image.header.stamp) + round(after * 1e9), 2**62))

        self._states.enable(True)
        subscriptions = [
            node.create_subscription(
                Image, f"/{name}/color/image_raw", lambda m: setattr(seen, "image", m), QOS_NEWEST
            ),
            node.create_subscription(
                CameraInfo, f"/{name}/color/camera_info", lambda m: setattr(seen, "info", m), QOS_NEWEST
            ),
        ]
        try:
            await wait_until(node, pair, config.image_timeout + config.state_timeout)
            if seen.image is None or seen.info is None:
                what = "image" if seen.image is None else "camera_info"
                raise OpenArmError(
                    Code.NOT_READY,
                    f"no {what} of {name!r} within {config.image_timeout + config.state_timeout:g} s; is"
                    f" /{name}/color/image_raw published?",
                )
            image, info = seen.image, seen.info
            node.destroy_subscription(subscriptions.pop(0))  # this image is the one
            await wait_until(node, bracketed, config.state_timeout)
            return image, info
        finally:
            for subscription in subscriptions:
                node.destroy_subscription(subscription)
            self._states.enable(False)


async def wait_until(node: BaseNode[Any], condition: Callable[[], bool], timeout: float) -> bool:
    """Wait, in a coroutine of the node, until a condition holds (True) or the time is over (False); s of wall clock."""
    future = Future(executor=node.executor)
    left = round(timeout / _POLL)

    def look() -> None:
        nonlocal left
        left -= 1
        if not future.done() and (condition() or left <= 0):
            future.set_result(left > 0)

    timer = node.create_timer(_POLL, look, clock=node.steady_clock)
    try:
        return bool(await future)
    finally:
        node.destroy_timer(timer)


def grey(message: Image) -> NDArray[np.uint8]:
    """Grey picture (h, w) of an image message.

    Raises:
        OpenArmError: BAD_IMAGE, for an encoding that is no colour or grey picture of 8 bits.
    """
    pixels = image_to_array(message)
    if message.encoding == "mono8":
        return np.ascontiguousarray(pixels).astype(np.uint8)
    if message.encoding not in ("rgb8", "bgr8"):
        raise OpenArmError(Code.BAD_IMAGE, f"image encoding {message.encoding!r}; valid: rgb8, bgr8, mono8")
    turn = cv2.COLOR_RGB2GRAY if message.encoding == "rgb8" else cv2.COLOR_BGR2GRAY
    return cv2.cvtColor(np.ascontiguousarray(pixels).astype(np.uint8), turn).astype(np.uint8)
