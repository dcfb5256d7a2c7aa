# SPDX-License-Identifier: Apache-2.0
"""An octree of a client as cells: of any size, anywhere, next to those of the map, and never more than can be met."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import OpenArmError
from openarm_common.octree.codec import decode
from openarm_common.octree.lattice import Lattice
from openarm_motion.collision.occupancy import OccupancyMap
from openarm_motion.scene.octree import SceneOctree

pytestmark = pytest.mark.requirement("R-28")

#: One cell with its corner in the origin, as liboctomap 1.10 writes it.
BINARY = bytes.fromhex("00c0" + 14 * "0300" + "0200")
LOWER, UPPER = np.full(3, -0.5), np.full(3, 0.5)


def cells_of(edge: float, T: np.ndarray, seen: OccupancyMap | None = None) -> np.ndarray:
    """Centres of the cells for one cell of a size at a pose."""
    tree = SceneOctree(decode(BINARY, edge, binary=True), T)
    return tree.beside(seen, LOWER, UPPER).centres


@pytest.mark.parametrize("edge", [0.005, 0.02, 0.1, 0.37, 5.0])
@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_cells_are_those_that_an_occupied_one_overlaps(edge: float, turn: float) -> None:
    T = se3.make(se3.rot_z(turn)[:3, :3], (0.013, -0.11, 0.2))
    centres = cells_of(edge, T)

    middles = np.stack(np.meshgrid(*[np.arange(-31, 31) * 0.02 + 0.01] * 3, indexing="ij"), -1).reshape(-1, 3)
    local = (middles - T[:3, 3]) @ T[:3, :3]
    reach = 0.01 * np.array([abs(np.cos(turn)) + abs(np.sin(turn))] * 2 + [1.0])
    inside = ((local > 0.0) & (local < edge)).all(axis=1)
    near = ((local > -reach - 1e-6) & (local < edge + reach + 1e-6)).all(axis=1)
    found = {tuple(row) for row in np.round(centres, 6).tolist()}
    assert found >= {tuple(row) for row in np.round(middles[inside & (np.abs(middles) < 0.5).all(1)], 6).tolist()}
    assert {p for p in found if max(np.abs(p)) < 0.6} <= {tuple(row) for row in np.round(middles[near], 6).tolist()}
    assert len(centres) > 0


def test_cells_come_in_addition_to_those_of_the_map_in_its_size() -> None:
    lattice = Lattice.from_bounds(0.05, (-0.2, -0.2, 0.0), (0.2, 0.2, 0.4))
    seen = OccupancyMap(np.array([[0, 0, 0], [3, 4, 5]]), lattice, 7)

    tree = SceneOctree(decode(BINARY, 0.1, binary=True), se3.make(None, (0.3, 0.3, 0.3)))
    both = tree.beside(seen, LOWER, UPPER)

    assert both.version == 7
    assert both.lattice.resolution == 0.05
    wanted = [
        *seen.centres.tolist(),
        *([x, y, z] for x in (0.325, 0.375) for y in (0.325, 0.375) for z in (0.325, 0.375)),
    ]
    assert sorted(np.round(both.centres, 9).tolist()) == sorted(np.round(wanted, 9).tolist())
    assert both.distances.distances.min() == 0.0


def test_what_no_arm_can_meet_takes_no_memory() -> None:
    assert len(cells_of(0.1, se3.make(None, (30.0, 0.0, 0.0)))) == 0
    assert len(cells_of(100.0, se3.make(None, (-50.0, -50.0, -50.0)))) <= 64**3


def test_altered_octrees_are_cells_or_refused() -> None:
    rng = np.random.default_rng(5)
    made = 0
    for _ in range(200):
        data = np.frombuffer(BINARY, np.uint8).copy()
        data[rng.integers(0, len(data), 3)] = rng.integers(0, 256, 3)
        T = se3.make(se3.rot_z(rng.uniform(-3, 3))[:3, :3], rng.uniform(-1.0, 1.0, 3) * 10.0 ** rng.integers(-3, 5))
        try:
            leaves = decode(data.tobytes(), 10.0 ** rng.uniform(-4.0, 2.0), binary=True)
        except OpenArmError:
            continue
        made += 1
        cells = SceneOctree(leaves, T).beside(None, LOWER, UPPER)
        assert len(cells.indices) <= cells.lattice.cells
    assert made > 10
