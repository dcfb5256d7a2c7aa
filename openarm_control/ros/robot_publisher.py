# SPDX-License-Identifier: Apache-2.0
"""Publishers of a robot, simulated or real: /joint_states, /tf, /tf_static, /robot_description.

Messages are made once and filled in place.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from openarm_common.robot.description import RobotDescription
from openarm_common.robot.edges import MovingEdges
from openarm_common.ros.convert import matrix_to_transform, ns_to_stamp
from openarm_common.ros.node import QOS_LATCHED, QOS_TF, reliable
from openarm_control.joints import JointReadout

#: Longest period of joint states, paused or not: a subscriber that requests this deadline is notified of any gap.
JOINT_STATE_DEADLINE = Duration(nanoseconds=200_000_000)


class RobotPublisher:
    """Publishers of a robot.

    Args:
        node: Owner of the publishers.
        description: The robot.
        joint_names: Order of the joint states.
    """

    def __init__(self, node: Node, description: RobotDescription, joint_names: Sequence[str]) -> None:
        qos = reliable(10)
        qos.deadline = JOINT_STATE_DEADLINE
        self._joint_states = node.create_publisher(JointState, "/joint_states", qos)
        self._tf = node.create_publisher(TFMessage, "/tf", QOS_TF)
        self._tf_static = node.create_publisher(TFMessage, "/tf_static", QOS_LATCHED)
        self._description = node.create_publisher(String, "/robot_description", QOS_LATCHED)
        self._edges = MovingEdges(description, joint_names)
        self._joint_message = JointState(name=list(joint_names))
        self._joint_message.position = self._joint_message.velocity = [0.0] * len(joint_names)
        self._joint_message.effort = [0.0] * len(joint_names)
        message = self._joint_message
        self._position, self._velocity, self._effort = (
            np.frombuffer(field, dtype=np.float64) for field in (message.position, message.velocity, message.effort)
        )
        self._tf_message = TFMessage(
            transforms=[matrix_to_transform(parent, child, np.eye(4), 0) for parent, child in self._edges.frames]
        )
        self._description.publish(String(data=description.urdf))

    def publish_static(self, description: RobotDescription) -> None:
        """Publish the fixed edges of the description and the aliases."""
        edges = [(j.parent, j.child, j.T_parent_joint) for j in description.joints.values() if j.type == "fixed"]
        edges.append((description.base, "base_link", np.eye(4)))
        edges += [(arm.base, f"{name}_arm_base", np.eye(4)) for name, arm in description.arms.items()]
        self._tf_static.publish(TFMessage(transforms=[matrix_to_transform(*edge, 0) for edge in edges]))

    def publish_joints(self, state: JointReadout) -> None:
        """Publish a joint state."""
        self._joint_message.header.stamp = ns_to_stamp(state.t_ns)
        self._position[:] = state.position
        self._velocity[:] = state.velocity
        self._effort[:] = state.effort
        self._joint_states.publish(self._joint_message)

    def publish_tf(self, state: JointReadout) -> None:
        """Publish the poses of all links that move."""
        stamp = ns_to_stamp(state.t_ns)
        translations, quaternions = self._edges.poses(state.position)
        for message, p, q in zip(self._tf_message.transforms, translations.tolist(), quaternions.tolist(), strict=True):
            message.header.stamp = stamp
            t, r = message.transform.translation, message.transform.rotation
            t.x, t.y, t.z = p
            r.x, r.y, r.z, r.w = q
        self._tf.publish(self._tf_message)
