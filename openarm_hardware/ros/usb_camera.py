# SPDX-License-Identifier: Apache-2.0
"""Node `usb_camera`: a camera without depth behind the topics of a simulated one, without its distortion."""

from __future__ import annotations

from typing import Any

from openarm_common.ros.node import run
from openarm_hardware.cameras.config import UsbConfig
from openarm_hardware.cameras.usb import UsbCamera
from openarm_hardware.ros.camera_node import CameraNode


def make(**kwargs: Any) -> CameraNode[UsbConfig]:
    """Make the node."""
    return CameraNode("usb_camera", UsbConfig, UsbCamera, **kwargs)


def main() -> None:
    """Run the node."""
    run(make)


if __name__ == "__main__":
    main()
