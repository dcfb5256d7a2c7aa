# SPDX-License-Identifier: Apache-2.0
"""`python -m openarm_bringup.warm`: compile every numba kernel once, so that no node waits for it at its first use."""

from __future__ import annotations

import numpy as np

from openarm_calibration.warm import warm as warm_calibration
from openarm_common.camera.cameras import Intrinsics
from openarm_common.collision.self_collision import SelfCollision
from openarm_common.robot.description import RobotDescription
from openarm_motion.warm import warm as warm_motion
from openarm_octomap.warm import warm as warm_octomap
from openarm_perception.geometry.depth import Deprojector, DepthLimits
from openarm_perception.geometry.filters import drop_flying, voxel_filter


def warm_perception() -> None:
    """Run the depth kernels with both encodings."""
    intrinsics = Intrinsics.from_fovy(8, 6, 1.0)
    deprojector = Deprojector(DepthLimits(near=0.05, far=3.0))
    for depth in (np.full((6, 8), 500, np.uint16), np.full((6, 8), 0.5, np.float32)):
        deprojector.organised(depth, intrinsics)
        drop_flying(depth, 0.03)
        voxel_filter(deprojector.valid_points(depth, intrinsics), 0.01)


def warm_hardware() -> None:
    """Check a robot against itself once, as the node of the motors does."""
    description = RobotDescription.load()
    SelfCollision(description, [name for arm in description.arms.values() for name in arm.controlled])


def main() -> None:
    """Warm all packages that have kernels."""
    warm_perception()
    warm_calibration()
    warm_motion()
    warm_octomap()
    warm_hardware()


if __name__ == "__main__":
    main()
