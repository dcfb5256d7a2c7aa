# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes of this package."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, field_validator, model_validator

from openarm_common.camera.cameras import depth_cameras, stereo_pairs, table_camera
from openarm_common.config import Config, RunTimeField
from openarm_common.scene.scene import load_scene
from openarm_perception.detection.detector import Policy
from openarm_perception.detection.faults import DetectionFaults
from openarm_perception.detection.kinds import DetectorKind
from openarm_perception.detection.localize import LocalizerConfig
from openarm_perception.detection.network import NetworkConfig
from openarm_perception.detection.robot import CloudRobotConfig, RobotConfig
from openarm_perception.detection.tags import TagConfig
from openarm_perception.geometry.filters import FilterConfig
from openarm_perception.geometry.watch import WatchConfig
from openarm_perception.stereo.matching import StereoConfig
from openarm_world.config import WorldConfig


class DetectNodeConfig(Config):
    """Parameters of the node `detector`."""

    camera: str = Field(
        default_factory=table_camera, description="camera of cameras.yaml; gives frame and depth limits"
    )
    color_topic: str = Field(default="/{camera}/color/image_raw", description="colour image; {camera} is filled in")
    depth_topic: str = Field(
        default="/{camera}/depth/image_raw",
        description="aligned depth image; {camera} is filled in; empty: none, see localizer.heights",
    )
    info_topic: str = Field(
        default="/{camera}/depth/camera_info", description="CameraInfo of both; {camera} is filled in"
    )
    colors: str = Field(default="", description="YAML of the colours; empty is config/params/detector.yaml")
    scene: str = Field(default="demo", description="scene whose table it is until the frame `table` is known")
    table_height: float | None = Field(
        default=None, ge=-1.0, le=2.0, description="of the table in the base frame, m; without one, the frame `table`'s"
    )
    detector: DetectorKind = RunTimeField(
        default="color",
        description="what finds objects: their colour, a network, both checking each other, a tag on them, or depth"
        " alone (anything)",
    )
    network: NetworkConfig = NetworkConfig()
    tag: TagConfig = TagConfig()
    policy: Policy = RunTimeField(
        default="score", description="which detection comes first: most certain, or nearest to the centre"
    )
    label: str = RunTimeField(
        default="", description="only objects that these words fit, such as `red` or `red can`; empty takes all"
    )
    max_rate: float = Field(
        default=10.0, gt=0.0, le=60.0, description="most frames processed a second of the stamps, Hz"
    )
    transform_wait: float = Field(default=0.5, ge=0.0, le=5.0, description="longest wait for the camera's pose, s")
    held_topic: str = Field(default="/motion/attached_objects", description="what the hands hold, as markers on links")
    calibrated_topic: str = Field(
        default="/calibration/{camera}/camera_info",
        description="intrinsics that the mount was calibrated with; {camera} is filled in",
    )
    localizer: LocalizerConfig = Field(default_factory=LocalizerConfig)
    self_filter: RobotConfig = RobotConfig()
    watch: WatchConfig = WatchConfig()
    objects: WorldConfig = WorldConfig()
    faults: DetectionFaults = DetectionFaults()

    def table_top_z(self) -> float:
        """Return the height of the table in the base frame, m.

        Raises:
            OpenArmError: SCENE_INVALID, from the scene.
        """
        return load_scene(self.scene).table.top_z if self.table_height is None else self.table_height


class StereoNodeConfig(Config):
    """Parameters of the node `stereo_depth`."""

    camera: str = Field(
        default_factory=lambda: next(iter(stereo_pairs()), ""), description="left camera of a pair of cameras.yaml"
    )
    left_topic: str = Field(default="/{camera}/color/image_raw", description="of the left camera; {camera} is its name")
    left_info_topic: str = Field(default="/{camera}/color/camera_info", description="its CameraInfo")
    right_topic: str = Field(default="/{right}/color/image_raw", description="of the right one; {right} is its name")
    right_info_topic: str = Field(
        default="/{right}/color/camera_info", description="its CameraInfo; P says the baseline"
    )
    rectified: bool = Field(default=False, description="whether the images are rectified as they come (image_rect)")
    pose: tuple[float, ...] = Field(
        default=(),
        description="of the right camera in the left one's optical frame: x, y, z, m, and rotation vector, rad; for"
        " drivers whose CameraInfo has no P of a pair; empty: by R and P",
    )
    depth_topic: str = Field(default="/{camera}/depth/image_raw", description="depth of the rectified left camera")
    info_topic: str = Field(default="/{camera}/depth/camera_info", description="CameraInfo of the depth")
    rectified_topic: str = Field(
        default="/{camera}/color/image_rect", description="colour of the rectified left camera, aligned with the depth"
    )
    encoding: Literal["16UC1", "32FC1"] = Field(default="16UC1", description="whole millimetres, or metres")
    stamp_gap: float = Field(default=0.001, ge=0.0, le=0.1, description="most that the stamps of a pair differ, s")
    max_rate: float = Field(default=5.0, gt=0.0, le=60.0, description="most pairs a second of the stamps, Hz")
    matcher: StereoConfig = StereoConfig()

    @field_validator("pose")
    @classmethod
    def _six(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) not in (0, 6) or not all(math.isfinite(v) for v in value):
            raise ValueError(
                f"expected six finite numbers (x, y, z, m, rotation vector, rad) or none, got {list(value)}"
            )
        return value


class CloudNodeConfig(Config):
    """Parameters of the node `cloud`."""

    cameras: tuple[str, ...] = Field(
        default_factory=lambda: tuple(depth_cameras()), min_length=1, description="cameras of cameras.yaml"
    )
    depth_topic: str = Field(default="/{camera}/depth/image_raw", description="depth image; {camera} is filled in")
    info_topic: str = Field(default="/{camera}/depth/camera_info", description="CameraInfo; {camera} is filled in")
    points_topic: str = Field(default="/{camera}/depth/points", description="the cloud; {camera} is filled in")
    merged_topic: str = Field(default="/points", description="one cloud of all cameras, in the base frame")
    merged_rate: float = Field(default=10.0, gt=0.0, le=60.0, description="most merged clouds a second, Hz")
    merged_age: float = Field(
        default=0.5, ge=0.0, le=10.0, description="a camera whose cloud is older by this is left out of it, s"
    )
    organised: bool = Field(
        default=True, description="clouds of cameras: a point for every pixel, NaN where invalid; false: valid ones"
    )
    color: bool = Field(default=False, description="a field `rgb` next to x, y, z; organised clouds only")
    color_topic: str = Field(default="/{camera}/color/image_raw", description="aligned colour; {camera} is filled in")
    held_topic: str = Field(default="/motion/attached_objects", description="what the hands hold, as markers on links")
    transform_wait: float = Field(
        default=0.2,
        ge=0.0,
        le=5.0,
        description="longest wait for the robot's posture at a stamp, where it is needed, s",
    )
    filter: FilterConfig = FilterConfig()
    self_filter: CloudRobotConfig = CloudRobotConfig()

    @model_validator(mode="after")
    def _fits(self) -> CloudNodeConfig:
        if self.organised and (self.filter.voxel > 0.0 or self.filter.outliers):
            raise ValueError(
                "filter.voxel and filter.outliers take points away, so that clouds are no longer organised:"
                " set organised to false as well (--set cloud.organised=false)"
            )
        if self.color and not self.organised:
            raise ValueError("color needs organised clouds: set organised to true, or color to false")
        return self
