# SPDX-License-Identifier: Apache-2.0
"""The motors of a robot's arms and what plans ask of its joints, as `robot.yaml` says it.

Numbers are by joint of an arm, from the shoulder, the same for every arm; N m, rad, s.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Self

from pydantic import Field, model_validator

from openarm_common.config import Config

Numbers = tuple[Annotated[float, Field(gt=0.0)], ...]
Range = tuple[Annotated[float, Field(ge=0.0)], Annotated[float, Field(ge=0.0)]]


class _ByJoint(Config):
    """Numbers by joint, as many in each row."""

    def rows(self) -> Iterator[tuple[str, Numbers]]:
        """Give the rows of numbers by name."""
        for name in type(self).model_fields:
            value = getattr(self, name)
            if isinstance(value, _ByJoint):
                yield from ((f"{name}.{inner}", row) for inner, row in value.rows())
            elif isinstance(value, tuple) and name not in {"friction"}:
                yield name, value

    @model_validator(mode="after")
    def _alike(self) -> Self:
        sizes = {name: len(row) for name, row in self.rows() if row}
        if len(set(sizes.values())) > 1:
            text = ", ".join(f"{name} has {size}" for name, size in sizes.items())
            raise ValueError(f"expected one number a joint in each row, got: {text}")
        return self


class JointMotion(_ByJoint):
    """What plans may ask of the joints at scale 1, far below what the motors can do.

    Attributes:
        velocity: rad/s.
        acceleration: rad/s2.
        jerk: rad/s3.
    """

    velocity: Numbers = Field(min_length=1)
    acceleration: Numbers = Field(min_length=1)
    jerk: Numbers = Field(min_length=1)


class Gains(_ByJoint):
    """Gains of position servos.

    Attributes:
        stiffness: Position gain, N m/rad.
        damping: Velocity gain, N m s/rad.
    """

    stiffness: Numbers = Field(min_length=1)
    damping: Numbers = Field(min_length=1)


class BusRange(_ByJoint):
    """Ranges that the numbers of a bus divide: 16 bits the position, 12 bits velocity and torque.

    Attributes:
        position: Position of every joint, +-rad.
        velocity: +-rad/s.
        torque: +-N m.
    """

    position: float = Field(gt=0.0)
    velocity: Numbers = Field(min_length=1)
    torque: Numbers = Field(min_length=1)


class Motors(_ByJoint):
    """Position servos of an arm as owners of the robot have them.

    Attributes:
        gains: Gains of the servos.
        stiff: Gains of the profile `ideal`.
        armature: Inertia of rotor and gear, kg m2.
        gravity_compensation: Share of the arms' weight that the motors carry by themselves.
        friction: Range of the dry friction of a joint, N m; 0, 0: as described.
        bus: Ranges of what is measured; None: exact.
    """

    gains: Gains
    stiff: Gains
    armature: Numbers = Field(min_length=1)
    gravity_compensation: float = Field(default=0.0, ge=0.0, le=1.0)
    friction: Range = (0.0, 0.0)
    bus: BusRange | None = None
