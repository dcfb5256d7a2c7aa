# SPDX-License-Identifier: Apache-2.0
"""A robot behind joint_trajectory_controllers that take positions and need not interpolate, as openarm_ros2 has them.

Each control tick sends a trajectory of one point, which such a controller takes at once.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from control_msgs.msg import JointTrajectoryControllerState
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from openarm_common.errors import OpenArmError
from openarm_common.ros.convert import joints_from_msg, stamp_to_ns
from openarm_common.ros.node import BaseNode, reliable
from openarm_common.ros.polled import Polled, Source
from openarm_common.types import Array
from openarm_control.controller import RobotController
from openarm_control.joints import JointReadout

#: Of the joint states that are passed on, one for each control tick.
JOINT_STATES = "joint_states"
#: One of so many ticks sends all targets.
_REPEAT = 10


class PositionDriver:
    """Implements `openarm_control.streamed.Driver`.

    Args:
        node: Publishes.
        controller: Controller of the joints.
        arm_topic: Topic of position commands of an arm; {arm} stands for its side.
        gripper_topic: The same of a gripper.
        prefix: Prefix of the topic on which joint states are passed on.
    """

    def __init__(
        self, node: BaseNode[Any], controller: RobotController, arm_topic: str, gripper_topic: str, prefix: str
    ) -> None:
        self._node, self._names = node, controller.joint_names
        # In no executor: joint states come at 500 to 1000 Hz, and of those the newest of each tick is taken.
        self._listener = Node(f"_{node.get_name()}_listener", context=node.context, start_parameter_services=False)
        self._states = Polled(self._listener, Source(JointState, "/joint_states", reliable(1)))
        self._passed_on = node.create_publisher(JointState, f"{prefix}/{JOINT_STATES}", reliable(10))
        self._outputs: list[tuple[list[int], list[str], Publisher]] = []
        self._references: list[tuple[list[int], Polled]] = []
        pairs = [(arm_topic, controller.arms), (gripper_topic, controller.grippers)]
        for topic, followers in pairs:
            for side, follower in followers.items():
                names, name = list(follower.group.names), topic.format(arm=side)
                at = [self._names.index(joint) for joint in names]
                self._outputs.append((at, names, node.create_publisher(JointTrajectory, name, reliable(1))))
                state = f"{name.rpartition('/')[0]}/controller_state"
                source = Source(JointTrajectoryControllerState, state, reliable(1))
                self._references.append((at, Polled(self._listener, source)))
        #: Targets as the driver's controllers said them, and their stamps.
        self._said: Array = np.full(len(self._names), np.nan)
        self._said_ns = np.zeros(len(self._names), np.int64)
        self._ticks = 0
        self._sent: Array = np.full(len(self._names), np.nan)
        self.refused = ""

    def close(self) -> None:
        """Leave the topics."""
        self._listener.destroy_node()

    def now_ns(self) -> int:
        """See `Driver.now_ns`."""
        now: int = self._node.get_clock().now().nanoseconds
        return now

    def take(self) -> JointReadout | None:
        """See `Driver.take`; what is taken is passed on."""
        message: JointState | None = self._states.newest()
        if message is None:
            return None
        try:
            readout = self._readout(message)
        except (OpenArmError, ValueError) as error:
            self.refused = f"joint state refused: {error}"
            return None
        self.refused = ""
        self._passed_on.publish(message)
        return readout

    def fault(self) -> str:
        """See `Driver.fault`: what such a driver takes or not, it does not say."""
        return ""

    def targets(self, since_ns: int) -> Array:
        """See `Driver.targets`: what the driver's controllers say that they command."""
        for at, polled in self._references:
            message: JointTrajectoryControllerState | None = polled.newest()
            if message is not None and len(message.reference.positions) == len(at):
                by_name = dict(zip(message.joint_names, message.reference.positions, strict=False))
                self._said[at] = [by_name.get(self._names[i], np.nan) for i in at]
                self._said_ns[at] = stamp_to_ns(message.header.stamp)
        return np.where(self._said_ns >= since_ns, self._said, np.nan)

    def send(self, targets: Array) -> None:
        """See `Driver.send`; targets that are as before are repeated now and then, for a driver that was restarted."""
        self._ticks += 1
        for at, names, publisher in self._outputs:
            if self._ticks % _REPEAT == 0 or not np.array_equal(targets[at], self._sent[at]):
                point = JointTrajectoryPoint(positions=targets[at].tolist())
                publisher.publish(JointTrajectory(joint_names=names, points=[point]))
        self._sent = targets.copy()

    def _readout(self, message: JointState) -> JointReadout:
        joints_from_msg(message)
        index = {name: i for i, name in enumerate(message.name)}
        missing = [name for name in self._names if name not in index]
        if missing:
            raise ValueError(f"no {', '.join(missing)} among {', '.join(message.name)}")
        at = [index[name] for name in self._names]

        def taken(values: Any) -> Array:
            return np.asarray(values, dtype=np.float64)[at] if len(values) == len(index) else np.zeros(len(at))

        return JointReadout(
            stamp_to_ns(message.header.stamp), taken(message.position), taken(message.velocity), taken(message.effort)
        )
