# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node `arm_control`."""

from __future__ import annotations

from pydantic import Field

from openarm_common.config import Config
from openarm_control.arm import TrajectoryConfig
from openarm_control.gripper import GripperAction, GripperConfig
from openarm_control.servos import ServoConfig


class RobotTopics(Config):
    """Topics of the robot's driver; {arm} stands for left or right."""

    arm: str = Field(
        default="/{arm}_joint_trajectory_controller/joint_trajectory", description="position commands of an arm"
    )
    gripper: str = Field(
        default="/{arm}_gripper_controller/joint_trajectory", description="position commands of a gripper"
    )


class ArmControlConfig(Config):
    """How a robot is commanded whose driver takes positions alone."""

    calibrations: str = Field(
        default="", description="folder of calibrations, which holds identified servos; empty: the default one"
    )
    dynamics_seed: int = Field(
        default=-1, ge=-1, description="of the simulated robot that identified servos must be of; -1: of a real one"
    )
    stale_after: float = Field(
        default=0.2, gt=0.02, le=5.0, description="age of joint states from which on nothing is commanded, s"
    )
    thread_priority: int = Field(
        default=50, ge=0, le=99, description="of the process under SCHED_FIFO, where the system allows it; 0: ordinary"
    )
    gripper_action: GripperAction = Field(
        default="parallel", description="type of gripper_cmd: ParallelGripperCommand, or the older GripperCommand"
    )
    topics: RobotTopics = RobotTopics()
    servos: ServoConfig = ServoConfig()
    trajectory: TrajectoryConfig = TrajectoryConfig()
    gripper: GripperConfig = GripperConfig()
