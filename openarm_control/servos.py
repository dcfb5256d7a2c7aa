# SPDX-License-Identifier: Apache-2.0
"""What is known of the servos of the arms: as configured, or as identified of this robot and stored.

Values are by joint of an arm, from the shoulder; N m, rad, s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator

from openarm_common.config import Config
from openarm_common.errors import OpenArmError
from openarm_common.records import default_folder
from openarm_common.robot.servo_store import ServoStore
from openarm_common.robot.servos import ArmLoad, ServoModel

Positive = Annotated[float, Field(gt=0.0)]
Seven = tuple[Positive, Positive, Positive, Positive, Positive, Positive, Positive]
Range = tuple[Annotated[float, Field(ge=0.0)], Annotated[float, Field(ge=0.0)]]


class ServoConfig(Config):
    """Motors of the arms, by default as their owners have them: nothing carries the weight."""

    # gains of openarm_ros2 since May 2026
    stiffness: Seven = Field(default=(70, 70, 70, 60, 10, 10, 10), description="position gains, N m/rad")
    damping: Seven = Field(default=(2.75, 2.5, 2.0, 2.0, 0.7, 0.6, 0.5), description="velocity gains, N m s/rad")
    armature: Seven = Field(
        default=(0.0081, 0.0081, 0.16, 0.16, 0.01, 0.01, 0.01), description="inertia of rotor and gear, kg m2"
    )
    gravity_compensation: float = Field(
        default=0.0, ge=0.0, le=1.0, description="share of the arms' weight that the motors carry by themselves"
    )
    friction: Range = Field(
        default=(0.2, 0.5), description="range of the dry friction of a joint, N m; 0, 0: as described"
    )
    # one to five cycles of a CAN loop at 500 Hz
    latency: Range = Field(default=(0.002, 0.010), description="range of the time until a command takes effect, s")

    @field_validator("friction", "latency")
    @classmethod
    def _in_order(cls, value: Range) -> Range:
        if value[0] > value[1]:
            raise ValueError("expected the lower end first")
        return value

    def model(self, load: ArmLoad) -> ServoModel:
        """Return the servos of an arm, as a client knows them that has not identified them."""
        return ServoModel(
            stiffness=np.array(self.stiffness),
            damping=np.array(self.damping) + load.damping,
            friction=np.maximum(load.friction, np.mean(self.friction)),
            armature=np.array(self.armature),
            latency_s=np.full(len(self.stiffness), float(np.mean(self.latency))),
            weight=1.0 - self.gravity_compensation,
        )


class KnownServos:
    """The servos of both arms, as far as they are known.

    Args:
        configured: By side; in use where nothing is stored.
        folder: Of the records; empty: the default one.
        dynamics_seed: Of the simulated robot that a record must be of; None: of a real one.
        warn: Called with why a record can't be used.

    Attributes:
        models: By side.
        sources: Where they come from, by side.
    """

    def __init__(
        self,
        configured: Mapping[str, ServoModel],
        folder: str,
        dynamics_seed: int | None,
        warn: Callable[[str], object],
    ) -> None:
        self._configured = dict(configured)
        self._store = ServoStore(Path(folder) if folder else default_folder())
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
