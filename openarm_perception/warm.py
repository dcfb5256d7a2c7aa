# SPDX-License-Identifier: Apache-2.0
"""Compiles the numba kernels of this package, so that the first images of a process do not wait for that."""

from __future__ import annotations

import numpy as np

from openarm_common.camera.cameras import Intrinsics
from openarm_common.se3 import make
from openarm_perception.geometry.depth import Deprojector, DepthLimits
from openarm_perception.geometry.filters import drop_flying, voxel_filter
from openarm_perception.segmentation.clusters import segment


def warm() -> None:
    """Run each kernel once with the types that the package uses; the compiled code is cached next to the sources."""
    intrinsics = Intrinsics.from_fovy(160, 120, 45.0)
    deprojector = Deprojector(DepthLimits(near=0.05, far=3.0))
    depth = np.full((120, 160), 600, np.uint16)  # a table, and a box in the middle of it
    depth[45:75, 60:100] = 540
    for image in (depth, depth.astype(np.float32) * np.float32(1e-3)):
        points = deprojector.organised(image, intrinsics)
        drop_flying(image, 0.03)
        voxel_filter(deprojector.valid_points(image, intrinsics), 0.01)
    T_base_camera = make(np.diag([1.0, -1.0, -1.0]), (0.3, 0.0, 1.0))
    segment(points, intrinsics, rgb=np.zeros((120, 160, 3), np.uint8), T_base_camera=T_base_camera)


if __name__ == "__main__":
    warm()
