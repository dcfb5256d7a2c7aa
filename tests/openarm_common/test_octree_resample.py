# SPDX-License-Identifier: Apache-2.0
"""Octrees of other cells and frames in a map: cell by cell as by brute force on parts of the size of both."""

from __future__ import annotations

import tracemalloc
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.octree.blocks import VoxelBlocks
from openarm_common.octree.codec import Leaves, decode, encode_states
from openarm_common.octree.lattice import Lattice

#: Of the map, m; and its box, cells from the origin.
EDGE, FIRST, SIZE = 0.02, -8, 16
FREE, OCCUPIED = 1, 2


def map_of(leaves: Leaves, T: np.ndarray | None = None, edge: float = EDGE) -> tuple[np.ndarray, int]:
    """States of the box and how many leaves lie outside of it."""
    blocks = VoxelBlocks(Lattice(edge, (32768 + FIRST,) * 3, (SIZE,) * 3))
    outside = leaves.put(blocks, -2.0, 3.5, T)
    return blocks.states(), outside


def tree_of(states: np.ndarray, first: int, edge: float) -> Leaves:
    """The tree of a box of states whose first cell is `first` cells from the origin."""
    payload = encode_states(Lattice(edge, (32768 + first,) * 3, states.shape), states)
    return decode(payload.data, edge, binary=True)


def expected(states: np.ndarray, first: int, ratio: Fraction) -> np.ndarray:
    """By parts, of which a cell of the file has `ratio.numerator` along an edge, and one of the map the denominator."""
    p, q = ratio.numerator, ratio.denominator
    at = (np.arange(FIRST * q, (FIRST + SIZE) * q)) // p - first
    inside = (at >= 0) & (at < len(states))
    parts = states[np.ix_(*(np.clip(at, 0, len(states) - 1),) * 3)] * inside[:, None, None]
    parts = parts * inside[None, :, None] * inside[None, None, :]
    parts = parts.reshape(SIZE, q, SIZE, q, SIZE, q).transpose(0, 2, 4, 1, 3, 5).reshape((SIZE,) * 3 + (-1,))
    return np.where((parts == 2).any(-1), 2, np.where((parts == 1).all(-1), 1, 0))


def scene(seed: int, n: int) -> np.ndarray:
    """Mostly whole blocks, so that leaves of many levels are in the tree, and some single cells."""
    rng = np.random.default_rng(seed)
    states = np.kron(rng.integers(0, 3, (-(-n // 4),) * 3), np.ones((4, 4, 4)))[:n, :n, :n].astype(np.uint8)
    some = rng.random(states.shape) < 0.01
    states[some] = rng.integers(0, 3, np.count_nonzero(some))
    return states


@pytest.mark.requirement("M-09")
@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(["1", "2", "5/2", "5/4", "1/2", "5", "8", "3/2", "2/5", "1/8", "2/3", "13/7"]),
    st.integers(-30, 2),
)
def test_a_cell_is_occupied_where_any_part_is_and_free_where_all_of_it_is(seed: int, ratio: str, first: int) -> None:
    of_map = Fraction(ratio)
    n = max(int(20 / of_map), 4)
    states = scene(seed, n)
    found, _ = map_of(tree_of(states, first, float(of_map) * EDGE))
    np.testing.assert_array_equal(found, expected(states, first, of_map))


@pytest.mark.parametrize("edge", [0.05, 0.0333333, 0.05000000074505806])
def test_cells_whose_size_is_rounded_leave_no_gaps(edge: float) -> None:
    """As in a header of six digits, or of float32: between two free cells nothing is unknown, and beyond none is."""
    found, outside = map_of(tree_of(np.full((16, 16, 16), FREE, np.uint8), -8, edge))
    assert (found == FREE).all()
    assert outside > 0
    exact = map_of(tree_of(np.full((4, 4, 4), OCCUPIED, np.uint8), 0, 0.06 * (1.0 + 2e-7)))[0]
    assert np.argwhere(exact == OCCUPIED).min() == -FIRST


def test_a_tree_in_another_frame_is_moved_and_turned() -> None:
    states = scene(4, 16)
    tree, plain = tree_of(states, FIRST, EDGE), scene(4, 16)
    np.testing.assert_array_equal(map_of(tree, np.eye(4))[0], plain)
    moved, outside = map_of(tree, se3.make(None, (0.06, 0.0, -0.02)))
    np.testing.assert_array_equal(moved[3:, :, :-1], plain[:-3, :, 1:])
    assert not moved[:3].any()
    assert outside > 0
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(map_of(tree, se3.make(quarter, (0, 0, 0)))[0], np.rot90(plain, 1, (0, 1)))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_turned_tree_loses_nothing_and_frees_nothing_that_is_not(seed: int) -> None:
    """Points of an occupied cell lie in occupied ones; a point of a free one in a free one."""
    rng = np.random.default_rng(seed)
    states = scene(seed, 12)
    T = se3.make(se3.exp_so3(rng.normal(0.0, 1.0, 3)), rng.uniform(-0.1, 0.1, 3))
    found, _ = map_of(tree_of(states, -6, 0.03), T)
    points = rng.uniform(-0.16, 0.16, (4000, 3))
    here = np.floor(points / EDGE).astype(int) - FIRST
    there = np.floor((points - T[:3, 3]) @ T[:3, :3] / 0.03).astype(int) + 6
    inside = ((there >= 0) & (there < 12)).all(axis=1)
    truth = np.where(inside, states[tuple(np.clip(there, 0, 11).T)], 0)
    said = found[tuple(here.T)]
    assert (said[truth == OCCUPIED] == OCCUPIED).all()
    assert (truth[said == FREE] == FREE).all()


def test_a_tree_of_the_largest_cells_takes_no_more_memory_than_the_map() -> None:
    """One leaf of 100 m, of level 15, covers half of all keys."""
    tree = decode(b"\x00\x80", 100.0, binary=True)
    tracemalloc.start()
    found, outside = map_of(tree, edge=0.005)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (found[8:, 8:, 8:] == OCCUPIED).all()
    assert np.count_nonzero(found) == 512
    assert outside == 1
    assert peak < 4e6
