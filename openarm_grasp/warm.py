# SPDX-License-Identifier: Apache-2.0
"""Compiles the numba kernels of grasps on clouds, so that the first thing of unknown shape is not waited for."""

from __future__ import annotations

import numpy as np

from openarm_common.robot.description import RobotDescription
from openarm_grasp.config import ApproachConfig, CloudConfig
from openarm_grasp.sampling.antipodal import Search
from openarm_grasp.sampling.hand_shape import HandShape
from openarm_grasp.sampling.slabs import slabs
from openarm_grasp.sampling.surface import View, fuse


def warm() -> None:
    """Search grasps on the top of a small box on a table, as a camera above it sees it."""
    description = RobotDescription.load()
    u = np.arange(-0.1, 0.1, 0.0018)
    x, y = (grid.ravel() for grid in np.meshgrid(u, u))
    top = (np.abs(x) < 0.015) & (np.abs(y) < 0.03)
    points = np.column_stack([x, y, np.where(top, 0.05, 0.0)])
    surface = fuse([View(np.array([0.0, 0.0, 0.7]), points[top], table=points[~top])], 0.0)
    hand = HandShape.of(description, description.arm_names[0], ())
    Search(surface, hand, CloudConfig(), ApproachConfig()).best()
    slabs("box", surface.solid, surface.step)


if __name__ == "__main__":
    warm()
