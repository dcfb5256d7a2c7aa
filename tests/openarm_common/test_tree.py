# SPDX-License-Identifier: Apache-2.0
"""The kinematic tree next to the description."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_names
from openarm_common.robot.tree import KinematicTree


@pytest.mark.parametrize("name", robot_names())
def test_many_postures_at_once_are_those_one_by_one(name: str) -> None:
    robot = RobotDescription.load(name)
    names = [joint.name for joint in robot.joints.values() if joint.type != "fixed" and joint.mimic is None]
    tree = KinematicTree(robot, names)
    q = np.random.default_rng(0).uniform(-0.5, 0.5, (5, len(names)))
    one_by_one = [robot.link_poses(dict(zip(names, row, strict=True))) for row in q.tolist()]
    for link in robot.links:
        np.testing.assert_allclose(tree.link_poses(link, q), [poses[link] for poses in one_by_one], atol=1e-12)
