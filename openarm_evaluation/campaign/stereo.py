# SPDX-License-Identifier: Apache-2.0
"""Depth of stereo pairs of the robot in this process: the core of the node `stereo_depth`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.camera.cameras import load_cameras, stereo_pairs
from openarm_common.camera.depth_view import millimetres
from openarm_common.camera.lens import Lens
from openarm_common.robot.folder import per_robot
from openarm_common.types import Bytes
from openarm_perception.config import StereoNodeConfig
from openarm_perception.geometry.depth import DepthLimits
from openarm_perception.stereo.matching import StereoMatcher
from openarm_perception.stereo.rectification import Rectification


@per_robot
def _matcher(left: str) -> StereoMatcher:
    cameras = load_cameras()
    camera, right = cameras[left], cameras[stereo_pairs()[left]]
    lens = Lens(camera.intrinsics)
    rectification = Rectification.from_pose(lens, lens, se3.make(None, (right.baseline, 0.0, 0.0)))
    return StereoMatcher(StereoNodeConfig().matcher, rectification, DepthLimits(near=camera.near, far=camera.far))


def stereo_depth(left: str, rgb: Bytes, right_rgb: Bytes) -> NDArray[np.uint16]:
    """Return the depth image (h, w) of the left camera of a pair, whole millimetres."""
    return millimetres(_matcher(left).depth(rgb, right_rgb))
