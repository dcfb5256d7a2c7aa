# SPDX-License-Identifier: Apache-2.0
"""Compile every numba kernel of the map, so that the first images of a process do not wait for that."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.flying_pixels import FlyingConfig, label_flying
from openarm_common.octree.codec import decode, encode_states
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.self_filter import SelfFilter, SelfFilterConfig, Shapes
from openarm_octomap.config import GridConfig
from openarm_octomap.distance import DistanceTransform
from openarm_octomap.grid import CloudScan, DepthScan, OccupancyGrid

#: Images of one place in millimetres and in metres, and from where.
_MILLIMETRES, _METRES = np.full((6, 8), 200, np.uint16), np.full((6, 8), 0.2, np.float32)
_T_BASE_CAMERA = se3.make(None, (0.15, 0.15, 0.0))


def warm() -> None:
    """Run each kernel once with the types that the package uses; the compiled code is cached next to the sources."""
    grid, robot = _grid(), _robot()
    index = np.argwhere(np.ones((8, 8, 8), bool))[:300] + grid.lattice.key_min
    leaves = np.column_stack([np.zeros(len(index)), index]).astype(np.int32)
    # cells of one byte, then of two
    for log_odds in (np.full(300, 1.0, np.float32), np.linspace(-1.0, 1.0, 300, dtype=np.float32)):
        grid.reset()
        grid.blocks.paint(leaves, log_odds)
        for depth in (_MILLIMETRES, _METRES):
            points = _map(grid, robot, depth).points()
        robot[0].label_points(points, robot[1])
        grid.integrate([CloudScan(points, _T_BASE_CAMERA[:3, 3])], 0)
        grid.decay(0)
        encode_states(*grid.coarse(15))
        for payload in (grid.binary(), grid.full()):
            tree = decode(payload.data, grid.lattice.resolution, binary=payload.binary)
            tree.on(grid.lattice)
            _grid().load(tree, _T_BASE_CAMERA)
        grid.clear_box((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))


def _grid() -> OccupancyGrid:
    return OccupancyGrid(GridConfig(lower=(0.0, 0.0, 0.0), upper=(0.3, 0.3, 0.3), decay_s=1.0))


def _robot() -> tuple[SelfFilter, Shapes]:
    """Return the filter of a robot, and its shapes."""
    description = RobotDescription.load()
    robot = SelfFilter(description, SelfFilterConfig())
    return robot, robot.shapes({name: 0.0 for name, joint in description.joints.items() if joint.type != "fixed"})


def _map(grid: OccupancyGrid, robot: tuple[SelfFilter, Shapes], depth: NDArray[Any]) -> DepthScan:
    """Put an image into a map, give it out and take the robot out of it; return the scan."""
    scan = DepthScan(depth, Intrinsics.from_fovy(8, 6, 60.0), _T_BASE_CAMERA, 0.05, 1.0)
    label, _ = robot[0].label_depth(scan, robot[1])
    label_flying(scan, FlyingConfig(), label)
    grid.integrate([scan], 0)
    grid.forget(robot[1], 0.01)
    grid.counts()
    grid.binary()
    grid.full()
    distances = np.empty(grid.lattice.shape, np.float32)
    DistanceTransform(grid.lattice, 0.1).compute(grid.blocks, distances)
    return scan


if __name__ == "__main__":
    warm()
