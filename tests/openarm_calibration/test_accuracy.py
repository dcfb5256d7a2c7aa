# SPDX-License-Identifier: Apache-2.0
"""The predicted errors of a mount and of the hand, where the zeros of joints are off and where they are not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from openarm_calibration.handeye.accuracy import accuracy_of
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.solve import SolveConfig, solve
from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from tests.openarm_calibration.known_session import Known, make_session

LAX = SolveConfig(most_translation=0.1, most_rotation=0.2)


def missed(known: Known, X: Array, described: RobotDescription, offsets: dict[str, float]) -> float:
    """How far the hand is from what the camera sees there, by kinematics of the robot as it is, m rms."""
    out: list[Array] = []
    carrier, samples, tcp = known.samples.head.parent, known.samples.samples, described.tcp_link("right")
    home = dict.fromkeys(described.joints, 0.0)
    for before, sample in zip([samples[-1], *samples[:-1]], samples, strict=True):
        as_reported, true = (
            [
                described.link_poses(home | {n: q + f * offsets[n] for n, q in one.joints.items()})
                for one in (before, sample)
            ]
            for f in (0.0, 1.0)
        )
        in_camera = se3.inverse(as_reported[0][carrier] @ X) @ as_reported[1][tcp][:, 3]
        out.append((true[0][carrier] @ known.X @ in_camera - true[1][tcp][:, 3])[:3])
    return math.sqrt(float(np.mean(np.sum(np.square(out), axis=1))))


@pytest.mark.parametrize("rms", [0.0, 0.1])
@pytest.mark.parametrize("setup", ["to_hand", "in_hand"])
@pytest.mark.requirement("A-40", "R-11")
def test_predicted_errors_are_those_of_repetitions(setup, rms: float) -> None:
    """Four robots each, zeros as they are left by a calibration of zeros (0.1° rms) or exact."""
    names, squares = [f"openarm_right_joint{k}" for k in range(1, 8)], []
    for seed in range(4):
        offsets = dict(zip(names, np.random.default_rng(seed).normal(0.0, math.radians(rms), 7).tolist(), strict=True))
        known = make_session(setup, 15, 0.02, seed=seed, zeros=offsets, spread=0.5)
        solution = solve(known.samples.problem(), LAX)
        X = solution.estimate.X[0]
        found, (t, r) = accuracy_of(known.samples, solution), mount_error(X, known.X)
        hand = missed(known, X, known.description, offsets)
        zeros = np.mean([(offsets[name] / deviation) ** 2 for name, deviation in found.zeros.items()])
        squares.append([(t / found.translation) ** 2, (r / found.rotation) ** 2, (hand / found.hand) ** 2, zeros])
    assert (np.mean(squares, axis=0)[: 4 if rms else 3] > 0.1).all()
    assert (np.mean(squares, axis=0) < 2.5).all()
