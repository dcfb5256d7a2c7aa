# SPDX-License-Identifier: Apache-2.0
"""The next best pose, and advice in words."""

from __future__ import annotations

import math

import numpy as np
import pytest

from openarm_calibration.handeye.problem import moved
from openarm_calibration.handeye.refine import Noise
from openarm_calibration.handeye.solve import SolveConfig, solve
from openarm_calibration.sampling.poses import advice, around, rank, robot_pose
from openarm_calibration.synthetic import synthetic
from openarm_common import se3
from openarm_common.errors import OpenArmError

CONFIG = SolveConfig(most_translation=0.05, most_rotation=0.1)


@pytest.mark.parametrize("setup", ["in_hand", "to_hand"])
@pytest.mark.requirement("N-07", "A-40")
def test_chosen_poses_tell_more_than_random_ones(setup: str) -> None:
    """Four poses and then six chosen among 40 each: the true error bound is below that of six random ones."""
    rng = np.random.default_rng(1)
    noise = Noise(0.3, 2e-4, 4e-4)
    first = synthetic.views(setup, 4, rng)
    X, Z = synthetic.mounts(setup)
    chosen = list(first)
    for _ in range(6):
        solution = solve(synthetic.make(setup, np.array(chosen), noise, rng).problem, CONFIG)
        pool = synthetic.views(setup, 40, rng)
        best = rank(synthetic.BOARD, solution, np.array([robot_pose(setup, X, Z, C) for C in pool]))[0]
        chosen.append(pool[best.index])
    bound = [np.trace(synthetic.make(setup, np.array(chosen), noise, rng).bound(noise)[:3, :3])]
    for _ in range(5):
        views = np.concatenate([first, synthetic.views(setup, 6, rng)])
        bound.append(np.trace(synthetic.make(setup, views, noise, rng).bound(noise)[:3, :3]))
    assert math.sqrt(bound[0]) < 0.9 * math.sqrt(np.mean(bound[1:]))


def test_predicted_errors_shrink_and_what_does_not_show_the_board_is_left_out() -> None:
    rng = np.random.default_rng(2)
    truth = synthetic.trial("in_hand", 6, Noise(0.3), rng)
    solution = solve(truth.problem, CONFIG)
    views = around(truth.problem.free[0], 20, rng)
    poses = np.array([robot_pose("in_hand", truth.X, truth.Z, C) for C in views])
    away = moved(poses[:1], np.array([[0.0, 0.0, 0.0, 0.0, math.pi, 0.0]]))
    ranked = rank(synthetic.BOARD, solution, np.concatenate([poses, away]))
    assert all(choice.index != len(poses) for choice in ranked)
    assert ranked[0].sigma_translation < solution.sigma()[0]
    with pytest.raises(OpenArmError, match="none of 1 candidate poses would show all of the board"):
        rank(synthetic.BOARD, solution, away)


@pytest.mark.requirement("N-07")
def test_advice_names_the_axis_that_is_missing() -> None:
    """Turns about z only: x or y is asked for; with enough of everything it says so."""
    assert "first sample" in advice([])
    turned = [se3.make(se3.rot_z(0.2 * k), (0.01 * k, 0.0, 0.0)) for k in range(5)]
    assert "wrist's x axis by 30° or more" in advice(turned)
    rng = np.random.default_rng(3)
    many = [se3.make(se3.exp_so3(rng.uniform(-0.5, 0.5, 3)), rng.uniform(-0.1, 0.1, 3)) for _ in range(12)]
    assert advice(many).startswith("enough")
    assert advice(many[:8]).startswith("4 more")
