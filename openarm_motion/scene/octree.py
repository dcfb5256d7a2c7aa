# SPDX-License-Identifier: Apache-2.0
"""An octree that a client has put into the planning scene: its occupied cells, next to those of the map. m."""

from __future__ import annotations

import numpy as np

from openarm_common.octree.block_kernels import EDGE, OCCUPIED
from openarm_common.octree.blocks import VoxelBlocks
from openarm_common.octree.codec import CLAMP_MAX, CLAMP_MIN, Leaves
from openarm_common.octree.lattice import Lattice
from openarm_common.types import Array
from openarm_motion.collision.occupancy import OccupancyMap

#: Edge of the cells where there is no map, m.
_EDGE = 0.02


class SceneOctree:
    """A tree somewhere in the base frame.

    Args:
        leaves: The tree.
        T_base_tree: (4, 4).
    """

    def __init__(self, leaves: Leaves, T_base_tree: Array) -> None:
        self._leaves, self.T_base_tree = leaves, T_base_tree
        self._cells: OccupancyMap | None = None

    def beside(self, seen: OccupancyMap | None, lower: Array, upper: Array) -> OccupancyMap:
        """Return the cells of a map, or of none, and those of the tree in a box (two corners, base frame, m)."""
        edge = _EDGE if seen is None else seen.lattice.resolution
        lattice = Lattice.from_bounds(edge, lower.tolist(), upper.tolist(), align=EDGE)
        cells = self._cells
        if cells is None or cells.lattice != lattice:
            cells = self._cells = self._on(lattice)
        return cells if seen is None else seen.united(cells)

    def _on(self, lattice: Lattice) -> OccupancyMap:
        blocks = VoxelBlocks(lattice)
        moved = not np.allclose(self.T_base_tree, np.eye(4), atol=1e-9)
        self._leaves.put(blocks, CLAMP_MIN, CLAMP_MAX, self.T_base_tree if moved else None)
        return OccupancyMap(np.argwhere(blocks.states() == OCCUPIED), lattice, 0)
