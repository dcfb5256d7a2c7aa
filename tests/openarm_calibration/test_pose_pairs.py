# SPDX-License-Identifier: Apache-2.0
"""Pairs of poses: the answer, its predicted error, pairs that contradict, and conventions of files."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_calibration.foreign.conventions import FORMS, Convention, checked_form, readings
from openarm_calibration.foreign.explain import BOARD_FRAMES, ROBOT_FRAMES, Hypothesis, Poses, decided, search
from openarm_calibration.handeye.consensus import agreed
from openarm_calibration.handeye.pose_pairs import PosePairs, solve_pairs
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.transforms import difference
from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from tests.openarm_calibration import foreign_files as files
from tests.refusals import refuses

SETUPS = ("in_hand", "to_hand")
#: Forms that are found in each run of the tests.
OFTEN = ("xyzw", "wxyz", "columns", "rotvec_deg", "xyz", "ZYX_deg", "ZYZ", "yxz_deg")


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


@pytest.mark.requirement("A-36")
def test_two_wrong_pairs_that_hide_each_other_are_left_out_and_no_other() -> None:
    known = files.truth("in_hand", 14, 5e-4, np.radians(0.1), 5)
    C = known.C.copy()
    C[2, :3, 3] += (0.03, 0.0, 0.0)
    C[9, :3, :3] = C[9, :3, :3] @ se3.rot_x(0.1)
    found = solve_pairs(PosePairs("in_hand", known.A, C, known.pairs.names))
    assert list(np.flatnonzero(~found.used)) == [2, 9]
    assert mount_error(found.X, known.X)[0] < 4.0 * found.sigma[0]


@pytest.mark.parametrize("setup", SETUPS)
def test_what_most_pairs_agree_with_is_not_moved_by_a_third_of_wrong_ones(setup) -> None:
    known = files.truth(setup, 15, 2e-4, np.radians(0.05), 6)
    C = known.C.copy()
    C[::3] = C[[3, 6, 9, 12, 0]]
    C[:, :3, 3] *= 1000.0
    found = agreed(known.pairs.B, C, scaled=True)
    assert found.scale == pytest.approx(1e-3, rel=0.01)
    assert mount_error(found.X, known.X) < (2e-3, np.radians(0.4))


def four_axes(setup, count: int = 14) -> files.Truth:
    """An arm that turns about one axis only; noise of 0.5 mm and 0.1 degrees on the board's poses."""
    known, rng = files.truth(setup), np.random.default_rng(2)
    A = np.array([se3.make(se3.rot_z(rng.uniform(-2, 2)), rng.uniform(-0.3, 0.3, 3)) for _ in range(count)])
    B = np.linalg.inv(A) if setup == "in_hand" else A
    noise = [se3.make(se3.exp_so3(rng.normal(0.0, 2e-3, 3)), rng.normal(0.0, 5e-4, 3)) for _ in range(count)]
    return files.Truth(setup, known.X, known.Z, A, se3.inverse(known.X) @ B @ known.Z @ np.array(noise))


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.requirement("A-41")
@pytest.mark.requirement("M-06")
def test_an_arm_of_four_axes_tells_five_numbers_of_the_mount_and_takes_the_sixth(setup) -> None:
    known = four_axes(setup)
    found = solve_pairs(known.pairs)
    assert np.abs(found.free) == pytest.approx((0.0, 0.0, 1.0), abs=1e-9)
    away = found.X[:3, 3] - known.X[:3, 3]
    assert np.linalg.norm(away[:2]) < 4.0 * found.sigma[0] < 4e-3
    assert mount_error(found.X, known.X)[1] < np.radians(0.3)
    whole = solve_pairs(known.pairs, {"z": float(known.X[2, 3])})
    assert not whole.free.any()
    assert mount_error(whole.X, known.X)[0] < 4.0 * whole.sigma[0]
    for fixed, words in (({"x": 0.1}, "along its parent's z axis"), ({"y": 0.1, "z": 0.1}, "give that one")):
        with refuses(Code.INVALID_ARGUMENT, words):
            solve_pairs(known.pairs, fixed)
    with refuses(Code.INVALID_ARGUMENT, "determine all six numbers"):
        solve_pairs(files.truth(setup).pairs, {"z": 0.1})


def told(known: files.Truth, robot: str = "xyzw", board: str = "matrix", **stated) -> Hypothesis:
    """The convention that is found of poses in these forms, mm where `unit` or `board_unit` says so."""
    usual = {"unit": "m", "board_unit": "m", "setup": known.setup, "inverse": False, "board_inverse": False}
    ways = {key: stated.pop(key, value) for key, value in usual.items()}
    A = np.linalg.inv(known.A) if ways["inverse"] else known.A
    C = np.linalg.inv(known.C) if ways["board_inverse"] else known.C
    of_robot = Poses(files.numbers(A, robot, ways["unit"]), ROBOT_FRAMES, **stated)
    of_board = Poses(files.numbers(C, board, ways["board_unit"]), BOARD_FRAMES)
    return decided(search(of_robot, of_board, (ways["setup"],)), (ways["setup"],), of_robot, of_board)


