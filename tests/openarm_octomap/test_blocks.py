# SPDX-License-Identifier: Apache-2.0
"""The map in blocks: equal to dense arrays cell by cell, and small where the workspace is large."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common.octree.blocks import VoxelBlocks
from openarm_common.octree.codec import decode
from openarm_common.octree.lattice import Lattice
from openarm_octomap.config import GridConfig
from openarm_octomap.grid import CloudScan, OccupancyGrid
from openarm_octomap.kernels import FREE, OCCUPIED, UNKNOWN
from tests.openarm_octomap.dense_map import DenseMap

#: Small steps within wide limits, so that cells have many different log-odds.
NUMBERS = {"hit": 0.847, "miss": -0.405, "clamp_min": -2.0, "clamp_max": 3.5, "max_range": -1.0}
#: Faces lie at keys that are multiples of 8 and not of 16; three blocks, four and two.
BOX = {"lower": (-0.16, -0.48, -0.8), "upper": (0.32, 0.16, -0.48)}
MS = 1_000_000


def same(grid: OccupancyGrid, dense: DenseMap) -> None:
    """Every layer of blocks has the same log-odds, as bytes, and states."""
    for layer in range(int(grid.blocks.shape[0])):
        blocks, cells = slice(layer, layer + 1), slice(8 * layer, 8 * layer + 8)
        ours, theirs = grid.blocks.log_odds(blocks), dense.log_odds(cells)
        np.testing.assert_array_equal(ours.view(np.int32), theirs.view(np.int32))
        state = np.where(np.isnan(theirs), UNKNOWN, np.where(theirs >= 0.0, OCCUPIED, FREE))
        np.testing.assert_array_equal(grid.blocks.states(blocks), state)


@settings(max_examples=12)
@given(st.data())
@pytest.mark.requirement("A-55")
def test_any_rays_give_the_cells_of_a_dense_map(data) -> None:
    """From within and from outside, through many blocks and along their borders, in turn with decay and clearing."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    limited, decay = data.draw(st.sampled_from([-1.0, 0.35])), data.draw(st.sampled_from([0.0, 0.1]))
    config = GridConfig(**(NUMBERS | BOX | {"max_range": limited, "decay_s": decay}))
    grid = OccupancyGrid(config)
    dense = DenseMap(grid.lattice, config)
    lower, upper = grid.lattice.lower, grid.lattice.upper
    spread = data.draw(st.sampled_from([0.0, 0.3]))
    for now in range(0, 300, 50):
        kind = data.draw(st.sampled_from(["scan", "scan", "border", "clear"]))
        if kind == "clear":
            a, b = np.sort(rng.uniform(lower - 0.05, upper + 0.05, (2, 3)), axis=0)
            box, state = grid.lattice.range_of(a, b), data.draw(st.sampled_from([FREE, UNKNOWN]))
            grid.clear_box(a, b, state)
            dense.known[box], dense.value[box] = state == FREE, config.clamp_min if state == FREE else 0.0
            same(grid, dense)
            continue
        origin = rng.uniform(lower - spread, upper + spread).astype(np.float32)
        points = rng.uniform(lower - spread, upper + spread, (data.draw(st.integers(1, 60)), 3)).astype(np.float32)
        if kind == "border":  # within a float of the faces of blocks
            points = np.round(points / np.float32(0.16)) * np.float32(0.16)
        update = grid.integrate([CloudScan(points, origin.astype(np.float64))], now * MS)
        np.testing.assert_array_equal(update.changed.indices(), dense.integrate(points, origin, now))
        assert update.changed.size == update.changed.indices().size
        same(grid, dense)
        if decay:
            np.testing.assert_array_equal(grid.decay(now * MS).indices(), dense.decay(now - 100))
            same(grid, dense)
        counts = np.bincount(dense.states().reshape(-1), minlength=3).tolist()
        assert list(grid.counts().values()) == counts[::-1]
        waiting = dense.seen[dense.known & (dense.value >= 0.0)]
        if decay:
            assert grid.oldest_s(now * MS) == pytest.approx((now - waiting.min()) * 1e-3 if waiting.size else 0.0)
    assert not np.any([grid._through, grid._hits])
    for payload in (grid.binary(), grid.full()):  # what is loaded is what was saved
        other = OccupancyGrid(config)
        assert other.load(decode(payload.data, grid.lattice.resolution, binary=payload.binary)) == 0
        np.testing.assert_array_equal(other.blocks.states(), grid.blocks.states())
        if not payload.binary:
            assert other.blocks.log_odds().tobytes() == grid.blocks.log_odds().tobytes()


