# SPDX-License-Identifier: Apache-2.0
"""Frames for nodes: /joint_states and /tf_static into a `RobotStateBuffer`.

Link poses come from own forward kinematics on /joint_states; a subscription to /tf would cost twice the time and say
the same.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.ros.convert import stamp_to_ns, transform_to_matrix
from openarm_common.ros.node import BASE_FRAME, QOS_STATIC_TF, reliable

#: Who has heard no joint state for this long waits for none, s of wall clock.
_SILENT = 1.0


@dataclass(frozen=True, eq=False)
class Posture:
    """Where everything was at the stamp of a frame.

    Attributes:
        T_base_frame: (4, 4), m.
        joints: Positions by joint name, rad or m; empty when they were not asked for.
    """

    T_base_frame: NDArray[np.float64]
    joints: Mapping[str, float]


class RobotStateListener:
    """Keeps a `RobotStateBuffer` filled.

    Args:
        node: The node that subscribes.
        description: The robot.
        joints: Whether to listen to /joint_states from the start; a 100 Hz subscription costs 5 to 10 % of a core, so a
            node that needs it only now and then passes False and calls `enable`.
        depth: Joint states that wait while the node is busy. Who acts on the newest wants few; who asks for the one of
            an image's stamp wants those of the time that an image takes.
        wait: Longest wait for what a `posture` needs, s.
        on_news: Called after each joint state and each transform, for who waits for a `posture`.
    """

    def __init__(
        self,
        node: Node,
        description: RobotDescription,
        *,
        joints: bool = True,
        depth: int = 10,
        wait: float = 0.0,
        on_news: Callable[[], None] = lambda: None,
    ) -> None:
        self.buffer = RobotStateBuffer(description)
        self.efforts: dict[str, float] = {}
        self.velocities: dict[str, float] = {}
        self._node = node
        self._depth = depth
        self._wait = wait
        self._on_news = on_news
        self._received_at = self._listening_since = -math.inf
        self._joints: Subscription | None = None
        node.create_subscription(TFMessage, "/tf_static", self._on_static, QOS_STATIC_TF)
        self.enable(joints)

    def enable(self, on: bool) -> None:
        """Listen to /joint_states, or stop; what is old when listening starts again is forgotten."""
        if on and self._joints is None:
            self.buffer.clear()
            self._received_at, self._listening_since = -math.inf, time.monotonic()
            self._joints = self._node.create_subscription(
                JointState, "/joint_states", self._on_joints, reliable(self._depth)
            )
        elif not on and self._joints is not None:
            self._node.destroy_subscription(self._joints)
            self._joints = None

    def age_s(self) -> float:
        """Seconds of wall clock since the newest joint state arrived; infinite before the first."""
        return time.monotonic() - self._received_at

    def posture(self, frame: str, t_ns: int, since: float, *, joints: bool) -> Posture | None:
        """Where a frame was at a stamp, and the joints; None while what is still to come may decide it.

        Of two joint states around the stamp the second one is waited for, however near the first is: so the answer
        depends on the stamps alone, not on what arrived first.

        Args:
            frame: Any that is connected to the robot.
            t_ns: The stamp.
            since: When it was first asked for, on the node's `monotonic`.
            joints: Whether they are wanted; if not, they are waited for only where the frame moves with them.

        Raises:
            OpenArmError: STALE_DATA or NO_TRANSFORM, when nothing that may still come can help, or the time is over.
        """
        now = time.monotonic()
        in_time = now < since + self._wait
        heard = now < max(self._received_at, self._listening_since) + max(self._wait, _SILENT)
        to_come = in_time and heard and self._joints is not None and not self.buffer.settled(t_ns)
        try:
            if to_come and (joints or self.buffer.moves(frame)):
                return None
            T_base_frame = self.buffer.lookup(BASE_FRAME, frame, t_ns)
            return Posture(T_base_frame, self.buffer.joints_at(t_ns) if joints else {})
        except OpenArmError as error:
            if in_time and error.code is Code.NO_TRANSFORM:
                return None
            raise

    def _on_joints(self, message: JointState) -> None:
        self._received_at = time.monotonic()
        self.buffer.add_joint_state(stamp_to_ns(message.header.stamp), message.name, message.position)
        self.efforts = dict(zip(message.name, message.effort, strict=False))
        self.velocities = dict(zip(message.name, message.velocity, strict=False))
        self._on_news()

    def _on_static(self, message: TFMessage) -> None:
        for edge in message.transforms:
            self.buffer.set_static(edge.header.frame_id, edge.child_frame_id, transform_to_matrix(edge.transform))
        self._on_news()
