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
from openarm_common.types import Floats
from openarm_octomap.config import GridConfig
from openarm_octomap.distance import DistanceTransform
from openarm_octomap.grid import CloudScan, DepthScan, OccupancyGrid

_T_BASE_CAMERA = se3.make(None, (0.15, 0.15, 0.0))


def warm() -> None:
    """Run each kernel once: images in millimetres, and cells of one byte, as every map has at first."""
    _run(np.full((6, 8), 200, np.uint16), np.full(300, 1.0, np.float32))


def warm_rest() -> None:
    """Run the kernels again for images in metres, and for cells of two bytes, as a map that was loaded may have."""
    _run(np.full((6, 8), 0.2, np.float32), np.linspace(-1.0, 1.0, 300, dtype=np.float32))


def _run(depth: NDArray[Any], log_odds: Floats) -> None:
    """Fill a map with leaves of some log-odds (300,), put an image into it, and use it in every way."""
    grid, robot = _grid(), _robot()
    index = np.argwhere(np.ones((8, 8, 8), bool))[:300] + grid.lattice.key_min
    grid.blocks.paint(np.column_stack([np.zeros(len(index)), index]).astype(np.int32), log_odds)
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
