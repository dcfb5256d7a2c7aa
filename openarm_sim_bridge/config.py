# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node `mujoco_bridge`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, field_validator

from openarm_common.config import Config
from openarm_control.arm import TrajectoryConfig
from openarm_control.gripper import GripperAction, GripperConfig
from openarm_sim_bridge.cameras.noise import ColourNoiseConfig, DepthNoiseConfig
from openarm_sim_bridge.world.hardware import IDEAL, HardwareConfig
from openarm_sim_bridge.world.model import PhysicsConfig

Profile = Literal["ideal", "openarm"]
FaceName = Literal["suite", "openarm_ros2", "motors"]


class BridgeConfig(Config):
    """What is simulated, and how it is published."""

    scene: str = Field(default="demo", min_length=1, description="name or path of a scene, or random")
    seed: int = Field(default=0, ge=0, description="of a random scene")
    mount_seed: int = Field(
        default=-1, ge=-1, description="of the errors of the simulated camera mounts; -1 or none: nominal mounts"
    )
    profile: Profile = Field(
        default="openarm",
        description="motors of the arms: as owners have them; ideal: stiff servos that carry their weight",
    )
    controllers: FaceName = Field(
        default="suite",
        description="suite: those of this suite; openarm_ros2: as owners run them, which take positions alone; motors:"
        " none, motors behind local sockets take frames of their buses. But for suite there are no sensors and no"
        " /clock, and stamps are of the wall clock",
    )
    motor_sockets: str = Field(
        default="",
        description="folder of the motors' sockets, one of each arm; empty: by the ROS domain, without files",
    )
    calibrations: str = Field(
        default="", description="folder of calibrations, which holds identified servos; empty: the default one"
    )
    cameras: str = Field(default="", description="path of a cameras YAML; empty: that of the robot's folder")
    depth_encoding: Literal["16UC1", "32FC1"] = Field(default="16UC1", description="whole millimetres, or metres")
    images: bool = Field(default=True, description="whether there are cameras; false saves their process")
    speed: float = Field(
        default=1.0, ge=0.0, le=100.0, description="simulated seconds per second; 0: as fast as possible"
    )
    thread_priority: int = Field(
        default=50, ge=0, le=99, description="of the process under SCHED_FIFO, where the system allows it; 0: ordinary"
    )
    paused: bool = Field(default=False, description="start with simulated time paused")
    tf_rate: float = Field(default=50.0, gt=0.0, le=100.0, description="of /tf, Hz of simulated time")
    ground_truth_rate: float = Field(
        default=20.0, gt=0.0, le=100.0, description="of /sim/ground_truth/objects, Hz of simulated time"
    )
    gripper_action: GripperAction = Field(
        default="parallel", description="type of gripper_cmd: ParallelGripperCommand, or the older GripperCommand"
    )
    depth_noise: DepthNoiseConfig = DepthNoiseConfig()
    colour_noise: ColourNoiseConfig = ColourNoiseConfig()
    physics: PhysicsConfig = PhysicsConfig()
    ideal: HardwareConfig = IDEAL
    openarm: HardwareConfig = HardwareConfig()
    trajectory: TrajectoryConfig = TrajectoryConfig()
    gripper: GripperConfig = GripperConfig()

    @field_validator("ideal", mode="before")
    @classmethod
    def _others_are_ideal(cls, value: Any) -> Any:
        return {**IDEAL.model_dump(), **value} if isinstance(value, Mapping) else value

    @field_validator("mount_seed", mode="before")
    @classmethod
    def _none_is_nominal(cls, value: Any) -> Any:
        return -1 if value is None or value == "none" else value

    @property
    def hardware(self) -> HardwareConfig:
        """Motors of the profile."""
        return self.openarm if self.profile == "openarm" else self.ideal
