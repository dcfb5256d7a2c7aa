# SPDX-License-Identifier: Apache-2.0
"""Plans that fail say where, what is in the way, and what would work instead."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code
from openarm_motion.collision.solids import box_from
from openarm_motion.planning import moves
from openarm_motion.planning.alternative import near_joints, near_pose
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.moves import RequestBoxes
from tests.refusals import refused

DOWN = se3.rotation_from_z_y((0, 0, -1), (0, 1, 0))


def test_a_pose_in_a_box_is_refused_with_the_pair_and_the_nearest_pose_above(
    right: Arm, home: dict[str, float]
) -> None:
    now, pose = right.start_state(home, scale=1.0), se3.make(DOWN, (0.28, -0.24, 0.50))
    around = RequestBoxes([box_from("crate", (0.28, -0.24, 0.45), (0.12, 0.12, 0.10))])
    error = refused(None, moves.to_pose, right, now, pose, around)
    assert (error.code, error.stage) == (Code.IN_COLLISION, "goal")
    assert error.contact is not None
    assert error.contact.second == "crate"
    found = near_pose(right, now, around, pose, budget=60.0)
    assert found is not None
    np.testing.assert_allclose(found.pose[:3, :3], DOWN, atol=1e-3)
    assert 0.01 < found.distance <= 0.11
    assert found.distance == pytest.approx(float(np.linalg.norm(found.pose[:3, 3] - pose[:3, 3])))
    assert moves.to_joints(right, now, found.q.tolist(), around).duration > 0.0


def test_a_pose_out_of_reach_has_the_nearest_in_reach(right: Arm, home: dict[str, float]) -> None:
    now, pose = right.start_state(home, scale=1.0), se3.make(DOWN, (0.62, -0.24, 0.62))
    error = refused(None, moves.to_pose, right, now, pose, RequestBoxes())
    assert (error.code, error.stage) == (Code.UNREACHABLE, "goal")
    found = near_pose(right, now, RequestBoxes(), pose, budget=60.0)
    assert found is not None
    assert 0.0 < found.distance < 0.35


def test_joints_in_a_wall_end_before_it(right: Arm, home: dict[str, float]) -> None:
    now = right.start_state(home, scale=1.0)
    scene = right.scene(home)
    goal = next(
        s.q for s in right.inverse.solutions(se3.make(DOWN, (0.30, -0.10, 0.62)), 0.05) if not scene.collides(s.q)
    )
    around = RequestBoxes([box_from("wall", (0.30, -0.10, 0.62), (0.1, 0.1, 0.1))])
    error = refused(None, moves.to_joints, right, now, goal.tolist(), around)
    assert error.stage == "goal"
    found = near_joints(right, now, around, goal, budget=60.0)
    assert found is not None
    assert not right.scene(home, around.obstacles).collides(found.q)
    assert found.distance < 0.4


def test_a_start_in_collision_names_the_pair(right: Arm, home: dict[str, float]) -> None:
    now = right.start_state(home, scale=1.0)
    hand = right.kinematics.fk(now.start)[:3, 3]
    around = RequestBoxes([box_from("brick", hand, (0.2, 0.2, 0.2))])
    error = refused(None, moves.to_joints, right, now, now.start.tolist(), around)
    assert (error.stage, error.code) == ("start", Code.IN_COLLISION)
    assert "starts in collision" in error.message
    assert error.contact is not None
    assert error.contact.second == "brick"


def test_a_line_that_hits_something_names_it(right: Arm, home: dict[str, float]) -> None:
    now = right.start_state(home, scale=1.0)
    below = right.kinematics.fk(now.start)
    below[2, 3] -= 0.08
    around = RequestBoxes([box_from("bar", below[:3, 3] - [0, 0, 0.02], (0.03, 0.03, 0.03))])
    error = refused(None, moves.to_pose_on_line, right, now, below, around)
    assert (error.stage, error.code) == ("line", Code.IN_COLLISION)
    assert error.contact is not None
    assert error.contact.second == "bar"
