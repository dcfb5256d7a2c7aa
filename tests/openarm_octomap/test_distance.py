# SPDX-License-Identifier: Apache-2.0
"""Distance transform against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from openarm_common.octree.blocks import VoxelBlocks
from openarm_common.octree.lattice import Lattice
from openarm_octomap.distance import DistanceTransform

LATTICE = Lattice.from_bounds(0.02, (0, 0, 0), (0.8, 0.64, 0.48))


def blocks_of(states: np.ndarray) -> VoxelBlocks:
    blocks = VoxelBlocks(LATTICE)
    blocks.set_layers(0, np.array([np.nan, -1.0, 1.0], np.float32)[states])
    return blocks


@pytest.mark.parametrize("density", [0.0, 1e-5, 1e-4, 1e-3, 0.1, 1.0])
@pytest.mark.parametrize("reach", [0.1, 0.4, 0.53])
def test_distances_equal_scipy_cut_at_the_reach(density: float, reach: float) -> None:
    rng = np.random.default_rng(4)
    states = rng.integers(0, 2, LATTICE.shape).astype(np.uint8)
    states[rng.random(LATTICE.shape) < density] = 2
    out = np.empty(LATTICE.shape, np.float32)
    DistanceTransform(LATTICE, reach).compute(blocks_of(states), out)
    truth = np.full(LATTICE.shape, reach)
    if (states == 2).any():
        truth = np.minimum(distance_transform_edt(states != 2) * 0.02, reach)
    np.testing.assert_allclose(out, truth, atol=1e-6)


def test_unknown_cells_count_as_asked() -> None:
    states = np.ones(LATTICE.shape, np.uint8)
    states[5, 5, 5] = 0
    out = np.empty(LATTICE.shape, np.float32)
    DistanceTransform(LATTICE, 0.4, "occupied").compute(blocks_of(states), out)
    assert out[5, 5, 7] == pytest.approx(0.04)
    DistanceTransform(LATTICE, 0.4, "free").compute(blocks_of(states), out)
    np.testing.assert_allclose(out, 0.4, rtol=1e-6)
