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
    from openarm_sim_bridge.cameras.cameras import SimulatedCameras as SimulatedCameras
    from openarm_sim_bridge.cameras.renderer import SnapshotRenderer as SnapshotRenderer
    from openarm_sim_bridge.faults.faults import Fault as Fault
    from openarm_sim_bridge.faults.faults import checked_fault as checked_fault
    from openarm_sim_bridge.robot import SimulatedRobot as SimulatedRobot
    from openarm_sim_bridge.simulation import Simulation as Simulation
    from openarm_sim_bridge.world.export import render as render
    from openarm_sim_bridge.world.model import PhysicsConfig as PhysicsConfig
    from openarm_sim_bridge.world.model import compile_model as compile_model
    from openarm_sim_bridge.world.stage import Stage as Stage
    from openarm_sim_bridge.world.world import World as World

__getattr__, __dir__ = attach(__name__, __file__)
