# SPDX-License-Identifier: Apache-2.0
"""Publishers of the state at every tick: /clock, /joint_states, /tf, and the ground truth for judges.

`StatePublisher.publish` runs in the thread of the simulation, with messages that are made once and filled in place.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from openarm_interfaces.msg import ObjectState, ObjectStateArray
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import matrix_to_pose, matrix_to_transform, ns_to_stamp, vector
from openarm_common.ros.node import QOS_CLOCK, QOS_LATCHED, QOS_TF, reliable
from openarm_control.joints import JointReadout
from openarm_control.pacing import RateDivider
from openarm_sim_bridge.world.edges import MovingEdges
from openarm_sim_bridge.world.world import ObjectReadout, World

WORLD_FRAME = "world"
#: Longest period of joint states, paused or not: a subscriber that requests this deadline is notified of any gap.
JOINT_STATE_DEADLINE = Duration(nanoseconds=200_000_000)


@contextmanager
def until_shutdown(context: Context) -> Iterator[None]:
    """Let publishing in a thread fail when a signal has shut the context down in the meantime."""
    try:
        yield
    except rclpy_implementation.RCLError:
        if context.ok():
            raise


class StatePublisher:
    """Publishers of the robot's state.

    Args:
        node: Owner of the publishers.
        description: The robot.
        joint_names: Order of the joint states.
        tf_rate: Of /tf, Hz.
        ground_truth_rate: Of the objects, Hz.
        clock: Whether there is /clock.
    """

    def __init__(
        self,
        node: Node,
        description: RobotDescription,
        joint_names: Sequence[str],
        tf_rate: float,
        ground_truth_rate: float,
        *,
        clock: bool = True,
    ) -> None:
        self._clock = node.create_publisher(Clock, "/clock", QOS_CLOCK) if clock else None
        qos = reliable(10)
        qos.deadline = JOINT_STATE_DEADLINE
        self._joint_states = node.create_publisher(JointState, "/joint_states", qos)
        self._tf = node.create_publisher(TFMessage, "/tf", QOS_TF)
        self._tf_static = node.create_publisher(TFMessage, "/tf_static", QOS_LATCHED)
        self._description = node.create_publisher(String, "/robot_description", QOS_LATCHED)
        self._objects = node.create_publisher(ObjectStateArray, "/sim/ground_truth/objects", reliable(5))
        #: Time by the ticks that are published, which are fewer than there are when simulated time is fast.
        self._published_ns = self._newest_ns = 0
        self._tf_ticks = RateDivider(tf_rate)
        self._object_ticks = RateDivider(ground_truth_rate)
        self._edges = MovingEdges(description, joint_names)

        self._clock_message = Clock()
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

    def publish(self, state: JointReadout, world: World, *, joints: bool = True) -> None:
        """Publish a tick; `joints` is False in an injected gap of the joint states.

        Args:
            state: Joints at the end of the tick.
            world: The world then.
            joints: Whether the joint state is published.
        """
        if state.t_ns != self._newest_ns:  # else it is paused
            self._newest_ns = state.t_ns
            self._published_ns += world.period_ns
        stamp = ns_to_stamp(state.t_ns)
        if self._clock is not None:
            self._clock_message.clock = stamp
            self._clock.publish(self._clock_message)
        self._joint_message.header.stamp = stamp
        self._position[:] = state.position
        self._velocity[:] = state.velocity
        self._effort[:] = state.effort
        if joints:
            self._joint_states.publish(self._joint_message)
        if self._tf_ticks.due(self._published_ns):
            self._publish_tf(state)
        if self._object_ticks.due(self._published_ns) and self._objects.get_subscription_count():
            self._publish_objects(state.t_ns, world.objects())

    def _publish_tf(self, state: JointReadout) -> None:
        stamp = self._joint_message.header.stamp
        translations, quaternions = self._edges.poses(state.position)
        for message, p, q in zip(self._tf_message.transforms, translations.tolist(), quaternions.tolist(), strict=True):
            message.header.stamp = stamp
            t, r = message.transform.translation, message.transform.rotation
            t.x, t.y, t.z = p
            r.x, r.y, r.z, r.w = q
        self._tf.publish(self._tf_message)

    def _publish_objects(self, t_ns: int, objects: Sequence[ObjectReadout]) -> None:
        message = ObjectStateArray()
        message.header.frame_id = WORLD_FRAME
        message.header.stamp = ns_to_stamp(t_ns)
        for readout in objects:
            item = ObjectState(name=readout.object.name, label=readout.object.label)
            item.pose = matrix_to_pose(readout.T_world_object)
            item.twist.linear, item.twist.angular = vector(readout.linear), vector(readout.angular)
            item.size = vector(readout.object.size)
            message.objects.append(item)
        self._objects.publish(message)
