# SPDX-License-Identifier: Apache-2.0
"""Cells on OctoMap's lattice."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.errors import OpenArmError
from openarm_common.octree.lattice import KEY_ZERO, Lattice


@pytest.mark.requirement("A-54")
def test_faces_on_the_lattice_stay_where_they_are() -> None:
    """0.58 / 0.02 is 28.999… in floats; the box still has 29 cells."""
    lattice = Lattice.from_bounds(0.02, (0.0, -0.58, 0.0), (0.58, 0.0, 0.1))
    assert lattice.shape == (29, 29, 5)
    np.testing.assert_allclose(lattice.lower, (0.0, -0.58, 0.0), atol=1e-12)
    np.testing.assert_allclose(lattice.upper, (0.58, 0.0, 0.1), atol=1e-12)


def test_aligned_boxes_contain_what_was_asked_for() -> None:
    lattice = Lattice.from_bounds(0.02, (-0.3, 0.01, 0.0), (0.31, 0.2, 0.5), align=8)
    assert all(k % 8 == 0 and n % 8 == 0 for k, n in zip(lattice.key_min, lattice.shape, strict=True))
    assert (lattice.lower <= (-0.3, 0.01, 0.0)).all()
    assert (lattice.upper >= (0.31, 0.2, 0.5)).all()


def test_centres_and_indices_are_inverse() -> None:
    lattice = Lattice.from_bounds(0.02, (-0.2, -0.2, -0.2), (0.2, 0.2, 0.2))
    index = np.argwhere(np.ones(lattice.shape, bool))
    np.testing.assert_array_equal(lattice.indices(lattice.centres(index)), index)
    assert lattice.contains(index).all()
    assert not lattice.contains([-1, 0, 0])
    assert not lattice.contains([0, 0, 20])


@pytest.mark.parametrize("levels", [1, 2, 3, 15])
@pytest.mark.requirement("A-75")
def test_coarser_cells_contain_the_finer_ones(levels: int) -> None:
    """The centre of a coarse key is ``(key - 32768 + 0.5) * resolution`` again, as octomap readers compute it."""
    fine = Lattice.from_bounds(0.02, (-0.31, 0.07, -0.01), (0.2, 0.3, 0.2))
    coarse = fine.coarser(levels)
    index = np.argwhere(np.ones(fine.shape, bool))
    parents = coarse.indices(fine.centres(index))
    assert coarse.contains(parents).all()
    keys = parents + coarse.key_min
    np.testing.assert_array_equal(keys - (KEY_ZERO - (KEY_ZERO >> levels)), (index + fine.key_min) >> levels)
    assert np.abs(coarse.centres(parents) - fine.centres(index)).max() < coarse.resolution / 2


@pytest.mark.parametrize(
    ("resolution", "lower", "upper"),
    [
        (0.0, (0, 0, 0), (1, 1, 1)),
        (0.02, (0, 0, 0), (1, 1, 0)),
        (0.02, (0, 0, float("nan")), (1, 1, 1)),
        (0.001, (-40, 0, 0), (40, 1, 1)),
        (0.001, (-5, -5, -5), (5, 5, 5)),
    ],
)
def test_impossible_boxes_are_refused(resolution, lower, upper) -> None:
    with pytest.raises(OpenArmError, match="CONFIG_INVALID"):
        Lattice.from_bounds(resolution, lower, upper)
