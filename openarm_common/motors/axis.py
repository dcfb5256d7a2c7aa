# SPDX-License-Identifier: Apache-2.0
"""One motor and its joint, as plain data: of what a process reads that imports little."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Axis:
    """One motor and its joint. Of the joint: rad (m of a finger that slides), rad/s, N m.

    Attributes:
        joint: Its name.
        arm: Arm whose it is.
        bus: Address.
        id: Id of frames to it.
        reply_id: Id of frames from it.
        type: Type of the motor.
        ratio: Motor position by joint position; negative where they turn against each other.
        offset: Motor position where the joint is at 0, rad.
        lower, upper: Limits of the joint.
        speed: Largest of the joint.
        kp, kd: Gains of its MIT commands; 0 of a gripper.
        damping: kd with which it stops softly.
        torque: Largest of the motor, N m.
        grips: Commanded by POS_FORCE instead of MIT.
        unit: Unit of the joint's position, rad or m.
    """

    joint: str
    arm: str
    bus: str
    id: int
    reply_id: int
    type: str
    ratio: float
    offset: float
    lower: float
    upper: float
    speed: float
    kp: float
    kd: float
    damping: float
    torque: float
    grips: bool
    unit: str = "rad"

    def __str__(self) -> str:
        return f"{self.joint} (motor {self.id:#04x} of {self.bus})"
