# SPDX-License-Identifier: Apache-2.0
"""Touches of the board with a tip, next to what the camera in the hand sees of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from openarm_bringup.cli import run
from openarm_calibration.handeye.problem import layout
from openarm_calibration.handeye.solve import solve
from openarm_calibration.handeye.touch import Touch, add_touch, check_touches, read_touches
from openarm_calibration.handeye.transforms import moved
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from tests.openarm_calibration.known_session import Known, make_session

MARKS = (0, 3, 20, 40, 43)


def board_of(known: Known) -> Array:
    """True pose (4, 4) of the board, base frame."""
    sample = known.samples.samples[0]
    return known.samples.pose(sample.joints) @ known.X @ sample.T_camera_board


def touches(known: Known, arm: str, tip: Array, noise: float, rng: np.random.Generator) -> list[Touch]:
    """Joints at which the tip is at marks, but for `noise` (m)."""
    description, parts = known.description, known.description.arms[arm]
    home = description.group_state(f"{arm}_arm", "home")
    T = board_of(known)

    def at(q: Array) -> Mapping[str, float]:
        return dict(zip(parts.joints, q.tolist(), strict=True))

    def miss(q: Array, point: Array) -> Array:
        pose = description.link_pose(parts.tcp, at(q))
        return pose[:3, :3] @ tip + pose[:3, 3] - point

    found: list[Touch] = []
    for mark in MARKS:
        point = T[:3, :3] @ known.samples.board.points[mark] + T[:3, 3] + rng.normal(0.0, noise, 3)
        solved = least_squares(miss, [home[name] for name in parts.joints], args=(point,), xtol=1e-12, ftol=1e-12)
        assert np.linalg.norm(solved.fun) < 1e-6
        found.append(Touch(mark, at(solved.x)))
    return found


#: Of a pointer in the hand: the board of these sessions is out of reach of the fingers, m.
TIP = np.array([0.0, 0.0, 0.4])


@pytest.mark.parametrize(
    ("arm", "sets"), [("left", 3), *(pytest.param(arm, 12, marks=pytest.mark.long) for arm in ("right", "left"))]
)
def test_touches_agree_with_a_right_calibration_as_often_as_predicted(arm: str, sets: int) -> None:
    significances: list[float] = []
    for seed in range(sets):
        known, rng = make_session(seed=seed), np.random.default_rng(seed)
        solution = solve(known.samples.problem())
        checked = check_touches(known.samples, solution, touches(known, arm, TIP, 5e-4, rng), tip=TIP, steady=5e-4)
        assert checked.agrees
        assert checked.rms < 2e-3
        significances.append(checked.significance)
    assert 1.0 < np.mean(significances) < 6.0  # of 3 degrees of freedom


def test_a_zero_that_is_off_or_another_tip_is_found() -> None:
    known, rng = make_session(), np.random.default_rng(0)
    solution = solve(known.samples.problem())
    sound = touches(known, "left", TIP, 5e-4, rng)
    joint = "openarm_left_joint4"
    wrong = [Touch(one.mark, {**one.joints, joint: one.joints[joint] + np.radians(1.0)}) for one in sound]
    for found, tip in ((wrong, TIP), (sound, TIP + np.array([0.0, 0.0, 0.01]))):
        checked = check_touches(known.samples, solution, found, tip=tip, steady=5e-4)
        assert not checked.agrees
        assert np.linalg.norm(checked.mean) > 3e-3


def test_the_predicted_error_of_a_mark_is_that_of_the_board_carried_to_it() -> None:
    """Next to the marks of boards that are drawn with the covariance of the board's pose."""
    known, rng = make_session(), np.random.default_rng(1)
    solution = solve(known.samples.problem())
    estimate = solution.estimate
    one = touches(known, "left", TIP, 0.0, rng)[-1]  # far from the middle of the board
    predicted = check_touches(known.samples, solution, [one], tip=TIP, steady=0.0).predicted
    first = layout(solution.problem, estimate.extras)["Z"].start
    covariance = estimate.covariance()[first : first + 6, first : first + 6]
    changes = rng.multivariate_normal(np.zeros(6), covariance, 20_000)
    boards = moved(np.repeat(estimate.Z[:1], len(changes), axis=0), changes)
    marks = boards[:, :3, :3] @ known.samples.board.points[one.mark] + boards[:, :3, 3]
    spread = marks.var(axis=0).sum() + 3.0 * estimate.noise.translation**2
    assert predicted == pytest.approx(np.sqrt(spread), rel=0.03)


def test_what_can_not_be_compared_is_refused_by_name() -> None:
    known = make_session(count=6)
    solution = solve(known.samples.problem())
    right = {name: 0.0 for name in known.description.arms["right"].joints}
    for one, named in (
        ([], "no touch"),
        ([Touch(99, right)], "has marks 0 to 43"),
        ([Touch(0, {"elbow": 0.0})], "expected all of one arm"),
    ):
        with pytest.raises(OpenArmError, match=named) as refused:
            check_touches(known.samples, solution, one)
        assert refused.value.code is Code.INVALID_ARGUMENT
    over = make_session("to_hand", count=6)
    with pytest.raises(OpenArmError, match="need a board that stands still"):
        check_touches(over.samples, solve(over.samples.problem()), [Touch(0, right)])


def test_touches_are_kept_in_a_file_and_its_faults_named(tmp_path: Path) -> None:
    path = tmp_path / "touches.csv"
    first, second = Touch(3, {"a": 0.1, "b": -1.0 / 3.0}), Touch(0, {"b": 0.2, "a": 1e-9})
    assert [add_touch(path, one) for one in (first, second)] == [1, 2]
    assert read_touches(path) == [first, second]
    with pytest.raises(OpenArmError, match="of another arm to another file"):
        add_touch(path, Touch(1, {"c": 0.0}))
    for text, named in (
        ("mark,a\n1,x\n", ":2: .*all numbers"),
        ("a\n1\n", ":2: .*columns mark"),
        ("mark,a\n1\n", ":2: "),
        ("mark,a\n1,nan\n", ":2: a joint is not finite"),
        ("mark,a\n1,2,3\n", ":2: "),
    ):
        path.write_text(text)
        with pytest.raises(OpenArmError, match=named):
            read_touches(path)
    with pytest.raises(OpenArmError, match="can't read"):
        read_touches(tmp_path / "none.csv")


@pytest.mark.long
def test_the_command_line_compares_and_says_what_is_off(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known, rng = make_session(), np.random.default_rng(1)
    known.samples.save(tmp_path / "wrist.npz")
    for one in touches(known, "right", TIP, 5e-4, rng):
        add_touch(tmp_path / "touches.csv", one)
    argv = ["calibrate", "check", str(tmp_path / "wrist.npz"), "--touches", str(tmp_path / "touches.csv"), "--json"]
    store = ["--store", str(tmp_path / "store")]

    run([*argv, *store, "--tip", "0", "0", "0.4"])
    sound = json.loads(capsys.readouterr().out)
    failed = run([*argv, *store, "--tip", "0", "0", "0.38"])
    off = json.loads(capsys.readouterr().out)

    assert sound["touches"]["agrees"]
    assert (failed, off["success"], off["code"]) == (1, False, "DEGENERATE")
    assert np.linalg.norm(off["touches"]["mean"]) == pytest.approx(0.02, abs=3e-3)
    assert "from where the camera sees them" in off["message"]
