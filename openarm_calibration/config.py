# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node `calibration`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from openarm_calibration.handeye.closed_form import ALGORITHMS
from openarm_calibration.handeye.limits import Limits
from openarm_calibration.sampling.gate import GateConfig
from openarm_calibration.sampling.next_pose import SearchConfig
from openarm_calibration.store.store import StoreConfig
from openarm_common import se3
from openarm_common.camera.cameras import near_camera, table_camera
from openarm_common.config import Config


class BoardPlace(Config):
    """Where a board is, roughly: as measured with a ruler. Without it the board must be in view at the start."""

    position: tuple[float, ...] = Field(default=(), description="of its middle, m: three numbers, or none: unknown")
    z_axis: tuple[float, float, float] = Field(default=(0.0, 0.0, -1.0), description="direction into the board")
    y_axis: tuple[float, float, float] = Field(default=(-1.0, 0.0, 0.0), description="direction down the board")

    @model_validator(mode="after")
    def _whole(self) -> BoardPlace:
        if len(self.position) not in (0, 3):
            raise ValueError(f"position has {len(self.position)} numbers, expected three, or none")
        if np.linalg.norm(np.cross(self.z_axis, self.y_axis)) < 1e-6:
            raise ValueError(f"z_axis {self.z_axis} and y_axis {self.y_axis} are parallel or zero")
        return self

    @property
    def pose(self) -> NDArray[np.float64] | None:
        """(4, 4) in the frame of what carries it; None when unknown."""
        if not self.position:
            return None
        return se3.make(se3.rotation_from_z_y(self.z_axis, self.y_axis), self.position)


class AutoConfig(Config):
    """Automatic calibration, with the arm moved by /motion/move."""

    poses: int = Field(default=15, ge=4, le=100, description="samples at most")
    fewest: int = Field(default=10, ge=4, le=100, description="samples at least, however certain the result is")
    sigma_translation: float = Field(default=1e-4, gt=0.0, description="predicted error that is enough, m")
    sigma_rotation: float = Field(default=2e-4, gt=0.0, description="the same of the rotation, rad")
    tries: int = Field(default=90, ge=1, description="poses that are tried for one sample before it is given up")
    velocity_scale: float = Field(default=0.5, gt=0.0, le=1.0, description="of the motions")
    delay_velocity_scale: float = Field(default=0.1, gt=0.0, le=1.0, description="while the delay is measured")
    settle_timeout: float = Field(default=5.0, gt=0.0, description="longest wait until the arm is at rest, s")
    camera_timeout: float = Field(
        default=30.0, gt=0.0, description="longest wait for images, as of a driver that starts again, s of wall clock"
    )
    move_timeout: float = Field(default=60.0, gt=0.0, description="longest wait for a motion, s of wall clock")
    plate: float = Field(default=0.01, gt=0.0, description="thickness that plans allow for the board, m")
    on_table: BoardPlace = Field(default_factory=BoardPlace, description="board of a camera that moves, base frame")
    on_hand: BoardPlace = Field(default_factory=BoardPlace, description="board of a fixed camera, frame of the carrier")
    as_in_scene: bool = Field(
        default=False, description="a board whose place is not given is where the scene calibration_CAMERA has it"
    )
    search: SearchConfig = Field(default_factory=SearchConfig, description="for the next pose")


class CalibrationConfig(StoreConfig):
    """Parameters of the node `calibration`."""

    camera: str = Field(
        default_factory=lambda: near_camera() or table_camera(),
        min_length=1,
        description="name of the camera to calibrate",
    )
    board: str = Field(
        default="", description="keys of the board as YAML, such as {kind: circles, rows: 11}; empty: defaults"
    )
    carrier: str = Field(
        default="", description="link that holds the board when the camera is fixed; empty: the last arm's flange"
    )
    algorithm: str = Field(default="REFINED", description="what compute_calibration uses at first")
    image_timeout: float = Field(default=2.0, gt=0.0, le=60.0, description="longest wait for an image, s of wall clock")
    state_timeout: float = Field(
        default=1.0, gt=0.0, le=60.0, description="longest wait for joint states, s of wall clock"
    )
    gate: GateConfig = GateConfig()
    limits: Limits = Limits()
    auto: AutoConfig = Field(default_factory=AutoConfig, description="automatic calibration")

    @field_validator("algorithm")
    @classmethod
    def _known(cls, value: str) -> str:
        if value.upper() not in ALGORITHMS:
            raise ValueError(f"unknown algorithm; algorithms: {', '.join(ALGORITHMS)}")
        return value.upper()
