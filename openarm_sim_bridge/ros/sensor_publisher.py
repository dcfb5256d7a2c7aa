# SPDX-License-Identifier: Apache-2.0
"""Publishing the sensors: wrench and IMU at each hand, and the contact force on each finger pad."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import Imu

from openarm_common.pacing import RateDivider
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import ns_to_stamp, vector
from openarm_common.ros.node import QOS_SENSOR
from openarm_common.types import Array
from openarm_sim_bridge.world.world import World

#: Rate at which subscribers are counted, Hz.
_COUNT_RATE = 5.0


@dataclass
class _Sensor:
    publisher: Publisher
    frame: str
    read: Callable[[World, str], WrenchStamped | Imu]
    wanted: bool = False


class SensorPublisher:
    """Topics of the sensors, each only while it has subscribers; 100 Hz of simulated time.

    Args:
        node: Owner of the publishers.
        description: The robot.
    """

    def __init__(self, node: Node, description: RobotDescription) -> None:
        self._count = RateDivider(_COUNT_RATE)
        self._sensors: list[_Sensor] = []
        for name, arm in description.arms.items():
            topics = [
                (WrenchStamped, f"/{name}_force_torque_sensor_broadcaster/wrench", arm.hand, _wrist_wrench),
                (Imu, f"/{name}_imu_sensor_broadcaster/imu", arm.hand, _imu),
                *((WrenchStamped, f"/{link}/contact_wrench", link, _pad_wrench) for link in arm.fingers),
            ]
            for kind, topic, link, read in topics:
                self._sensors.append(_Sensor(node.create_publisher(kind, topic, QOS_SENSOR), link, read))

    def publish(self, world: World) -> None:
        """Publish a tick; in the thread of the simulation."""
        if self._count.due(world.t_ns):
            for sensor in self._sensors:
                sensor.wanted = sensor.publisher.get_subscription_count() > 0
        for sensor in self._sensors:
            if sensor.wanted:
                message = sensor.read(world, sensor.frame)
                message.header.frame_id = sensor.frame
                message.header.stamp = ns_to_stamp(world.t_ns)
                sensor.publisher.publish(message)


def _wrist_wrench(world: World, link: str) -> WrenchStamped:
    return _wrench(*world.wrist_wrench(link))


def _pad_wrench(world: World, link: str) -> WrenchStamped:
    return _wrench(*world.pad_wrench(link))


def _wrench(force: Array, torque: Array) -> WrenchStamped:
    message = WrenchStamped()
    message.wrench.force, message.wrench.torque = vector(force), vector(torque)
    return message


def _imu(world: World, link: str) -> Imu:
    rate, acceleration = world.imu(link)
    message = Imu(angular_velocity=vector(rate), linear_acceleration=vector(acceleration))
    message.orientation_covariance[0] = -1.0  # it does not know its orientation
    return message
