# SPDX-License-Identifier: Apache-2.0
"""Publishing the force sensors: the wrench at each wrist and the contact force on each finger pad."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher

from openarm_common.robot.description import SIDES
from openarm_common.ros.convert import ns_to_stamp, vector
from openarm_common.ros.node import QOS_SENSOR
from openarm_sim_bridge.pacing import RateDivider
from openarm_sim_bridge.world.touch import hand_link, pad_links
from openarm_sim_bridge.world.world import World

Reading = tuple[NDArray[np.float64], NDArray[np.float64]]
#: Rate at which subscribers are counted, Hz.
_COUNT_RATE = 5.0


@dataclass
class _Sensor:
    publisher: Publisher
    frame: str
    read: Callable[[World, str], Reading]
    wanted: bool = False


class ForcePublisher:
    """Topics of the force sensors, each only while it has subscribers; 100 Hz of simulated time.

    Args:
        node: Owner of the publishers.
    """

    def __init__(self, node: Node) -> None:
        self._count = RateDivider(_COUNT_RATE)
        self._sensors: list[_Sensor] = []
        for side in SIDES:
            topic = f"/{side}_force_torque_sensor_broadcaster/wrench"
            publisher = node.create_publisher(WrenchStamped, topic, QOS_SENSOR)
            self._sensors.append(_Sensor(publisher, hand_link(side), World.wrist_wrench))
            for link in pad_links(side):
                publisher = node.create_publisher(WrenchStamped, f"/{link}/contact_wrench", QOS_SENSOR)
                self._sensors.append(_Sensor(publisher, link, World.pad_wrench))

    def publish(self, world: World) -> None:
        """Publish a tick; in the thread of the simulation."""
        if self._count.due(world.t_ns):
            for sensor in self._sensors:
                sensor.wanted = sensor.publisher.get_subscription_count() > 0
        for sensor in self._sensors:
            if sensor.wanted:
                force, torque = sensor.read(world, sensor.frame)
                message = WrenchStamped()
                message.header.frame_id = sensor.frame
                message.header.stamp = ns_to_stamp(world.t_ns)
                message.wrench.force, message.wrench.torque = vector(force), vector(torque)
                sensor.publisher.publish(message)