@pytest.mark.parametrize(
    "rotation",
    [
        form if form in OFTEN else pytest.param(form, marks=pytest.mark.long)
        for forms in FORMS.values()
        for form in forms
    ],
)
@pytest.mark.requirement("A-36")
def test_each_convention_is_found_from_the_numbers_alone(rotation) -> None:
    """All Euler angles in both senses, m or mm of either; board poses with noise of 1 mm and 0.2 degrees."""
    known = files.truth("in_hand" if len(rotation) % 2 else "to_hand", 12, 1e-3, np.radians(0.2), 7)
    found = told(known, rotation, "rotvec", unit="mm" if len(rotation) > 4 else "m", board_unit="mm")
    rows = files.numbers(known.A, rotation, found.robot.unit)
    assert found.robot.poses(rows) == pytest.approx(known.A, abs=1e-9)
    assert found.board.poses(files.numbers(known.C, "rotvec", "mm")) == pytest.approx(known.C, abs=1e-9)
    assert found.scale == 1.0


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        (
            {"setup": "to_hand"},
            r"as eye_in_hand; .* give --frames T_tip_base or --board-frames .*, --camera-kind eye_in_hand",
        ),
        ({"inverse": True}, r"as eye_to_hand; .*--frames T_tip_base or --board-frames T_board_camera"),
        ({"board_inverse": True}, "--board-frames T_board_camera"),
        ({"rotation": "wxyz"}, r"as stated .* remain; .* give --rotation xyzw \(quaternion x y z w\)"),
    ],
)
@pytest.mark.requirement("A-36")
def test_what_is_stated_wrongly_is_refused_with_what_fits_and_what_to_type(stated, words: str) -> None:
    known = files.truth("in_hand", 12, 5e-4, np.radians(0.1), 7)
    with refuses(Code.DEGENERATE, words):
        told(known, **stated)


def test_a_unit_that_is_stated_wrongly_is_named() -> None:
    known = files.truth("in_hand", 12, 5e-4, np.radians(0.1), 7)
    rows = Poses(files.numbers(known.A, "xyzw"), ROBOT_FRAMES, unit="mm"), Poses(known.C.reshape(-1, 16), BOARD_FRAMES)
    with refuses(Code.DEGENERATE, "give --unit m$|give --unit m\n"):
        decided(search(*rows, ("in_hand",)), ("in_hand",), *rows)


def test_a_board_of_another_size_is_told_by_its_lengths() -> None:
    known = files.truth("to_hand", 12, 5e-4, np.radians(0.1), 7)
    C = known.C.copy()
    C[:, :3, 3] *= 4.0 / 3.0
    found = told(files.Truth("to_hand", known.X, known.Z, known.A, C))
    assert found.scale == pytest.approx(0.75, rel=0.02)


def test_poses_that_do_not_belong_together_are_refused_and_one_that_stands_out_is_named() -> None:
    known = files.truth("in_hand", 12, 5e-4, np.radians(0.1), 7)
    mixed = files.Truth("in_hand", known.X, known.Z, known.A, known.C[np.random.default_rng(0).permutation(12)])
    with refuses(Code.DEGENERATE, "no convention explains the poses"):
        told(mixed)


def test_rotations_that_do_not_tell_their_order_are_said_to_be_ambiguous() -> None:
    """Turns about x, y or z, one at a time, and small noise: roll pitch yaw and rotation vector are nearly the same."""
    known, rng = files.truth("in_hand"), np.random.default_rng(0)
    turns = (se3.rot_x, se3.rot_y, se3.rot_z)
    A = np.array([se3.make(turns[k % 3](0.1 * k) @ se3.exp_so3(rng.normal(0, 1e-4, 3)), (0.02 * k, 0.01 * k * k, 0.3))
                  for k in range(10)])  # fmt: skip
    C = se3.inverse(known.X) @ np.linalg.inv(A) @ known.Z
    noise = np.array([se3.make(se3.exp_so3(rng.normal(0, 1e-3, 3)), rng.normal(0, 5e-4, 3)) for _ in A])
    with refuses(Code.DEGENERATE, "explain the poses about as well; give --rotation"):
        told(files.Truth("in_hand", known.X, known.Z, A, C @ noise), "rotvec")


@pytest.mark.parametrize("rows", [np.zeros((5, 5)), np.full((5, 7), 3.0), np.ones((5, 16))])
def test_numbers_that_are_no_poses_are_refused(rows) -> None:
    with refuses(Code.CONFIG_INVALID):
        readings(rows, ROBOT_FRAMES)


def test_names_of_forms_are_those_of_urdf_kuka_and_scipy() -> None:
    assert (checked_form("rpy_deg"), checked_form("abc"), checked_form("zyz")) == ("xyz_deg", "ZYX", "zyz")
    with refuses(Code.INVALID_ARGUMENT, "no rotation 'xyx_rad'; expected xyzw"):
        checked_form("xyx_rad")


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6),
    st.sampled_from(("xyzw", "wxyz", "rotvec_deg", "XYZ", "zxz_deg", "matrix", "columns")),
)
def test_numbers_of_a_pose_and_back(values: list[float], rotation) -> None:
    A = se3.make(se3.exp_so3(values[3:]), values[:3])[None]
    rows = files.numbers(A, rotation, "mm", "T_tip_base")
    poses = Convention(rotation, "mm", inverse=True).poses(rows)
    assert poses is not None
    assert np.abs(poses - A).max() < 1e-6
