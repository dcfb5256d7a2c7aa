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
    from openarm_common.camera.cameras import CameraConfig as CameraConfig
    from openarm_common.camera.cameras import Intrinsics as Intrinsics
    from openarm_common.camera.cameras import load_cameras as load_cameras
    from openarm_common.config import Config as Config
    from openarm_common.config import load_config as load_config
    from openarm_common.errors import Code as Code
    from openarm_common.errors import OpenArmError as OpenArmError
    from openarm_common.octree.distance_field import DistanceFieldReader as DistanceFieldReader
    from openarm_common.robot.description import RobotDescription as RobotDescription
    from openarm_common.robot.robot_state import RobotStateBuffer as RobotStateBuffer
    from openarm_common.scene.scene import Scene as Scene
    from openarm_common.scene.scene import load_scene as load_scene

__getattr__, __dir__ = attach(__name__, __file__)
