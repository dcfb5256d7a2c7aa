# SPDX-License-Identifier: Apache-2.0
"""Parameters of the map and of the node."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from openarm_common.camera.cameras import depth_cameras
from openarm_common.camera.flying_pixels import FlyingConfig
from openarm_common.config import Config
from openarm_common.robot.self_filter import SelfFilterConfig

Vector3 = tuple[float, float, float]

#: Log-odds are kept within ±CLAMP when they are derived from numbers of frames; only ratios matter.
CLAMP = 2.0


class GridConfig(Config):
    """Where the map is and how cells are updated.

    A known cell changes its state after `frames_to_mark` or `frames_to_clear` observations that all contradict it; an
    unknown cell takes the first one. To use log-odds as liboctomap counts them, give `hit` and `miss`.
    """

    resolution: float = Field(default=0.02, ge=0.005, le=0.2, description="edge of a cell, m")
    lower: Vector3 = Field(default=(-0.48, -1.0, -0.08), description="corner of the workspace in the base frame, m")
    upper: Vector3 = Field(default=(1.28, 1.0, 1.36), description="opposite corner of the workspace, m")
    frames_to_mark: int = Field(default=1, ge=1, le=20, description="hits in a row that make the freest cell occupied")
    frames_to_clear: int = Field(default=1, ge=1, le=20, description="misses in a row that make the surest cell free")
    hit: float = Field(
        default=0.0, ge=0.0, le=10.0, description="log-odds of a hit instead; 0 derives them from the frames"
    )
    miss: float = Field(
        default=0.0, ge=-10.0, le=0.0, description="log-odds of a miss instead; 0 derives them from the frames"
    )
    clamp_min: float = Field(default=-CLAMP, ge=-10.0, lt=0.0, description="lowest log-odds")
    clamp_max: float = Field(default=CLAMP, gt=0.0, le=10.0, description="highest log-odds")
    max_range: float = Field(default=3.0, description="surfaces further away mark nothing, m; negative: no limit")
    clear_without_return: bool = Field(
        default=True, description="views into the distance clear, without a surface behind"
    )
    no_return_block: int = Field(
        default=4, ge=1, le=32, description="pixels a side that must all lack a return, for that"
    )
    no_return_range: float = Field(default=2.0, gt=0.0, le=10.0, description="how far they clear, m")
    decay_s: float = Field(
        default=0.0, ge=0.0, description="occupied cells unseen for longer become unknown, s; 0: never"
    )

    @model_validator(mode="after")
    def _pair(self) -> GridConfig:
        if (self.hit == 0.0) != (self.miss == 0.0):
            raise ValueError(f"give both hit and miss or neither, got {self.hit} and {self.miss}")
        return self

    @property
    def hit_log_odds(self) -> float:
        """Added for a hit."""
        # half a step of margin, so that rounding never costs a frame
        return self.hit or -self.clamp_min / (self.frames_to_mark - 0.5)

    @property
    def miss_log_odds(self) -> float:
        """Added for a miss."""
        return self.miss or -self.clamp_max / (self.frames_to_clear - 0.5)


class FilterConfig(SelfFilterConfig):
    """What of the images does not get into the map: the robot, and pixels that float between surfaces."""

    reset_padding: float = Field(
        default=0.01, ge=0.0, le=0.2, description="cells this near to the robot are made unknown, m"
    )
    flying: FlyingConfig = FlyingConfig()


UnknownPolicy = Literal["free", "occupied"]


class FieldConfig(Config):
    """The distance field for planners."""

    enabled: bool = Field(default=True, description="compute it and share it")
    reach: float = Field(default=0.40, gt=0.0, le=2.0, description="distances are cut here, m")
    unknown: UnknownPolicy = Field(default="free", description="what unknown cells count as")
    name: str = Field(
        default="", pattern=r"^[A-Za-z0-9_.-]*$", description="of the shared memory; empty: by ROS domain"
    )


class OctomapNodeConfig(Config):
    """Parameters of the node `octomap`."""

    cameras: tuple[str, ...] = Field(
        default_factory=lambda: tuple(depth_cameras()), description="cameras of cameras.yaml"
    )
    depth_topic: str = Field(default="/{camera}/depth/image_raw", description="depth image; {camera} is filled in")
    info_topic: str = Field(default="/{camera}/depth/camera_info", description="CameraInfo; {camera} is filled in")
    cloud_topic: str = Field(default="cloud_in", description="clouds, a second input; empty: none")
    period: float = Field(default=0.5, ge=0.05, le=60.0, description="time from update to update, s")
    stale_after: float = Field(
        default=1.5, gt=0.0, description="a camera without a used frame for longer is reported, s"
    )
    # shorter than five frames, which are kept: a joint state that never comes is named
    transform_wait: float = Field(
        default=0.1, ge=0.0, le=5.0, description="longest wait for the robot's posture at a stamp, s"
    )
    held_topic: str = Field(default="/motion/attached_objects", description="what the hands hold, as markers on links")
    map_file: str = Field(default="", description=".bt or .ot to start from; empty: nothing is known")
    map_topic: str = Field(
        default="", description="latched octomap of another program, each of which replaces the map; empty: none"
    )
    coarse_depths: tuple[int, ...] = Field(default=(15, 14, 13), description="further depths that services answer")
    publish_full: bool = Field(default=True, description="publish octomap_full too")
    autostart: bool = Field(default=True, description="active from the start; false: a lifecycle manager activates it")
    grid: GridConfig = GridConfig()
    filter: FilterConfig = FilterConfig()
    field: FieldConfig = FieldConfig()

    @model_validator(mode="after")
    def _depths(self) -> OctomapNodeConfig:
        if any(not 1 <= depth <= 15 for depth in self.coarse_depths):
            raise ValueError(f"coarse_depths are {self.coarse_depths}; expected 1 .. 15 (16 is the full resolution)")
        return self
