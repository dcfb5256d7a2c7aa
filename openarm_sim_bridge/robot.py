# SPDX-License-Identifier: Apache-2.0
"""The simulated robot: a world, its controllers and injected faults, one control tick at a time.

The node `mujoco_bridge` and campaigns in process run this same code; only who calls `tick`, and when, differs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Generic, TypeVar

from openarm_common.robot.description import RobotDescription
from openarm_common.robot.servos import ServoModel
from openarm_common.scene.scene import Scene
from openarm_common.types import Array
from openarm_control.arm import TrajectoryConfig
from openarm_control.controller import JointController, RobotController
from openarm_control.gripper import GripperConfig
from openarm_control.joints import JointReadout, arm_groups, carriers, gripper_groups, lift_carriers, lift_group
from openarm_sim_bridge.faults.world_faults import WorldFaults
from openarm_sim_bridge.world.stage import Stage
from openarm_sim_bridge.world.world import World

ControllerT = TypeVar("ControllerT", bound=JointController, covariant=True)


class SimulatedRobot(Generic[ControllerT]):
    """A world with controllers and faults. One thread.

    Args:
        description: The robot.
        world: The world.
        controller: Controller of its joints.

    Attributes:
        faults: Injected faults of robot and world.
        state: Joint states at the beginning of the last tick.
        targets: (n,) actuator targets of the last tick, in the order of the world's joints.
    """

    def __init__(self, description: RobotDescription, world: World, controller: ControllerT) -> None:
        self.world = world
        self.controller = controller
        self.faults = WorldFaults(description, world.joint_names)
        self.state: JointReadout = world.read_joints()
        self.targets: Array = self.state.position

    @staticmethod
    def on(
        stage: Stage,
        scene: Scene,
        trajectory: TrajectoryConfig | None = None,
        gripper: GripperConfig | None = None,
        servos: Mapping[str, ServoModel] | None = None,
    ) -> SimulatedRobot[RobotController]:
        """Return the robot of a stage in a scene.

        Args:
            stage: Robot, cameras and physics.
            scene: Table and objects.
            trajectory: Settings of how arms follow trajectories; None is the defaults.
            gripper: Settings of how grippers move; None is the defaults.
            servos: Servos of the arms as identified, by side; None is what the profile says of them.

        Raises:
            OpenArmError: CONFIG_INVALID, when the model can't be built.
        """
        world = stage.world(scene)
        controllers = SimulatedRobot.controllers(stage, world, trajectory or TrajectoryConfig(), gripper, servos)
        return SimulatedRobot(stage.description, world, controllers)

    @staticmethod
    def controllers(
        stage: Stage,
        world: World,
        trajectory: TrajectoryConfig,
        gripper: GripperConfig | None = None,
        servos: Mapping[str, ServoModel] | None = None,
    ) -> RobotController:
        """Return the controllers of a world of a stage; arguments as `on`."""
        description, limits = stage.description, world.effort_limits()
        fingers = {arm: world.joint_names.index(description.finger_joint(arm)) for arm in description.arm_names}
        return RobotController(
            arm_groups(description) | lift_group(description),
            gripper_groups(description),
            world.joint_names,
            world.read_joints(),
            {arm: float(limits[finger]) for arm, finger in fingers.items()},
            trajectory,
            gripper or GripperConfig(),
            carriers(description, trajectory.carrier, stage.servos if servos is None else servos)
            | lift_carriers(description, trajectory.carrier),
        )

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
