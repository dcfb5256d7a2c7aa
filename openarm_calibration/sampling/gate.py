# SPDX-License-Identifier: Apache-2.0
"""Which image may be paired with which joint state.

The stamp of the image is the base. A joint state counts within 5 ms of it, or between two that bracket it, and only
while the robot is at rest: 5 ms at 0.25 m/s are a millimetre and more. Nothing is ever paired with "the latest".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.robot_state import RobotStateBuffer


class GateConfig(Config):
    """When a robot counts as at rest."""

    max_speed: float = Field(default=0.005, gt=0.0, description="of any joint that moves camera or board, rad/s")
    window: float = Field(default=0.2, gt=0.0, le=2.0, description="before the image in which the speed is measured, s")
    track: float = Field(default=0.15, ge=0.0, le=2.0, description="of joint states kept around the image, s")


@dataclass(frozen=True)
class Matched:
    """The robot at the stamp of an image.

    Args:
        joints: Positions, rad or m.
        t_joints_ns: Stamp of the nearest joint state.
        speed: Largest of the joints that count, rad/s.
        track: Joint states around the image.
    """

    joints: Mapping[str, float]
    t_joints_ns: int
    speed: float
    track: tuple[tuple[int, Mapping[str, float]], ...] = field(default=())


def match(
    buffer: RobotStateBuffer, t_image_ns: int, names: tuple[str, ...], config: GateConfig, *, moving: bool = False
) -> Matched:
    """Pair an image with the robot.

    Args:
        buffer: Joint states.
        t_image_ns: Stamp of the image.
        names: Joints that move camera or board.
        config: The gate.
        moving: Whether a moving robot is accepted (samples for the delay of the images).

    Raises:
        OpenArmError: STALE_DATA, with the gap in ms; MOVING, with the joint and its speed.
    """
    joints = buffer.joints_at(t_image_ns)
    missing = [name for name in names if name not in joints]
    if missing:
        raise OpenArmError(
            Code.STALE_DATA, f"/joint_states lacks {', '.join(missing)}; it has {', '.join(sorted(joints))}"
        )
    margin = round(config.track * 1e9)
    around = buffer.between(t_image_ns - margin, t_image_ns + margin)
    before = buffer.between(t_image_ns - round(config.window * 1e9), t_image_ns + margin)
    nearest = min(buffer.between(t_image_ns - 10**9, t_image_ns + 10**9), key=lambda state: abs(state[0] - t_image_ns))
    speed, fastest = _speed([*before, (t_image_ns, joints)], names)
    if len(before) < 2 and not moving:
        raise OpenArmError(
            Code.STALE_DATA,
            f"{len(before)} joint states in the {config.window:g} s before the image, at least 2 are needed to see"
            " whether the robot is at rest; wait and take the sample again",
        )
    if speed > config.max_speed and not moving:
        raise OpenArmError(
            Code.MOVING,
            f"the robot moves: {fastest} at {speed:.3f} rad/s, at most {config.max_speed:g} rad/s while a sample is"
            " taken; wait until it is at rest",
        )
    return Matched(joints, nearest[0], speed, tuple(around))


def _speed(states: list[tuple[int, dict[str, float]]], names: tuple[str, ...]) -> tuple[float, str]:
    """Return the largest range of a joint over the states by their duration, and the joint."""
    times = [t for t, _ in states]
    span = (max(times) - min(times)) * 1e-9
    if span <= 0.0 or not names:
        return 0.0, ""
    values = np.array([[state.get(name, np.nan) for name in names] for _, state in states])
    ranges = np.nanmax(values, axis=0) - np.nanmin(values, axis=0)
    k = int(np.argmax(ranges))
    return float(ranges[k]) / span, names[k]
