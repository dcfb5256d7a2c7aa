# SPDX-License-Identifier: Apache-2.0
"""Pairs of poses: the answer, its predicted error, pairs that contradict, and conventions of files."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_calibration.foreign.conventions import ROTATIONS, Convention, candidates, guess, is_ambiguous
from openarm_calibration.handeye.pose_pairs import PosePairs, solve_pairs
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.transforms import difference
from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from tests.openarm_calibration import foreign_files as files

SETUPS = ("in_hand", "to_hand")


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.requirement("A-36")
def test_exact_pairs_give_the_exact_mounts(setup) -> None:
    known = files.truth(setup)
    found = solve_pairs(known.pairs)
    assert mount_error(found.X, known.X) < (1e-6, 1e-6)
    assert mount_error(found.Z, known.Z) < (1e-6, 1e-6)


@pytest.mark.long
@pytest.mark.parametrize(("setup", "sets"), [("in_hand", 3), *((setup, 12) for setup in SETUPS)])
@pytest.mark.requirement("A-36")
def test_the_predicted_error_is_that_of_repetitions_and_the_noise_is_found(setup, sets: int) -> None:
    """Sets with 1 mm and 0.2 degrees: squared error over prediction is 6 on average."""
    nees, noise = [], []
    for seed in range(sets):
        known = files.truth(setup, 14, 1e-3, np.radians(0.2), seed)
        found = solve_pairs(known.pairs)
        error = difference(known.X, found.X)
        nees.append(error @ np.linalg.solve(found.covariance[:6, :6], error))
        noise.append(found.noise)
    assert 3.5 < np.mean(nees) < 9.0
    assert np.sqrt(np.mean(np.square(noise), axis=0)) == pytest.approx((1e-3, np.radians(0.2)), rel=0.15)


@pytest.mark.long
@pytest.mark.requirement("A-36")
def test_the_refinement_is_nearer_than_closed_forms_and_predicts_left_out_pairs_best() -> None:
    from openarm_calibration.handeye.closed_form import METHODS, closed_form

    errors: dict[str, list[float]] = {}
    for seed in range(6):
        known = files.truth("in_hand", 12, 2e-3, np.radians(0.3), seed)
        found = solve_pairs(known.pairs)
        errors.setdefault("REFINED", []).append(mount_error(found.X, known.X)[0])
        assert found.left_out.keys() == {"REFINED", *METHODS}
        for method in ("TSAI", "PARK", "DANIILIDIS"):
            X = closed_form(method, "in_hand", known.A, known.C).X
            errors.setdefault(method, []).append(mount_error(X, known.X)[0])
    rms = {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in errors.items()}
    assert min(rms, key=rms.__getitem__) == "REFINED"


@pytest.mark.requirement("A-36")
def test_a_pair_that_contradicts_the_others_is_left_out() -> None:
    known = files.truth("to_hand", 14, 1e-4, 1e-4, 3)
    C = known.C.copy()
    C[4, :3, 3] += (0.02, 0.0, 0.01)
    found = solve_pairs(PosePairs("to_hand", known.A, C, known.pairs.names))
    assert list(np.flatnonzero(~found.used)) == [4]
    assert mount_error(found.X, known.X)[0] < 1e-3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda T: T.A[:2], "too few poses: 2"),
        (lambda T: np.tile(T.A[0], (14, 1, 1)), "identical poses"),
        (lambda T: np.array([se3.make(T.A[0][:3, :3], A[:3, 3]) for A in T.A]), "pure translation"),
        (lambda T: np.array([se3.make(se3.rot_z(0.1 * k), (0.0, 0.0, 0.02 * k)) for k in range(14)]), "one rotation"),
        (lambda T: T.A * np.nan, "not finite"),
        (lambda T: T.A[:0], "too few poses"),
    ],
)
@pytest.mark.requirement("A-41")
def test_pairs_that_determine_nothing_are_refused_with_what_to_add(change, words: str) -> None:
    known = files.truth("in_hand")
    A = change(known)
    with pytest.raises(OpenArmError, match=words):
        solve_pairs(PosePairs("in_hand", A, known.C[: len(A)], known.pairs.names[: len(A)]))


@pytest.mark.parametrize("frames", ["T_base_tip", "T_tip_base"])
@pytest.mark.parametrize("unit", ["m", "mm"])
@pytest.mark.parametrize("rotation", ROTATIONS)
def test_each_convention_is_found_from_the_numbers_alone(rotation, unit, frames) -> None:
    """Board poses with noise of 0.5 mm and 0.1 degrees."""
    for setup in SETUPS:
        known = files.truth(setup, 12, 5e-4, np.radians(0.1), 7)
        rows = files.numbers(known.A, rotation, unit, frames)
        tried = guess(rows, known.C, setup, candidates(rows, None, None, None))
        assert tried[0].convention == Convention(rotation, unit, frames)
        assert not is_ambiguous(tried)
        assert tried[0].convention.poses(rows) == pytest.approx(known.A, abs=1e-9)


def test_rotations_that_do_not_tell_their_order_are_said_to_be_ambiguous() -> None:
    """Turns about x, y or z, one at a time: roll pitch yaw and rotation vector are the same numbers."""
    known = files.truth("in_hand")
    turns = (se3.rot_x, se3.rot_y, se3.rot_z)
    A = np.array([se3.make(turns[k % 3](0.1 * k), (0.02 * k, 0.01 * k * k, 0.3)) for k in range(10)])
    C = se3.inverse(known.X) @ np.linalg.inv(A) @ known.Z
    rows = files.numbers(A, "rotvec")
    tried = guess(rows, C, "in_hand", candidates(rows, None, "m", "T_base_tip"))
    assert {tried[0].convention.rotation, tried[1].convention.rotation} == {"rotvec", "rpy"}
    assert is_ambiguous(tried)


def test_a_tip_that_moves_within_millimetres_is_of_a_file_in_metres() -> None:
    """Read as millimetres the poses of a real arm hardly move, which noise of a degree does not exclude."""
    known = files.truth("in_hand", 13, 3e-3, np.radians(1.0), 4)
    rows = files.numbers(known.A, "rpy")
    tried = guess(rows, known.C, "in_hand", candidates(rows, None, None, None))
    assert tried[0].convention == Convention("rpy", "m", "T_base_tip")
    assert {one.convention.unit for one in tried} == {"m"}
    assert not is_ambiguous(tried)


@pytest.mark.parametrize("rows", [np.zeros((5, 5)), np.full((5, 7), 3.0), np.ones((5, 16))])
def test_numbers_that_are_no_poses_are_refused(rows) -> None:
    with pytest.raises(OpenArmError) as caught:
        candidates(rows, None, None, None)
    assert caught.value.code == Code.CONFIG_INVALID


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6), st.sampled_from(ROTATIONS))
def test_numbers_of_a_pose_and_back(values: list[float], rotation) -> None:
    A = se3.make(se3.exp_so3(values[3:]), values[:3])[None]
    rows = files.numbers(A, rotation, "mm", "T_tip_base")
    poses = Convention(rotation, "mm", "T_tip_base").poses(rows)
    assert poses is not None
    assert np.abs(poses - A).max() < 1e-6