def hall_scan(rng: np.random.Generator, rays: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) on the walls, floor and ceiling of an empty hall, and where they were seen from."""
    origin = rng.uniform((-8.0, -10.0, 1.0), (8.0, 10.0, 3.0)).astype(np.float32)
    way = rng.normal(size=(rays, 3))
    wall = np.where(way > 0, (13.9, 15.9, 11.9), (-13.9, -15.9, 0.1))
    points = origin + way * ((wall - origin) / way).min(axis=1, keepdims=True)
    return (size * points + rng.normal(0.0, 0.01, points.shape)).astype(np.float32), (size * origin).astype(np.float32)


@pytest.mark.parametrize(
    ("size", "seen", "most"), [(0.4, 250_000, 40e6), pytest.param(1.0, 800_000, 200e6, marks=pytest.mark.long)]
)
def test_a_long_scan_of_a_hall_takes_little_memory_and_equals_a_dense_map(size: float, seen: int, most: float) -> None:
    """86 million cells, of which a million are seen; as dense arrays they took 1.4 GB, with their octree 1.7 GB."""
    rng = np.random.default_rng(7)
    lower, upper = ((size * x, size * y, z) for x, y, z in ((-14.0, -16.0, 0.0), (14.0, 16.0, 12.0 * size)))
    hall = GridConfig(**NUMBERS, resolution=0.05, lower=lower, upper=upper)
    scans = [hall_scan(rng, 1000, size) for _ in range(5)]
    tracemalloc.start()
    try:
        grid = OccupancyGrid(hall)
        changed = [
            grid.integrate([CloudScan(points, origin.astype(np.float64))], i * 100 * MS).changed.size
            for i, (points, origin) in enumerate(scans)
        ]
        payload = grid.binary()
        peak = tracemalloc.get_traced_memory()[1]
        held = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        other = OccupancyGrid(hall)
        assert other.load(decode(payload.data, 0.05, binary=True)) == 0
        loading = tracemalloc.get_traced_memory()[1] - held
    finally:
        tracemalloc.stop()
    assert math.prod(grid.lattice.shape) == pytest.approx(560 * 640 * 240 * size**3, rel=0.02)
    assert grid.nbytes < peak < most
    dense = DenseMap(grid.lattice, hall)
    for i, (points, origin) in enumerate(scans):
        assert dense.integrate(points, origin, 100 * i).size == changed[i]
    same(grid, dense)
    counts = grid.counts()
    assert counts["free"] + counts["occupied"] > seen
    assert other.counts() == counts
    assert loading < grid.nbytes + 10e6


def test_what_is_alike_takes_no_memory_again() -> None:
    """Blocks that were mixed give their rows back when all of their cells agree, also as a part of a box."""
    blocks = VoxelBlocks(Lattice(0.02, (8, 8, 8), (16, 16, 32)))
    whole = (slice(0, 16), slice(0, 16), slice(0, 32))
    blocks.fill((slice(3, 13), slice(0, 16), slice(5, 6)), -1.0)
    taken = blocks.rows.pool.shape[0] - int(blocks.rows.top[0])
    assert taken == 4
    assert np.count_nonzero(blocks.states() == FREE) == 10 * 16
    blocks.fill((slice(0, 8), slice(0, 16), slice(0, 8)), -1.0)
    assert blocks.rows.pool.shape[0] - int(blocks.rows.top[0]) == 2
    blocks.fill(whole, math.nan)
    assert int(blocks.rows.top[0]) == blocks.rows.pool.shape[0]
    assert not blocks.states().any()


@pytest.mark.parametrize(("number", "width"), [(200, 1), (70_000, 4)])
def test_any_number_of_different_log_odds_is_exact(number: int, width: int) -> None:
    """The palette grows while cells are painted; 0 and -0 stay different."""
    rng = np.random.default_rng(number)
    blocks = VoxelBlocks(Lattice(0.02, (8, 16, 24), (48, 48, 40)))
    index = rng.permutation(np.argwhere(np.ones(blocks.lattice.shape, bool)))[: number + 5]
    values = np.concatenate([np.linspace(-3.0, 3.0, number), [0.0, -0.0, 1e-30, -2.0, 2.0]]).astype(np.float32)
    cells = np.column_stack([np.zeros(len(index)), index + blocks.key_min]).astype(np.int32)
    blocks.paint(cells, values)
    expected = np.full(blocks.lattice.shape, np.nan, np.float32)
    expected[tuple(index.T)] = values
    assert blocks.log_odds().tobytes() == expected.tobytes()
    assert blocks.rows.pool.itemsize == width


def test_log_odds_that_no_cell_has_make_room() -> None:
    blocks = VoxelBlocks(Lattice(0.02, (8, 16, 24), (48, 48, 40)))
    room = blocks.palette.states.size
    blocks.fill((slice(0, 48), slice(0, 48), slice(0, 40)), 0.5)
    for value in np.linspace(-1.0, 1.0, room + 2, dtype=np.float32):
        blocks.code_of(float(value))
    assert blocks.palette.states.size == room
    assert (blocks.log_odds() == np.float32(0.5)).all()
