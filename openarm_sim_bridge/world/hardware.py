# SPDX-License-Identifier: Apache-2.0
"""The motors of a robot and how it differs from its description: gains, friction, latency, encoders, masses, hands.

A profile says what is possible, `drawn` makes one robot of it by seeds. Arrays (n,) are in the order of `joints`: the
arm joints of both sides. N m, rad, s.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from pydantic import Field

from openarm_common.robot.description import RobotDescription
from openarm_common.robot.motors import BusRange
from openarm_common.types import Array
from openarm_control.servos import ServoConfig

Share = Annotated[float, Field(ge=0.0, le=0.5)]
#: Shares of the drawn opening at which fingers stop, closed and open, and friction of their drive, N: from and to.
_CLOSED, _OPENED, _FRICTION = (0.0, 0.045), (0.82, 1.0), (0.0, 2.0)


class HardwareConfig(ServoConfig):
    """Motors of the arms, and by how much a robot differs from its description; by default as owners have them."""

    gain_error: Share = Field(default=0.0, description="gains and damping differ by this share, up or down")
    mass_error: Share = Field(default=0.05, description="masses of links differ by this share, up or down")
    # what a zero calibration leaves
    zero_rms: float = Field(default=0.1, ge=0.0, le=10.0, description="error of the joint zeros, deg rms")
    quantized: bool = Field(
        default=True, description="position of 16 bits, velocity and torque of 12 bits, where the robot has such a bus"
    )
    tool_stiffness: float = Field(
        default=300.0, ge=0.0, description="of the hand on the wrist about its x and y axes, N m/rad; 0: rigid"
    )
    dynamics_seed: int = Field(default=1, ge=0, description="of friction, latency, gains and masses")
    zero_seed: int = Field(default=1, ge=0, description="of the joint zeros")
    hand_seed: int = Field(
        default=-1, ge=-1, description="of the stops and the friction of the fingers; -1: those of the drawing"
    )

    def of_seed(self, seed: int | None, hand_seed: int | None = None) -> Self:
        """Return it with one seed of all draws but those of the hands, and theirs; None: that of the configuration."""
        update = {} if seed is None else {"dynamics_seed": seed, "zero_seed": seed}
        return self.model_copy(update=update | ({} if hand_seed is None else {"hand_seed": hand_seed}))


#: Stiff servos that carry the arms and know where they are.
IDEAL = HardwareConfig(
    stiff=True,
    gravity_compensation=1.0,
    friction=(0.0, 0.0),
    latency=(0.0, 0.0),
    mass_error=0.0,
    zero_rms=0.0,
    quantized=False,
    tool_stiffness=0.0,
)


@dataclass(frozen=True, eq=False)
class Encoders:
    """How commands and states of joints differ from the truth; arrays (n,), in the order of the joints.

    Attributes:
        zero: Offset that is added to true positions, rad.
        position, velocity, effort: Steps of the numbers on the bus; 0: exact.
        latency_s: Until a command takes effect.
    """

    zero: Array
    position: Array
    velocity: Array
    effort: Array
    latency_s: Array

    @classmethod
    def exact(cls, n: int) -> Encoders:
        """Return those that say and take what is."""
        return cls(*np.zeros((5, n)))


@dataclass(frozen=True)
class FingerStops:
    """Where the fingers of a hand stop, m from its middle, and friction of their drive, N."""

    closed: float
    opened: float
    friction: float


@dataclass(frozen=True, eq=False)
class Hardware:
    """One robot as it is; arrays by arm joint name."""

    stiffness: Mapping[str, float]
    damping: Mapping[str, float]
    armature: Mapping[str, float]
    #: By which the damping of the description is multiplied.
    gearbox: Mapping[str, float]
    #: N m; where there is none, that of the description.
    friction: Mapping[str, float]
    zero: Mapping[str, float]
    latency_s: Mapping[str, float]
    #: Scale of mass and inertia, by link.
    mass: Mapping[str, float]
    gravity_compensation: float
    tool_stiffness: float
    bus: BusRange | None
    #: By arm; where there are none, the limits of the description.
    fingers: Mapping[str, FingerStops]

    def encoders(self, description: RobotDescription, joint_names: tuple[str, ...]) -> Encoders:
        """Return what commands and states of joints go through; fingers are exact but for their latency."""
        steps = dict.fromkeys(joint_names, (0.0, 0.0, 0.0))
        if self.bus is not None:
            for arm in description.arms.values():
                for i, name in enumerate(arm.joints):
                    steps[name] = (
                        2.0 * self.bus.position / (2.0**16 - 1.0),
                        2.0 * self.bus.velocity[i] / (2.0**12 - 1.0),
                        2.0 * self.bus.torque[i] / (2.0**12 - 1.0),
                    )
        position, velocity, effort = np.array([steps[name] for name in joint_names]).T
        arm_latency = {
            name: self.latency_s[arm.joints[0]] for arm in description.arms.values() for name in arm.controlled
        }
        return Encoders(
            zero=np.array([self.zero.get(name, 0.0) for name in joint_names]),
            position=position,
            velocity=velocity,
            effort=effort,
            latency_s=np.array([arm_latency.get(name, 0.0) for name in joint_names]),
        )


def drawn(config: HardwareConfig, description: RobotDescription) -> Hardware:
    """Return the robot of the seeds of a profile.

    Args:
        config: Ranges of what is drawn.
        description: The robot.

    Raises:
        OpenArmError: CONFIG_INVALID, when the profile does not fit the arms.
    """
    config = config.of(description)
    arms = description.arms
    joints = tuple(name for arm in arms.values() for name in arm.joints)
    rng = np.random.default_rng([config.dynamics_seed, 901])
    zeros = np.random.default_rng([config.zero_seed, 902])

    def either(share: float, n: int) -> Array:
        return 1.0 + share * rng.choice((-1.0, 1.0), n)

    def named(values: Array) -> dict[str, float]:
        return dict(zip(joints, np.asarray(values, dtype=np.float64).tolist(), strict=True))

    fingers = dict[str, FingerStops]()
    hands = np.random.default_rng([config.hand_seed + 1, 903])
    for arm, hand in description.hands.items() if config.hand_seed >= 0 else ():
        closed, opened = (hand.parts.opening * hands.uniform(*share) for share in (_CLOSED, _OPENED))
        fingers[arm] = FingerStops(closed, opened, hands.uniform(*_FRICTION))
    n = len(joints)
    stiffness, damping, gearbox = (either(config.gain_error, n) for _ in range(3))
    dry = config.friction or (0.0, 0.0)
    friction = rng.uniform(*dry, n)
    latency = np.repeat(rng.uniform(*config.latency, len(arms)), n // len(arms))
    links = [link for name in arms for link in description.links_of(name)]
    mass = dict(zip(links, either(config.mass_error, len(links)).tolist(), strict=True))
    return Hardware(
        stiffness=named(np.tile(config.stiffness, len(arms)) * stiffness),
        damping=named(np.tile(config.damping, len(arms)) * damping),
        armature=named(np.tile(config.armature, len(arms))),
        gearbox=named(gearbox),
        friction=named(friction) if dry[1] > 0.0 else {},
        zero=named(np.radians(config.zero_rms) * zeros.standard_normal(n)),
        latency_s=named(latency),
        mass=mass,
        gravity_compensation=config.gravity_compensation or 0.0,
        tool_stiffness=config.tool_stiffness,
        bus=description.motors.bus if config.quantized and description.motors else None,
        fingers=fingers,
    )
