# SPDX-License-Identifier: Apache-2.0
"""The distance field of a map: metres from each cell to the nearest obstacle, between centres, cut at a reach."""

from __future__ import annotations

import math

import numpy as np

from openarm_common.octree import distance_kernels as kernels
from openarm_common.octree.block_kernels import EDGE
from openarm_common.octree.blocks import VoxelBlocks
from openarm_common.octree.lattice import Lattice
from openarm_common.types import Floats
from openarm_octomap.config import UnknownPolicy
from openarm_octomap.kernels import OCCUPIED, UNKNOWN


class DistanceTransform:
    """Computes distance fields of one box; keeps its buffers.

    Args:
        lattice: The box.
        reach: Distances are cut here, m.
        unknown: State that unknown cells count as.
    """

    def __init__(self, lattice: Lattice, reach: float, unknown: UnknownPolicy = "free") -> None:
        self._edge = np.float32(lattice.resolution)
        self._reach = reach
        # a neighbour further away than this can't be the nearest within reach
        self._cells = min(math.ceil(reach / lattice.resolution), max(lattice.shape))
        self._cap = np.float32((reach / lattice.resolution) ** 2)
        self._unknown: UnknownPolicy = unknown
        self._plane = np.empty(lattice.shape[1:], np.float32)
        # planes along x that were overwritten and are within reach
        self._ring = np.empty((self._cells, *lattice.shape[1:]), np.float32)
        self._line = np.empty(lattice.shape[2], np.float32)

    def compute(self, blocks: VoxelBlocks, out: Floats) -> None:
        """Fill `out` (nx, ny, nz), m, from cells of the box."""
        for layer in range(int(blocks.shape[0])):
            states = blocks.states(slice(layer, layer + 1))
            if self._unknown == "occupied":
                states[states == UNKNOWN] = OCCUPIED
            kernels.along_z(states, OCCUPIED, self._cap, out[EDGE * layer : EDGE * (layer + 1)])
        kernels.along_y(out, self._cap, self._cells, self._plane)
        kernels.along_x(out, self._cap, self._cells, self._edge, self._line, self._ring)
