# SPDX-License-Identifier: Apache-2.0
"""One image of a camera with the joint states around its stamp, subscribed to only while it is waited for."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, Image

from openarm_calibration.config import CalibrationConfig
from openarm_common.camera.stream import Frame
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.camera_stream import CameraStream
from openarm_common.ros.node import BaseNode
from openarm_common.ros.tf import RobotStateListener

#: Period in which a condition is checked, s of wall clock.
_POLL = 0.02


class ImageCapture:
    """Waits for an image that joint states come before and, if possible, after.

    Args:
        node: Node that subscribes.
        states: States of the robot; subscribed to only while an image is waited for.
        name: Name of the camera.
        config: Timeouts and the gate's window.
    """

    def __init__(self, node: BaseNode[Any], states: RobotStateListener, name: str, config: CalibrationConfig) -> None:
        self._node, self._states, self._name, self._config = node, states, name, config
        self._refusal: OpenArmError | None = None
        self._listeners = 0
        topics = {
            "image": (Image, f"/{name}/color/image_raw"),
            "camera_info": (CameraInfo, f"/{name}/color/camera_info"),
        }
        # the mount of the camera is not known yet: the pose of the base alone is looked up
        self._stream = CameraStream(
            node, states, topics, joints="required", pose_of=node.description.base, on_refusal=self._refuse
        )

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Stay subscribed while the context is open: images after the first one come at the rate of the camera."""
        self._listeners += 1
        self._stream.listen(True)
        try:
            yield
        finally:
            self._listeners -= 1
            if not self._listeners:
                self._stream.listen(False)

    async def state(self) -> dict[str, float]:
        """Wait for the newest joint state, rad or m.

        Raises:
            OpenArmError: NOT_READY, when none comes in time.
        """
        self._states.enable(True)
        try:
            await wait_until(self._node, lambda: math.isfinite(self._states.age_s()), self._config.state_timeout)
            return self._states.buffer.latest()[1]
        finally:
            self._states.enable(False)

    async def take(self, after: float = 0.0) -> Frame[Any]:
        """Wait for the first frame with joint states before its stamp; its items are `image` and `camera_info`.

        Args:
            after: Longest wait for joint states after the image, s.

        Raises:
            OpenArmError: NOT_READY, when no image comes in time; STALE_DATA, when no joint state comes at its stamp.
        """
        config = self._config
        window_ns = round(config.gate.window * 0.5e9)
        taken: list[Frame[Any]] = []
        self._refusal = None

        def arrived() -> bool:
            frame = self._stream.take()
            if frame is not None and self._states.buffer.between(0, frame.t_ns - window_ns):
                taken.append(frame)
            return bool(taken) or self._refusal is not None

        with self.listening():
            await wait_until(self._node, arrived, config.image_timeout + config.state_timeout)
            if taken:
                end_ns = taken[0].t_ns + round(after * 1e9)
                await wait_until(self._node, lambda: self._states.buffer.settled(end_ns), config.state_timeout)
                return taken[0]
            silent = self._stream.frames.silent or ["image with a joint state at its stamp"]
            raise self._refusal or OpenArmError(
                Code.NOT_READY,
                f"no {' and no '.join(silent)} of {self._name!r} within"
                f" {config.image_timeout + config.state_timeout:g} s; is /{self._name}/color/image_raw published?",
            )

    def _refuse(self, error: OpenArmError) -> None:
        self._refusal = error


async def wait_until(node: BaseNode[Any], condition: Callable[[], bool], timeout: float) -> bool:
    """Wait, in a coroutine of the node, until a condition holds (True) or the time is over (False); s of wall clock.

    Args:
        node: Node whose executor runs the coroutine.
        condition: Checked every 20 ms.
        timeout: s.
    """
    future = Future(executor=node.executor)
    left = round(timeout / _POLL)

    def check() -> None:
        nonlocal left
        left -= 1
        if not future.done() and (condition() or left <= 0):
            future.set_result(left > 0)

    timer = node.create_timer(_POLL, check, clock=node.steady_clock)
    try:
        return bool(await future)
    finally:
        node.destroy_timer(timer)
