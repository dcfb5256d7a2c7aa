# SPDX-License-Identifier: Apache-2.0
"""Compiles every numba kernel of the map, so that the first images of a process do not wait for that."""

from __future__ import annotations

import numpy as np

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.flying_pixels import FlyingConfig, label_flying
from openarm_common.octree.codec import decode, encode_states
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.self_filter import SelfFilter, SelfFilterConfig
from openarm_octomap.config import GridConfig
from openarm_octomap.distance import DistanceTransform
from openarm_octomap.grid import CloudScan, DepthScan, OccupancyGrid


def warm() -> None:
    """Run each kernel once with the types that the package uses; the compiled code is cached next to the sources."""
    description = RobotDescription.load()
    robot = SelfFilter(description, SelfFilterConfig())
    joints = {name: 0.0 for name, joint in description.joints.items() if joint.type != "fixed"}
    shapes = robot.shapes(joints)
    grid = OccupancyGrid(GridConfig(lower=(0.0, 0.0, 0.0), upper=(0.3, 0.3, 0.3), decay_s=1.0))
    intrinsics, T = Intrinsics.from_fovy(8, 6, 60.0), se3.make(None, (0.15, 0.15, 0.0))
    index = np.argwhere(np.ones((8, 8, 8), bool))[:300] + grid.lattice.key_min
    leaves = np.column_stack([np.zeros(len(index)), index]).astype(np.int32)
    # cells of one byte, then of two
    for log_odds in (np.full(300, 1.0, np.float32), np.linspace(-1.0, 1.0, 300, dtype=np.float32)):
        grid.reset()
        grid.blocks.paint(leaves, log_odds)
        for depth in (np.full((6, 8), 200, np.uint16), np.full((6, 8), 0.2, np.float32)):
            scan = DepthScan(depth, intrinsics, T, 0.05, 1.0)
            label, _ = robot.label_depth(scan, shapes)
            label_flying(scan, FlyingConfig(), label)
            grid.integrate([scan], 0)
        cloud = CloudScan(scan.points(), T[:3, 3])
        robot.label_points(cloud.points, shapes)
        grid.integrate([cloud], 0)
        grid.forget(shapes, 0.01)
        grid.decay(0)
        grid.counts()
        encode_states(*grid.coarse(15))
        for payload in (grid.binary(), grid.full()):
            decode(payload.data, grid.lattice.resolution, binary=payload.binary).on(grid.lattice)
        distances = np.empty(grid.lattice.shape, np.float32)
        DistanceTransform(grid.lattice, 0.1).compute(grid.blocks, distances)
        grid.clear_box((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))


if __name__ == "__main__":
    warm()
