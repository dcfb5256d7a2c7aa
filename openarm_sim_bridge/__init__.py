# SPDX-License-Identifier: Apache-2.0
"""The simulated robot: MuJoCo world, controllers, cameras and fault injection; `ros/`: the node `mujoco_bridge`.

Example:
    >>> from openarm_common import RobotDescription, load_cameras, load_scene
    >>> from openarm_sim_bridge import PhysicsConfig, SimulatedRobot, Stage
    >>> stage = Stage(RobotDescription.load(), load_cameras(), mount_seed=None, physics=PhysicsConfig())
    >>> robot = SimulatedRobot.on(stage, load_scene("demo"))
    >>> robot.tick()
    >>> robot.world.t_ns
    10000000
"""

from typing import TYPE_CHECKING

from openarm_common.lazy import attach

if TYPE_CHECKING:
    from openarm_sim_bridge.cameras.cameras import SimulatedCameras
    from openarm_sim_bridge.cameras.renderer import SnapshotRenderer
    from openarm_sim_bridge.control.controller import RobotController
    from openarm_sim_bridge.faults.faults import Fault, checked_fault
    from openarm_sim_bridge.robot import SimulatedRobot
    from openarm_sim_bridge.simulation import Simulation
    from openarm_sim_bridge.world.export import render
    from openarm_sim_bridge.world.model import PhysicsConfig, compile_model
    from openarm_sim_bridge.world.stage import Stage
    from openarm_sim_bridge.world.world import World

__all__ = [
    "Fault",
    "PhysicsConfig",
    "RobotController",
    "SimulatedCameras",
    "SimulatedRobot",
    "Simulation",
    "SnapshotRenderer",
    "Stage",
    "World",
    "checked_fault",
    "compile_model",
    "render",
]

__getattr__, __dir__ = attach(__name__, __file__)
