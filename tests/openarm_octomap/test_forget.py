# SPDX-License-Identifier: Apache-2.0
"""The robot in the map."""

from __future__ import annotations

import numpy as np

from openarm_common.robot.description import RobotDescription
from openarm_common.robot.self_filter import SelfFilter, SelfFilterConfig
from openarm_octomap.config import GridConfig
from openarm_octomap.grid import OccupancyGrid
from openarm_octomap.kernels import UNKNOWN


def test_cells_that_the_robot_fills_are_made_unknown() -> None:
    """What was marked there before, such as an object that the hand took."""
    robot = SelfFilter(RobotDescription.load(), SelfFilterConfig(padding=0.0))
    grid = OccupancyGrid(GridConfig())
    grid.blocks.fill(tuple(slice(0, n) for n in grid.lattice.shape), 1.0)
    joints = {name: 0.0 for name, joint in RobotDescription.load().joints.items() if joint.type != "fixed"}
    shapes = robot.shapes(joints)
    changed = grid.forget(shapes, 0.0)
    gone = np.flatnonzero(grid.blocks.states().reshape(-1) == UNKNOWN)
    np.testing.assert_array_equal(changed.indices(), gone)
    centres = grid.lattice.centres(np.argwhere(np.ones(grid.lattice.shape, bool)))
    label, _ = robot.label_points(centres.astype(np.float32), shapes)
    assert np.count_nonzero(label) > 500
    assert np.count_nonzero((label == 1) != (grid.blocks.states().reshape(-1) == UNKNOWN)) <= 3
    assert np.isnan(grid.blocks.log_odds().reshape(-1)[gone]).all()
    assert grid.counts()["unknown"] == gone.size
