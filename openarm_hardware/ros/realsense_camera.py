# SPDX-License-Identifier: Apache-2.0
"""Node `realsense_camera`: a RealSense behind the topics of a simulated camera, by serial number."""

from __future__ import annotations

from typing import Any

from openarm_common.ros.node import run
from openarm_hardware.cameras.config import RealsenseConfig
from openarm_hardware.cameras.realsense import RealSense
from openarm_hardware.ros.camera_node import CameraNode


def make(**kwargs: Any) -> CameraNode[RealsenseConfig]:
    """Make the node."""
    return CameraNode("realsense_camera", RealsenseConfig, RealSense, **kwargs)


def main() -> None:
    """Run the node."""
    run(make)


if __name__ == "__main__":
    main()
