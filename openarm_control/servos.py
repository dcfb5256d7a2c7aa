# SPDX-License-Identifier: Apache-2.0
"""What is known of the servos of the arms: as configured, or as identified of this robot and stored.

Values are by joint of an arm, from the shoulder; N m, rad, s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, field_validator

from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.records import RecordStore, default_folder
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.motors import Gains, Numbers, Range
from openarm_common.robot.servo_store import StoredServos
from openarm_common.robot.servos import ArmLoad, ServoModel


class ServoConfig(Config):
    """Motors of the arms, by default as `robot.yaml` says that owners of the robot have them."""

    stiffness: Numbers = Field(default=(), description="position gains, N m/rad; empty: the robot's")
    damping: Numbers = Field(default=(), description="velocity gains, N m s/rad; empty: the robot's")
    armature: Numbers = Field(default=(), description="inertia of rotor and gear, kg m2; empty: the robot's")
    stiff: bool = Field(default=False, description="gains that are not given are those of the robot's stiff servos")
    gravity_compensation: Annotated[float, Field(ge=0.0, le=1.0)] | None = Field(
        default=None, description="share of the arms' weight that the motors carry by themselves; none: the robot's"
    )
    friction: Range | None = Field(
        default=None, description="range of the dry friction of a joint, N m; 0, 0: as described; none: the robot's"
    )
    # one to five cycles of a CAN loop at 500 Hz
    latency: Range = Field(default=(0.002, 0.010), description="range of the time until a command takes effect, s")

    @field_validator("friction", "latency")
    @classmethod
    def _in_order(cls, value: Range | None) -> Range | None:
        if value is not None and value[0] > value[1]:
            raise ValueError("expected the lower end first")
        return value

    def of(self, robot: RobotDescription) -> Self:
        """Return it with what it leaves to the robot.

        Raises:
            OpenArmError: CONFIG_INVALID, when a row does not fit the arms, or `robot.yaml` does not say the motors.
        """
        said = robot.motors
        left = None in (self.gravity_compensation, self.friction)
        if said is None and (left or not (self.stiffness and self.damping and self.armature)):
            text = f"robot.yaml of {robot.name!r} lacks `motors`, which says what drives the arms"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        gains = Gains(stiffness=(1.0,), damping=(1.0,)) if said is None else said.stiff if self.stiff else said.gains
        rows = {
            "stiffness": self.stiffness or gains.stiffness,
            "damping": self.damping or gains.damping,
            "armature": self.armature or getattr(said, "armature", ()),
        }
        for name, arm in robot.arms.items():
            for key, row in rows.items():
                if len(row) != len(arm.joints):
                    text = f"{key} has {len(row)} numbers, arm {name!r} has {len(arm.joints)} joints"
                    raise OpenArmError(Code.CONFIG_INVALID, text)
        if said is None:
            return self
        carried, friction = self.gravity_compensation, self.friction
        whole = {
            "gravity_compensation": said.gravity_compensation if carried is None else carried,
            "friction": said.friction if friction is None else friction,
        }
        return self.model_copy(update=rows | whole)

    def model(self, robot: RobotDescription, load: ArmLoad) -> ServoModel:
        """Return the servos of an arm of a robot, as a client knows them that has not identified them."""
        known = self.of(robot)
        return ServoModel(
            stiffness=np.array(known.stiffness),
            damping=np.array(known.damping) + load.damping,
            friction=np.maximum(load.friction, np.mean(known.friction or 0.0)),
            armature=np.array(known.armature),
            latency_s=np.full(len(known.stiffness), float(np.mean(known.latency))),
            weight=1.0 - (known.gravity_compensation or 0.0),
        )


class KnownServos:
    """The servos of both arms, as far as they are known.

    Args:
        configured: Servos by side; in use where nothing is stored.
        folder: Folder of the records; empty: the default one.
        dynamics_seed: Seed of the simulated robot that a record must be of; None: of a real one.
        warn: Called with why a record can't be used.

    Attributes:
        models: Models by side.
        sources: Sources of the models, by side.
    """

    def __init__(
        self,
        configured: Mapping[str, ServoModel],
        folder: str,
        dynamics_seed: int | None,
        warn: Callable[[str], object],
    ) -> None:
        self._configured = dict(configured)
        self._store = RecordStore(Path(folder) if folder else default_folder(), StoredServos)
        self._seed = dynamics_seed
        self._warn = warn
        self._read()

    def update(self) -> bool:
        """Read the records again if they have changed; return whether they had."""
        if self._store.state() == self._state:
            return False
        self._read()
        return True

    def __str__(self) -> str:
        return ", ".join(f"{side} {source}" for side, source in self.sources.items())

    def _read(self) -> None:
        self._state = self._store.state()
        self.models = dict(self._configured)
        self.sources = dict.fromkeys(self._configured, "as configured")
        for side, servos in self._configured.items():
            if not servos.soft:
                continue
            try:
                found = self._store.find(side)
            except OpenArmError as error:
                self._warn(f"{side} arm: {error.message}; the configured servos are in use")
                continue
            if found is not None and found.record.dynamics_seed == self._seed:
                self.models[side] = found.record.model()
                self.sources[side] = f"identified {found.record.digest()[:12]}"
