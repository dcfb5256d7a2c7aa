# SPDX-License-Identifier: Apache-2.0
"""A robot with a camera and a board, as far as the node `calibration` can tell."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, Image, JointState

from openarm_calibration.board.board import CircleGrid
from openarm_common import se3
from openarm_common.ros.convert import info_from_intrinsics, ns_to_stamp
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_COMMAND, QOS_SENSOR
from tests.openarm_calibration.known_session import Known, photograph

MS = 1_000_000
BOARD = CircleGrid()


class PosedRobot:
    """Joint states at 100 Hz and images at 20 Hz of a time of its own; poses of a session with a known mount.

    Its time runs 2.5 times as fast as the wall clock.
    """

    def __init__(self, ros, camera: str, known: Known) -> None:
        self.known, self.camera = known, camera
        self.offset_ns = 0  # of the image stamps
        self.speed = 0.0  # of joint 1, rad/s
        self.images = True
        self.blank = False
        self.time_ns = 10_000 * MS
        first = known.samples.samples[0]
        A = known.samples.pose(first.joints)
        in_hand = known.samples.head.setup == "in_hand"
        self.Z = (A if in_hand else se3.inverse(A)) @ known.X @ first.T_camera_board
        self.joints = dict(first.joints)
        self._pixels = np.zeros((480, 640, 3), np.uint8)
        node = ros.node
        self._joints = node.create_publisher(JointState, "/joint_states", QOS_COMMAND)
        self._image = node.create_publisher(Image, f"/{camera}/color/image_raw", QOS_SENSOR)
        self._info = node.create_publisher(CameraInfo, f"/{camera}/color/camera_info", QOS_SENSOR)
        node.create_timer(0.02, self._tick)

    def pose(self, k: int) -> None:
        """Stand as in sample k, and let the camera see that."""
        self.stand(self.known.samples.samples[k].joints)

    def stand(self, joints: Mapping[str, float]) -> None:
        """Stand with these joints, and let the camera see the board from there."""
        self.joints = dict(joints)
        samples, optics = self.known.samples, self.known.samples.head.optics
        A = samples.pose(self.joints)
        B = se3.inverse(A) if samples.head.setup == "in_hand" else A
        T = se3.inverse(self.known.X) @ B @ self.Z
        grey = photograph(BOARD, T, optics)
        self._pixels = np.repeat(grey[:, :, None], 3, axis=2).astype(np.uint8)

    def _tick(self) -> None:
        for _ in range(5):
            self.time_ns += 10 * MS
            message = JointState(name=list(self.joints), position=list(self.joints.values()))
            message.position[0] += self.speed * (self.time_ns - 10_000 * MS) * 1e-9
            message.header.stamp = ns_to_stamp(self.time_ns)
            self._joints.publish(message)
        if self.images:
            frame = f"{self.camera}_color_optical_frame"
            t = self.time_ns + self.offset_ns
            pixels = np.full_like(self._pixels, 128) if self.blank else self._pixels
            self._info.publish(info_from_intrinsics(self.known.samples.head.optics, frame, t))
            self._image.publish(array_to_image(pixels, "rgb8", frame, t))


@pytest.fixture
def posed_robot(ros) -> Callable[[str, Known], PosedRobot]:
    """Makes one of a camera's name and a session with a known mount."""
    return lambda camera, known: PosedRobot(ros, camera, known)
