# SPDX-License-Identifier: Apache-2.0
"""Frames for nodes: /joint_states and /tf_static into a `RobotStateBuffer`.

Link poses come from own forward kinematics on /joint_states; a subscription to /tf would cost twice the time and say
the same.
"""

from __future__ import annotations

from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage

from openarm_common.convert import stamp_to_ns, transform_to_matrix
from openarm_common.description import RobotDescription
from openarm_common.lockstep_node import LockstepNode
from openarm_common.node import QOS_STATIC_TF, reliable
from openarm_common.robot_state import RobotStateBuffer


class RobotStateListener:
    """Keeps a `RobotStateBuffer` filled.

    Args:
        node: The node that subscribes.
        description: The robot.
        joints: Whether to listen to /joint_states from the start; a 100 Hz subscription costs 5 to 10 % of a core, so a
            node that needs it only now and then passes False and calls `enable`.
        depth: Joint states that wait while the node is busy. Who acts on the newest wants few; who asks for the one of
            an image's stamp wants those of the time that an image takes.
    """

    def __init__(
        self, node: LockstepNode, description: RobotDescription, *, joints: bool = True, depth: int = 10
    ) -> None:
        self.buffer = RobotStateBuffer(description)
        self.efforts: dict[str, float] = {}
        self.velocities: dict[str, float] = {}
        self._node = node
        self._depth = depth
        self._received_at: float | None = None
        self._joints: Subscription | None = None
        node.create_subscription(TFMessage, "/tf_static", self._on_static, QOS_STATIC_TF)
        if joints or node.lockstep:
            self.enable(True)
            self.enable(joints)

    def enable(self, on: bool) -> None:
        """Listen to /joint_states, or stop; what is old when listening starts again is forgotten."""
        if on and self._joints is None:
            self.buffer.clear()
            self._received_at = None
            self._joints = self._node.create_subscription(
                JointState, "/joint_states", self._on_joints, reliable(self._depth)
            )
        elif not on and self._joints is not None:
            self._node.destroy_subscription(self._joints)
            self._joints = None

    def age_s(self) -> float:
        """Seconds of wall clock since the newest joint state arrived; infinite before the first."""
        return float("inf") if self._received_at is None else self._node.monotonic() - self._received_at

    def _on_joints(self, message: JointState) -> None:
        self._received_at = self._node.monotonic()
        self.buffer.add_joint_state(stamp_to_ns(message.header.stamp), message.name, message.position)
        self.efforts = dict(zip(message.name, message.effort, strict=False))
        self.velocities = dict(zip(message.name, message.velocity, strict=False))

    def _on_static(self, message: TFMessage) -> None:
        for edge in message.transforms:
            self.buffer.set_static(edge.header.frame_id, edge.child_frame_id, transform_to_matrix(edge.transform))
