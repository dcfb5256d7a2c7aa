# SPDX-License-Identifier: Apache-2.0
"""Shared by all packages: geometry, robot description, cameras, scenes, octrees, errors; `ros/`: base of the nodes.

Example:
    >>> from openarm_common import RobotDescription, load_cameras
    >>> robot = RobotDescription.load()
    >>> T_root_tcp = robot.link_pose("openarm_left_hand_tcp", robot.group_state("left_arm", "home"))
    >>> camera = load_cameras()["overhead"]
    >>> pixel = camera.intrinsics.project((0.1, 0.0, 0.8))

Rigid transforms are in `openarm_common.se3`, array types in `openarm_common.types`.
"""

from typing import TYPE_CHECKING

from openarm_common.lazy import attach

if TYPE_CHECKING:
    from openarm_common.camera.cameras import CameraConfig, Intrinsics, load_cameras
    from openarm_common.config import Config, load_config
    from openarm_common.errors import Code, OpenArmError
    from openarm_common.octree.distance_field import DistanceFieldReader
    from openarm_common.robot.description import RobotDescription
    from openarm_common.robot.robot_state import RobotStateBuffer
    from openarm_common.scene.scene import Scene, load_scene

__all__ = [
    "CameraConfig",
    "Code",
    "Config",
    "DistanceFieldReader",
    "Intrinsics",
    "OpenArmError",
    "RobotDescription",
    "RobotStateBuffer",
    "Scene",
    "load_cameras",
    "load_config",
    "load_scene",
]

__getattr__, __dir__ = attach(__name__, __file__)
