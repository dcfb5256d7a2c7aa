# SPDX-License-Identifier: Apache-2.0
"""An octree of the environment from depth images and clouds, without the robot itself, and its distance field.

Example:
    >>> import numpy as np
    >>> from openarm_common import RobotDescription, load_cameras
    >>> from openarm_octomap import DepthScan, FieldConfig, FilterConfig, Frame, GridConfig, Mapper
    >>> robot, camera = RobotDescription.load(), load_cameras()["overhead"]
    >>> mapper = Mapper(robot, GridConfig(), FilterConfig(), FieldConfig())
    >>> depth = np.full((camera.height, camera.width), 800, np.uint16)  # mm
    >>> scan = DepthScan(depth, camera.intrinsics, camera.T_parent_optical, camera.near, camera.far)
    >>> report = mapper.update([Frame("overhead", 0, scan, dict.fromkeys(robot.joints, 0.0))])
    >>> report.changed.size > 0
    True

The node `octomap` is in `ros/`.
"""

from typing import TYPE_CHECKING

from openarm_common.lazy import attach

if TYPE_CHECKING:
    from openarm_octomap.config import FieldConfig as FieldConfig
    from openarm_octomap.config import FilterConfig as FilterConfig
    from openarm_octomap.config import GridConfig as GridConfig
    from openarm_octomap.config import OctomapNodeConfig as OctomapNodeConfig
    from openarm_octomap.distance import DistanceTransform as DistanceTransform
    from openarm_octomap.grid import CloudScan as CloudScan
    from openarm_octomap.grid import DepthScan as DepthScan
    from openarm_octomap.grid import OccupancyGrid as OccupancyGrid
    from openarm_octomap.mapper import Frame as Frame
    from openarm_octomap.mapper import Mapper as Mapper

__getattr__, __dir__ = attach(__name__, __file__)
