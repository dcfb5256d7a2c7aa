# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes of cameras."""

from __future__ import annotations

from pydantic import Field

from openarm_common.config import Config


class CameraNodeConfig(Config):
    """What nodes of cameras have in common."""

    camera: str = Field(
        default="camera", pattern=r"^[a-z][a-z0-9_]*$", description="name of the camera: prefix of topics and frames"
    )
    width: int = Field(default=640, ge=16, le=4096, description="of the pictures, pixels")
    height: int = Field(default=480, ge=16, le=4096, description="of the pictures, pixels")
    rate: float = Field(default=30.0, gt=0.0, le=120.0, description="pictures a second, Hz")


class RealsenseConfig(CameraNodeConfig):
    """A RealSense."""

    serial: str = Field(default="", description="serial number; empty: the only one that is plugged in")
    imu: bool = Field(default=True, description="publish the IMU of cameras that have one")


class UsbConfig(CameraNodeConfig):
    """A camera by OpenCV."""

    device: str = Field(
        default="0", min_length=1, description="number of /dev/videoN, or a path, best one below /dev/v4l/by-id"
    )
    calibration: str = Field(
        default="", description="file of its intrinsics, a camera_info YAML as camera_calibration writes it"
    )
