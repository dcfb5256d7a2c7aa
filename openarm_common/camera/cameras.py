# SPDX-License-Identifier: Apache-2.0
"""Cameras of a robot: mounts, frames and pinhole intrinsics.

Frames of a camera `name` (REP-103, REP-105): `<name>_link` has x forward, y left, z up; `<name>_color_optical_frame`
has z forward, x right, y down. Depth is aligned with colour, so images, CameraInfo and points share the optical
frame. Pixel coordinates put the centre of the top-left pixel at (0, 0).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, field_validator

from openarm_common import se3
from openarm_common.config import Config, load_config
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import load_folder, per_robot, robot_name
from openarm_common.types import Array, Floats

Vector3 = tuple[float, float, float]

#: Columns: the optical axes (right, down, forward) in link axes (forward, left, up).
T_LINK_OPTICAL: Array = se3.make(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


#: Of any camera: largest image, longest focal length and offset of the principal point, pixels.
_LARGEST_PX, _LONGEST_PX = 16_384, 1e5


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera without distortion; lengths in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def fault(self) -> str:
        """Return why these are not the intrinsics of any camera; empty when they may be."""
        if not (0 < self.width <= _LARGEST_PX and 0 < self.height <= _LARGEST_PX):
            return f"{self.width}×{self.height} pixels, expected 1 .. {_LARGEST_PX} each way"
        if not (1.0 <= self.fx <= _LONGEST_PX and 1.0 <= self.fy <= _LONGEST_PX):
            return f"fx={self.fx:g}, fy={self.fy:g}, expected 1 .. {_LONGEST_PX:g} pixels"
        if not (abs(self.cx) <= _LONGEST_PX and abs(self.cy) <= _LONGEST_PX):
            return f"cx={self.cx:g}, cy={self.cy:g}, expected a point in or near the image"
        return ""

    @classmethod
    def from_fovy(cls, width: int, height: int, fovy_deg: float) -> Intrinsics:
        """Make intrinsics with square pixels and a centred principal point; vertical field of view in degrees.

        Args:
            width: Pixels.
            height: Pixels.
            fovy_deg: Vertical field of view, degrees.
        """
        f = height / 2.0 / math.tan(math.radians(fovy_deg) / 2.0)
        return cls(width, height, f, f, (width - 1) / 2.0, (height - 1) / 2.0)

    @property
    def matrix(self) -> Array:
        """K, (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def rays(self) -> tuple[Floats, Floats]:
        """Directions of columns (x over z) and of rows (y over z)."""
        x = ((np.arange(self.width) - self.cx) / self.fx).astype(np.float32)
        return x, ((np.arange(self.height) - self.cy) / self.fy).astype(np.float32)

    def project(self, points_optical: ArrayLike) -> Array:
        """Return the pixels (..., 2) of points (..., 3) in the optical frame; NaN behind the camera."""
        p = np.asarray(points_optical, dtype=np.float64)
        z = np.where(p[..., 2] > 0.0, p[..., 2], np.nan)
        return np.stack([p[..., 0] / z * self.fx + self.cx, p[..., 1] / z * self.fy + self.cy], axis=-1)

    def deproject(self, pixels: ArrayLike, depth: ArrayLike) -> Array:
        """Return the points (..., 3) in the optical frame of pixels (..., 2) at planar depth (...), m."""
        uv = np.asarray(pixels, dtype=np.float64)
        z = np.asarray(depth, dtype=np.float64)
        return np.stack([(uv[..., 0] - self.cx) / self.fx * z, (uv[..., 1] - self.cy) / self.fy * z, z], axis=-1)


class CameraConfig(Config):
    """Mount and optics of a camera."""

    name: str = Field(min_length=1, pattern=r"^[a-z][a-z0-9_]*$", description="prefix of topics and frames")
    parent: str = Field(description="link that carries the camera")
    position: Vector3 = Field(description="origin of the camera in the parent frame, m")
    forward: Vector3 = Field(description="viewing direction in the parent frame")
    image_right: Vector3 = Field(description="direction of growing u in the parent frame")
    width: int = Field(default=640, ge=16, le=4096, description="pixels")
    height: int = Field(default=480, ge=16, le=4096, description="pixels")
    fovy_deg: float = Field(default=60.0, gt=1.0, lt=170.0, description="vertical field of view, degrees")
    rate: float = Field(default=30.0, gt=0.0, le=100.0, description="images a second, Hz of simulated time")
    near: float = Field(default=0.05, gt=0.0, description="nearest depth that is reported, m")
    far: float = Field(default=3.0, gt=0.0, description="farthest depth that is reported, m")
    depth: bool = Field(default=True, description="whether the camera has depth")
    mount_error: bool = Field(default=True, description="whether the mount seed moves the simulated mount")
    housing: Vector3 | None = Field(default=None, description="edges of the camera body along forward, left, up, m")
    left: str = Field(default="", description="left camera of the pair whose right one this is, on the same body")
    baseline: float = Field(default=0.0, ge=0.0, le=1.0, description="of that pair, m")

    @field_validator("forward", "image_right")
    @classmethod
    def _direction(cls, value: Vector3) -> Vector3:
        if math.hypot(*value) < 1e-9:
            raise ValueError("expected a direction, got the zero vector")
        return value

    @property
    def link_frame(self) -> str:
        """Frame with x forward, y left, z up."""
        return f"{self.name}_link"

    @property
    def optical_frame(self) -> str:
        """Frame with z forward, x right, y down."""
        return f"{self.name}_color_optical_frame"

    @property
    def T_parent_link(self) -> Array:
        """Nominal mount, (4, 4)."""
        optical = se3.rotation_from_z_y(self.forward, np.cross(self.forward, self.image_right))
        return se3.make(optical, self.position) @ se3.inverse(T_LINK_OPTICAL)

    @property
    def T_parent_optical(self) -> Array:
        """Nominal pose of the optical frame in the parent, (4, 4)."""
        return self.T_parent_link @ T_LINK_OPTICAL

    @property
    def T_left_link(self) -> Array:
        """The right camera of a pair in the link frame of the left one, (4, 4)."""
        return se3.make(None, (0.0, -self.baseline, 0.0))

    @property
    def T_link_housing(self) -> Array:
        """Centre of the housing in the link frame, (4, 4): its front face is 2 mm behind the lens."""
        depth = self.housing[0] if self.housing else 0.0
        return se3.make(None, (-depth / 2.0 - 0.002, 0.0, 0.0))

    @property
    def intrinsics(self) -> Intrinsics:
        """Pinhole intrinsics."""
        return Intrinsics.from_fovy(self.width, self.height, self.fovy_deg)


class _CamerasFile(Config):
    cameras: tuple[CameraConfig, ...]


def load_cameras(path: Path | None = None) -> dict[str, CameraConfig]:
    """Read the cameras, by name.

    Args:
        path: YAML with a list `cameras`; None is that of this process's robot, which may have none.

    Raises:
        OpenArmError: CONFIG_INVALID, naming file and key, or the camera that is there twice.
    """
    if path is None:
        folder, robot = load_folder(robot_name())
        if not robot.cameras:
            return {}
        path = folder / robot.cameras
    cameras = load_config(path, _CamerasFile).cameras
    by_name = {camera.name: camera for camera in cameras}
    if len(by_name) != len(cameras):
        names = sorted(camera.name for camera in cameras)
        raise OpenArmError(Code.CONFIG_INVALID, f"{path}:cameras: names must be unique, got {', '.join(names)}")
    for camera in cameras:
        if fault := _pair_fault(camera, by_name):
            raise OpenArmError(Code.CONFIG_INVALID, f"{path}:cameras.{camera.name}: {fault}")
    return by_name


def _pair_fault(right: CameraConfig, cameras: Mapping[str, CameraConfig]) -> str:
    """Return why a camera is not the right one of a rectified pair as it says; empty when it is, or says nothing."""
    left = cameras.get(right.left)
    if not right.left:
        return "baseline without left; name the left camera of the pair" if right.baseline else ""
    if left is None or left is right:
        return f"left is {right.left!r}, expected another camera: {', '.join(n for n in cameras if n != right.name)}"
    if (right.parent, right.width, right.height, right.fovy_deg) != (
        left.parent,
        left.width,
        left.height,
        left.fovy_deg,
    ):
        return f"parent, width, height and fovy_deg differ from those of {left.name!r}, expected the same"
    place = left.T_parent_link @ right.T_left_link
    if right.baseline == 0.0 or np.abs(place - right.T_parent_link).max() > 1e-4:
        where = ", ".join(f"{v:.4f}" for v in place[:3, 3])
        return f"expected it parallel to {left.name!r} and {right.baseline:g} m (baseline > 0) to its right, at {where}"
    return ""


def depth_cameras() -> dict[str, CameraConfig]:
    """Return the cameras of this process's robot that have depth, by name."""
    return {name: camera for name, camera in load_cameras().items() if camera.depth}


def uncertain_cameras() -> tuple[str, ...]:
    """Return the names of the cameras whose mounts are to be calibrated; of a pair, the left one's."""
    return tuple(name for name, camera in load_cameras().items() if camera.mount_error and not camera.left)


def stereo_pairs() -> dict[str, str]:
    """Return the stereo pairs of this process's robot: the right camera by the left one."""
    return {camera.left: name for name, camera in load_cameras().items() if camera.left}


def hand_cameras() -> tuple[str, ...]:
    """Return the names of the cameras with depth that move with a hand."""
    arms = load_folder(robot_name())[1].arms.values()
    moving = {link for arm in arms for link in (arm.flange, arm.hand, arm.tcp, *arm.fingers)}
    return tuple(name for name, camera in depth_cameras().items() if camera.parent in moving)


@per_robot
def table_camera() -> str:
    """Return the name of the camera that looks at the table: the first with depth that no hand carries; "": none."""
    on_hands = hand_cameras()
    return next((name for name in depth_cameras() if name not in on_hands), "")


@per_robot
def near_camera() -> str:
    """Return the name of the camera for second looks: the first that a hand carries; "": none."""
    return next(iter(hand_cameras()), "")


@per_robot
def spectator_camera() -> str:
    """Return the name of the camera for people: the first without depth, or else the one that looks at the table."""
    paired = {name for pair in stereo_pairs().items() for name in pair}
    others = (name for name, camera in load_cameras().items() if not camera.depth and name not in paired)
    return next(others, table_camera())


def detector_nodes() -> dict[str, str]:
    """Return the nodes that detect, by camera: `detector` looks at the table, NAME_detector from a hand."""
    first = {table_camera(): "detector"} if table_camera() else {}
    return first | {name: f"{name}_detector" for name in hand_cameras()}


def depth_camera(name: str) -> CameraConfig:
    """Return a camera of this process's robot that has depth, its own or that of the pair whose left one it is.

    Raises:
        OpenArmError: CONFIG_INVALID, listing those that there are.
    """
    cameras = load_cameras()
    valid = [*depth_cameras(), *stereo_pairs()]
    if name not in valid:
        raise OpenArmError(
            Code.CONFIG_INVALID, f"camera {name!r} is unknown or has no depth; cameras: {', '.join(valid)}"
        )
    return cameras[name]


def true_mount(camera: CameraConfig, mount_seed: int | None) -> Array:
    """Return the true mount of a simulated camera: the nominal mount off by an error of the mount seed.

    Args:
        camera: The camera with its nominal mount.
        mount_seed: Seed of the error (up to 15 mm and 2°, drawn apart for each camera or pair); None is no error.

    Returns:
        T_parent_link, (4, 4).
    """
    if mount_seed is None or not camera.mount_error:
        return camera.T_parent_link
    error = _mount_error(camera.left or camera.name, mount_seed)
    if camera.left:  # moves with the body that both are on
        return camera.T_parent_link @ se3.inverse(camera.T_left_link) @ error @ camera.T_left_link
    return camera.T_parent_link @ error


def _mount_error(name: str, mount_seed: int) -> Array:
    """Return the error of the mount of a camera in its link frame, (4, 4)."""
    rng = np.random.default_rng([mount_seed, zlib.crc32(name.encode())])
    direction, axis = rng.normal(size=(2, 3))
    shift = direction / np.linalg.norm(direction) * rng.uniform(0.005, 0.015)
    turn = axis / np.linalg.norm(axis) * math.radians(rng.uniform(0.7, 2.0))
    return se3.make(se3.exp_so3(turn), shift)
