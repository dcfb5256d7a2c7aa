# SPDX-License-Identifier: Apache-2.0
"""The simulated robot: a world, its controllers and injected faults, one control tick at a time.

The node `mujoco_bridge` and campaigns in process run this same code; only who calls `tick`, and when, differs.
"""

from __future__ import annotations

from openarm_common.scene.scene import Scene
from openarm_common.types import Array
from openarm_sim_bridge.control.arm import TrajectoryConfig
from openarm_sim_bridge.control.controller import RobotController
from openarm_sim_bridge.control.gripper import GripperConfig
from openarm_sim_bridge.faults.world_faults import WorldFaults
from openarm_sim_bridge.world.stage import Stage
from openarm_sim_bridge.world.world import JointReadout, World


class SimulatedRobot:
    """A world with controllers and faults. One thread.

    Args:
        world: The world.
        controller: Of its joints.

    Attributes:
        faults: Injected faults of robot and world.
        state: Joint states at the beginning of the last tick.
        targets: (n,) actuator targets of the last tick, in the order of the world's joints.
    """

    def __init__(self, world: World, controller: RobotController) -> None:
        self.world = world
        self.controller = controller
        self.faults = WorldFaults(world.joint_names, world.period_ns)
        self.state: JointReadout = world.read_joints()
        self.targets: Array = self.state.position

    @classmethod
    def on(
        cls,
        stage: Stage,
        scene: Scene,
        trajectory: TrajectoryConfig | None = None,
        gripper: GripperConfig | None = None,
    ) -> SimulatedRobot:
        """Return the robot of a stage in a scene.

        Args:
            stage: Robot, cameras and physics.
            scene: Table and objects.
            trajectory: How arms follow trajectories; None is the defaults.
            gripper: How grippers move; None is the defaults.

        Raises:
            OpenArmError: CONFIG_INVALID, when the model can't be built.
        """
        world = stage.world(scene)
        controller = RobotController(
            stage.arms(), stage.grippers(), world, trajectory or TrajectoryConfig(), gripper or GripperConfig()
        )
        return cls(world, controller)

    def tick(self, steps: int | None = None) -> None:
        """Compute the targets of a control tick and advance the world.

        Args:
            steps: Physics steps; None is a whole tick.

        Raises:
            OpenArmError: INTERNAL, when the physics diverged; the world must be reset then.
        """
        world, controller, faults = self.world, self.controller, self.faults
        steps = world.steps_per_tick if steps is None else steps
        faults.prepare(world)
        self.state = world.read_joints()
        wanted = controller.update(self.state, steps * world.timestep_ns)
        self.targets = faults.targets(wanted).copy()
        world.set_targets(self.targets)
        world.set_effort_limits(faults.effort_limits(controller.effort_limits()))
        world.step(steps)

    def restart(self) -> None:
        """Forget goals and hold, because the world was reset or exchanged."""
        self.controller.reset(self.world.read_joints())
