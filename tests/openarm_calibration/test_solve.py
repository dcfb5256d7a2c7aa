# SPDX-License-Identifier: Apache-2.0
"""Closed forms, refinement, outliers, refusals; on problems with a known answer."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks import hand_eye_problems as synthetic
from openarm_calibration.handeye.closed_form import METHODS, closed_form
from openarm_calibration.handeye.problem import BoardView, assemble
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.solve import SolveConfig, solve
from openarm_calibration.handeye.transforms import difference, moved
from openarm_calibration.handeye.unknowns import Noise
from openarm_common import se3
from openarm_common.errors import Code, OpenArmError

SETUPS = ("in_hand", "to_hand")
ROBOT = (2e-4, math.radians(0.02))
LAX = SolveConfig(most_translation=1.0, most_rotation=3.0)


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.requirement("A-36", "A-37", "A-38", "A-39")
def test_every_closed_form_within_2_mm_and_0_2_degrees_on_clean_data(setup: str, method: str) -> None:
    """Both set-ups, names instead of numbers, arguments by keyword: X and Z are the true ones."""
    truth = synthetic.trial(setup, 12, Noise(1e-3), np.random.default_rng(1))
    mounts = closed_form(method.lower(), setup, truth.problem.A, truth.problem.free)
    for found, true in ((mounts.X, truth.X), (mounts.Z, truth.Z)):
        offset, angle = mount_error(found, true)
        assert offset < 0.002
        assert angle < math.radians(0.2)


@pytest.mark.requirement("A-38")
def test_an_unknown_method_lists_the_methods() -> None:
    with pytest.raises(OpenArmError, match="no method 'tsay'; methods: TSAI, PARK, HORAUD, ANDREFF, DANIILIDIS, SHAH"):
        closed_form("tsay", "in_hand", np.zeros((3, 4, 4)), np.zeros((3, 4, 4)))


@pytest.mark.parametrize(
    ("setup", "robot"),
    [
        ("in_hand", ROBOT),
        ("to_hand", (0.0, 0.0)),
        pytest.param("in_hand", (0.0, 0.0), marks=pytest.mark.long),
        pytest.param("to_hand", ROBOT, marks=pytest.mark.long),
    ],
)
def test_refinement_reaches_the_bound_and_its_covariance_is_honest(setup: str, robot: tuple[float, float]) -> None:
    """40 trials of 8 poses: rms error near the Cramér-Rao bound, NEES near 6, far below the best closed form."""
    rng = np.random.default_rng([setup == "in_hand", robot[0] > 0])
    noise = Noise(0.3, *robot)
    config = SolveConfig(px=0.3, robot_translation=robot[0], robot_rotation=robot[1])
    errors, bounds, closed, nees = [], [], [], []
    for _ in range(40):
        truth = synthetic.trial(setup, 8, noise, rng)
        solution = solve(truth.problem, config)
        away = difference(solution.estimate.X[0], truth.X)
        errors.append(away**2)
        bounds.append(np.diag(truth.bound(noise))[:6])
        nees.append(away @ np.linalg.solve(solution.mount_covariance(), away))
        start = closed_form("SHAH", setup, truth.problem.A, truth.problem.free)
        closed.append(difference(start.X, truth.X) ** 2)
    for axes in (slice(0, 3), slice(3, 6)):
        rms, bound, other = (math.sqrt(np.mean(np.sum(np.array(v)[:, axes], axis=1))) for v in (errors, bounds, closed))
        assert rms < 1.3 * bound
        assert rms < (0.5 if robot[0] == 0 else 0.85) * other
    assert 4.0 < np.mean(nees) < 8.0


def test_the_covariance_is_honest_where_few_poses_must_give_the_noise_too() -> None:
    """30 trials of 6 poses, nothing known beforehand: NEES near 6, and 95 % regions that hold nearly that often."""
    rng = np.random.default_rng([12, True])
    nees = []
    for k in range(30):
        truth = synthetic.trial(SETUPS[k % 2], 6, Noise(0.3, *ROBOT), rng)
        solution = solve(truth.problem, LAX)
        away = difference(solution.estimate.X[0], truth.X)
        nees.append(away @ np.linalg.solve(solution.mount_covariance(), away))
    assert 4.0 < np.mean(nees) < 8.0
    assert np.mean(np.array(nees) < 12.59) > 0.85


def test_scale_and_intrinsics_come_out_right() -> None:
    """A board printed 1 % small is found by its scale; a wrong focal length by freed intrinsics."""
    truth = synthetic.trial("in_hand", 15, Noise(0.1), np.random.default_rng(5))
    small = [
        BoardView(v.points * 0.99, v.pixels, v.A, v.setup, radius=v.radius * 0.99, pose=v.pose)
        for v in truth.problem.views
    ]
    scaled = assemble(small, [synthetic.INTRINSICS], list(truth.problem.free))
    estimate = solve(scaled, SolveConfig(extras=("scale",))).estimate
    assert estimate.scale == pytest.approx(1.0 / 0.99, abs=5e-4)
    wrong = synthetic.INTRINSICS.__class__(1280, 720, 890.0, 890.0, 640.0, 360.0)
    off = assemble(truth.problem.views, [wrong], list(truth.problem.free))
    free = solve(off, SolveConfig(extras=("intrinsics",))).estimate
    assert free.intrinsics[0, 0] == pytest.approx(10.0, abs=1.0)


def test_one_gross_outlier_among_twelve_is_named_and_does_no_harm() -> None:
    """A wrong robot pose: named; the error stays within 1.3 of that without it (rms of 4 trials)."""
    rng = np.random.default_rng(6)
    clean_error, error = [], []
    for _ in range(4):
        truth = synthetic.trial("in_hand", 12, Noise(0.3, *ROBOT), rng)
        bad = int(rng.integers(12))
        clean = solve(truth.problem.subset([i for i in range(12) if i != bad]))
        A = truth.problem.A.copy()
        A[bad] = moved(A[bad], np.concatenate([rng.normal(0, 0.02, 3), rng.normal(0, 0.05, 3)]))
        spoiled = solve(synthetic.with_poses(truth.problem, A))
        assert f"s{bad:02d}" in [outlier.name for outlier in spoiled.outliers]
        assert len(spoiled.outliers) <= 2
        clean_error.append(mount_error(clean.estimate.X[0], truth.X)[0])
        error.append(mount_error(spoiled.estimate.X[0], truth.X)[0])
    assert np.linalg.norm(error) < 1.3 * np.linalg.norm(clean_error)


def test_marks_in_a_wrong_order_are_an_outlier_too() -> None:
    truth = synthetic.trial("in_hand", 12, Noise(0.1), np.random.default_rng(7))
    views = list(truth.problem.views)
    right = views[4]
    views[4] = BoardView(right.points, right.pixels[::-1].copy(), right.A, "in_hand", right.radius, pose=4, name="s04")
    solution = solve(assemble(views, [synthetic.INTRINSICS], list(truth.problem.free)))
    assert [outlier.name for outlier in solution.outliers] == ["s04"]
    assert "do not lie on the board" in solution.outliers[0].reason
    assert mount_error(solution.estimate.X[0], truth.X)[0] < 1e-4


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("translation", "pure translation: .*rotate the hand by 30°"),
        ("axis", "one rotation axis: .*about the gripper's z axis; rotate by 15°"),
        ("turntable", "one rotation axis"),
        ("identical", "identical poses"),
        ("few", "too few poses: 2"),
    ],
)
@pytest.mark.requirement("A-41", "N-07")
def test_degenerate_sets_are_refused_by_name(setup: str, kind: str, name: str) -> None:
    """With what to add."""
    truth = synthetic.degenerate(kind, setup, np.random.default_rng(8), count=2 if kind == "few" else 10)
    with pytest.raises(OpenArmError, match=name) as caught:
        solve(truth.problem)
    assert caught.value.code == Code.DEGENERATE


@pytest.mark.parametrize("sets", [8, pytest.param(60, marks=pytest.mark.long)])
@pytest.mark.requirement("A-41")
def test_nearly_degenerate_sets_are_refused_or_right(sets: int) -> None:
    """Sets of every kind with small free rotations: no silent wrong result, no NaN (the benchmark runs 1000)."""
    refused = 0
    for k in range(sets):
        rng = np.random.default_rng([9, k])
        kind = synthetic.DEGENERATE[k % 4]
        setup = SETUPS[k // 4 % 2]
        truth = synthetic.degenerate(kind, setup, rng, math.radians(10.0 ** rng.uniform(-3, 1)))
        try:
            solution = solve(truth.problem)
        except OpenArmError as error:
            refused += error.code == Code.DEGENERATE
            continue
        away = difference(solution.estimate.X[0], truth.X)
        assert np.isfinite(away).all()
        assert away @ np.linalg.solve(solution.mount_covariance(), away) < 60.0
    assert sets / 6 < refused < sets


def test_numbers_that_are_not_finite_are_refused() -> None:
    truth = synthetic.trial("in_hand", 5, Noise(0.3), np.random.default_rng(10))
    A = truth.problem.A.copy()
    A[2, 0, 3] = np.nan
    with pytest.raises(OpenArmError, match="not a finite number"):
        solve(synthetic.with_poses(truth.problem, A))


def test_both_set_ups_in_one_solve_share_the_robots_error_and_a_board() -> None:
    """Wrist and overhead camera at the same poses, tied by the overhead camera's view of the wrist's board."""
    rng = np.random.default_rng(11)
    noise = Noise(0.3, *ROBOT)
    wrist = synthetic.trial("in_hand", 10, noise, rng)
    overhead = synthetic.trial("to_hand", 10, noise, rng)
    views = list(wrist.problem.views)
    guesses = list(wrist.problem.free)
    for view, free in zip(overhead.problem.views, overhead.problem.free, strict=True):
        views.append(BoardView(view.points, view.pixels, view.A, "to_hand", view.radius, 1, 1, 100 + view.pose))
        guesses.append(free)
    T = se3.inverse(overhead.X) @ wrist.Z  # the table's board from above
    from openarm_calibration.handeye.problem import project

    pixels = project(synthetic.BOARD.points, synthetic.BOARD.radius, T, np.array([900.0, 900.0, 640.0, 360.0]))
    pixels = pixels + rng.normal(0.0, noise.px, pixels.shape)
    views.append(BoardView(synthetic.BOARD.points, pixels, np.eye(4), "fixed", synthetic.BOARD.radius, 1, 0, 999))
    guesses.append(T)
    both = solve(assemble(views, [synthetic.INTRINSICS] * 2, guesses))
    alone = solve(overhead.problem)
    assert mount_error(both.estimate.X[0], wrist.X)[0] < 1.5e-3
    assert mount_error(both.estimate.X[1], overhead.X)[0] < 1.5e-3
    assert both.sigma(1)[0] < alone.sigma(0)[0]
