# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node `openarm_hardware`."""

from __future__ import annotations

from pydantic import Field

from openarm_common.config import Config
from openarm_control.arm import TrajectoryConfig
from openarm_control.gripper import GripperAction, GripperConfig
from openarm_control.servos import ServoConfig
from openarm_hardware.settings import Settings

_DEFAULT = Settings()


class MotorConfig(Config):
    """How the motors are commanded and watched."""

    rate: float = Field(default=250.0, ge=50.0, le=1000.0, description="of the commands, Hz")
    thread_priority: int = Field(
        default=_DEFAULT.priority,
        ge=0,
        le=98,
        description="of the process that commands the motors under SCHED_FIFO, where the system allows it; 0: ordinary",
    )
    silent: int = Field(default=_DEFAULT.silent, ge=1, le=250, description="replies left out in a row that stop an arm")
    stale: float = Field(
        default=_DEFAULT.stale_s, gt=0.01, le=5.0, description="age of commands from which on the arms hold, s"
    )
    jump: float = Field(default=_DEFAULT.jump, gt=0.0, le=1.0, description="largest step of a joint's commands, rad")
    tracking: float = Field(
        default=_DEFAULT.tracking, gt=0.0, le=2.0, description="largest distance of a joint from its command, rad"
    )
    posture: float = Field(
        default=_DEFAULT.posture,
        gt=0.0,
        le=7.0,
        description="a joint that is this much elsewhere than when it was last seen has a wrong zero, rad",
    )
    hot: int = Field(default=_DEFAULT.hot, ge=40, le=120, description="temperature at which the arms hold, °C")
    ramp: float = Field(default=_DEFAULT.ramp_s, ge=0.1, le=10.0, description="time in which the gains rise, s")
    timeout: float = Field(
        default=_DEFAULT.timeout_s,
        gt=0.02,
        le=5.0,
        description="motors switch themselves off when no command came for so long, s",
    )
    orphan: float = Field(
        default=_DEFAULT.orphan_s, ge=0.0, le=600.0, description="arms are held for so long without this node, s"
    )

    def settings(self, *, flexible: bool) -> Settings:
        """Return what the process of the servo takes.

        Args:
            flexible: Whether frames are sent as CAN FD.
        """
        return Settings(
            period_s=1.0 / self.rate,
            priority=self.thread_priority,
            flexible=flexible,
            stale_s=self.stale,
            silent=self.silent,
            jump=self.jump,
            tracking=self.tracking,
            posture=self.posture,
            hot=self.hot,
            ramp_s=self.ramp,
            timeout_s=self.timeout,
            orphan_s=self.orphan,
        )


class HardwareNodeConfig(Config):
    """Motors of a robot, and the controllers before them."""

    emulated: bool = Field(default=False, description="whether the motors are those of the simulated robot")
    motor_sockets: str = Field(
        default="", description="folder of the sockets of emulated motors; empty: by the ROS domain, without files"
    )
    calibrations: str = Field(
        default="",
        description="folder of calibrations, which holds identified servos and where the joints were last seen;"
        " empty: the default one",
    )
    dynamics_seed: int = Field(
        default=-1, ge=-1, description="of the simulated robot that identified servos must be of; -1: of a real one"
    )
    stale_after: float = Field(
        default=0.2, gt=0.02, le=5.0, description="age of joint states from which on nothing is commanded, s"
    )
    thread_priority: int = Field(
        default=50, ge=0, le=99, description="of this process under SCHED_FIFO, where the system allows it; 0: ordinary"
    )
    tf_rate: float = Field(default=50.0, gt=0.0, le=100.0, description="of /tf, Hz")
    gripper_action: GripperAction = Field(
        default="parallel", description="type of gripper_cmd: ParallelGripperCommand, or the older GripperCommand"
    )
    motors: MotorConfig = MotorConfig()
    servos: ServoConfig = ServoConfig()
    trajectory: TrajectoryConfig = TrajectoryConfig()
    gripper: GripperConfig = GripperConfig()
