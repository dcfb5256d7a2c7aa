# SPDX-License-Identifier: Apache-2.0
"""Publishers of the state at every tick: /clock, the robot, and the ground truth for judges.

`StatePublisher.publish` runs in the thread of the simulation.
"""

from __future__ import annotations

from collections.abc import Sequence

from openarm_interfaces.msg import ObjectState, ObjectStateArray
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from openarm_common.pacing import RateDivider
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import matrix_to_pose, ns_to_stamp, vector
from openarm_common.ros.node import QOS_CLOCK, reliable
from openarm_control.joints import JointReadout
from openarm_control.ros.robot_publisher import RobotPublisher
from openarm_sim_bridge.world.world import ObjectReadout, World

WORLD_FRAME = "world"


class StatePublisher:
    """Publishers of the simulated robot's state.

    Args:
        node: Owner of the publishers.
        description: The robot.
        joint_names: Order of the joint states.
        tf_rate: Rate of /tf, Hz.
        ground_truth_rate: Rate of the objects' poses, Hz.
        clock: Whether there is /clock.
        robot: Whether there are joint states and frames; those of emulated motors are of the node before them.
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
        robot: bool = True,
    ) -> None:
        self._clock = node.create_publisher(Clock, "/clock", QOS_CLOCK) if clock else None
        self._robot = RobotPublisher(node, description, joint_names) if robot else None
        self._objects = node.create_publisher(ObjectStateArray, "/sim/ground_truth/objects", reliable(5))
        #: Time by the ticks that are published, which are fewer than there are when simulated time is fast.
        self._published_ns = self._newest_ns = 0
        self._tf_ticks = RateDivider(tf_rate)
        self._object_ticks = RateDivider(ground_truth_rate)
        self._clock_message = Clock()

    def publish_static(self, description: RobotDescription) -> None:
        """Publish the fixed edges of the description and the aliases."""
        if self._robot is not None:
            self._robot.publish_static(description)

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
        if self._clock is not None:
            self._clock_message.clock = ns_to_stamp(state.t_ns)
            self._clock.publish(self._clock_message)
        if self._robot is not None:
            if joints:
                self._robot.publish_joints(state)
            if self._tf_ticks.due(self._published_ns):
                self._robot.publish_tf(state)
        if self._object_ticks.due(self._published_ns) and self._objects.get_subscription_count():
            self._publish_objects(state.t_ns, world.objects())

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
