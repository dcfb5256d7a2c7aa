# SPDX-License-Identifier: Apache-2.0
"""How the simulated robot is met: by controllers of this suite, by those of openarm_ros2, or by its motors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from openarm_common.motors.bus import emulated_buses
from openarm_common.ros.node import BaseNode
from openarm_control.controller import JointController
from openarm_control.joints import JointReadout
from openarm_control.ros.controllers import Controllers
from openarm_control.servos import KnownServos
from openarm_sim_bridge.config import BridgeConfig
from openarm_sim_bridge.motors import EmulatedRobot
from openarm_sim_bridge.openarm_ros2 import OpenArmRos2, activate
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.ros.openarm_ros2_server import PositionControllerServer
from openarm_sim_bridge.ros.sensor_publisher import SensorPublisher
from openarm_sim_bridge.simulation import Simulation
from openarm_sim_bridge.world.stage import Stage
from openarm_sim_bridge.world.world import World


class Face(ABC):
    """Controllers of a world, and how they are met.

    Attributes:
        controller: Controller of all joints.
        wall_stamps: Stamps are of the wall clock, and there is no /clock.
    """

    controller: JointController
    wall_stamps = False
    #: Joint states and frames are published.
    speaks = True

    @abstractmethod
    def serve(self, simulation: Simulation) -> None:
        """Offer actions and topics."""

    @abstractmethod
    def publish(self, state: JointReadout, world: World) -> JointReadout:
        """Publish the end of a tick, in the thread of the simulation; return the joint states as they are published."""

    @abstractmethod
    def values(self) -> Mapping[str, object]:
        """Return what /diagnostics says of it; once a second."""

    @abstractmethod
    def close(self) -> None:
        """Take actions and topics away."""


class SuiteFace(Face):
    """Controllers that carry the arms, follow trajectories and watch tolerances; with sensors at the hands.

    Args:
        node: Owner.
        config: Parameters.
        stage: Stage of the world.
        world: The world.
    """

    def __init__(self, node: BaseNode[Any], config: BridgeConfig, stage: Stage, world: World) -> None:
        self._node, self._config = node, config
        seed = config.hardware.dynamics_seed
        self._servos = KnownServos(stage.servos, config.calibrations, seed, node.get_logger().warning)
        self._robot = SimulatedRobot.controllers(stage, world, config.trajectory, config.gripper, self._servos.models)
        self.controller = self._robot

    def serve(self, simulation: Simulation) -> None:
        """See `Face.serve`."""
        self._sensors = SensorPublisher(self._node, self._node.description)
        self._controllers = Controllers(self._node, simulation, self._robot, self._servos, self._config.gripper_action)

    def publish(self, state: JointReadout, world: World) -> JointReadout:
        """See `Face.publish`."""
        self._sensors.publish(world)
        self._controllers.publish_states()
        return state

    def values(self) -> Mapping[str, object]:
        """See `Face.values`."""
        return self._controllers.values()

    def close(self) -> None:
        """See `Face.close`."""
        self._controllers.destroy()


class OpenArmRos2Face(Face):
    """The controllers of openarm_ros2, after its hardware interface was activated.

    Args:
        node: Owner.
        stage: Stage of the world.
        world: The world.

    Raises:
        OpenArmError: INTERNAL, when the physics diverged.
    """

    wall_stamps = True

    def __init__(self, node: BaseNode[Any], stage: Stage, world: World) -> None:
        self._node = node
        world.reset(stage.posture("zero"))  # arms without power hang
        activate(world)
        self.controller = self._robot = OpenArmRos2(node.description, world.joint_names, world.read_joints())

    def serve(self, simulation: Simulation) -> None:
        """See `Face.serve`."""
        self._servers = [
            PositionControllerServer(self._node, name, controller, simulation)
            for name, controller in self._robot.controllers.items()
        ]

    def publish(self, state: JointReadout, world: World) -> JointReadout:
        """See `Face.publish`."""
        for server in self._servers:
            server.publish_state(state.t_ns)
        return self._robot.reported(state)

    def values(self) -> Mapping[str, object]:
        """See `Face.values`."""
        return {}

    def close(self) -> None:
        """See `Face.close`."""
        for server in self._servers:
            server.destroy()


class MotorFace(Face):
    """No controllers: motors take frames from local sockets, and arms hang until a client commands them.

    Args:
        node: Owner.
        config: Parameters.
        stage: Stage of the world.
        world: The world.

    Raises:
        OpenArmError: CONFIG_INVALID, when the robot's motors are not known; ENVIRONMENT, when a socket can't be made.
    """

    wall_stamps = True
    speaks = False

    def __init__(self, node: BaseNode[Any], config: BridgeConfig, stage: Stage, world: World) -> None:
        world.reset(stage.posture("zero"))  # arms without power hang
        buses = emulated_buses(node.context.get_domain_id(), node.description.arm_names, config.motor_sockets)
        self.controller = self._robot = EmulatedRobot(node.description, world, buses)

    def serve(self, simulation: Simulation) -> None:
        """See `Face.serve`."""
        simulation.faults.motors = self._robot.buses

    def publish(self, state: JointReadout, world: World) -> JointReadout:
        """See `Face.publish`."""
        return state

    def values(self) -> Mapping[str, object]:
        """See `Face.values`."""
        on = sum(motor.on for motor in self._robot.buses.motors)
        return {"motors_on": on, "motor_commands": sum(motor.commands for motor in self._robot.buses.motors)}

    def close(self) -> None:
        """See `Face.close`."""
        self._robot.close()
