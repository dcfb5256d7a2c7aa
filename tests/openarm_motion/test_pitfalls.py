# SPDX-License-Identifier: Apache-2.0
"""Pitfalls of planners: paths through the chest, thin walls and starts outside a limit by rounding."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code
from openarm_motion.collision.exact import CollisionContext
from openarm_motion.collision.exact import CollisionScene as Scene
from openarm_motion.collision.solids import box_from
from openarm_motion.planning import moves
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.moves import RequestBoxes
from openarm_motion.timing.trajectory import Trajectory
from tests.refusals import refused

DOWN = se3.rotation_from_z_y((0, 0, -1), (0, 1, 0))


def overlaps(arm: Arm, state: dict[str, float], plan: Trajectory, boxes=()) -> list[str]:
    """What the arm really touches on the way: looks 2 ms apart, no clearance."""
    scene = Scene(arm.robot, CollisionContext(state, [*arm.static, *boxes]))
    with scene.lenient(0.0):
        states = plan.at(np.arange(0.0, plan.duration + 0.002, 0.002))[0]
        return [str(scene.contacts(q)[0]) for q in states if scene.collides(q)]


@pytest.mark.requirement("A-68")
def test_no_path_leads_through_the_chest(right: Arm, home: dict[str, float]) -> None:
    """Start and goal whose straight joint line goes through the body or the other arm."""
    rng, scene = np.random.default_rng(68), right.scene(home)
    while True:
        a, b = rng.uniform(right.kinematics.lower, right.kinematics.upper, (2, right.kinematics.n))
        if scene.collides(a) or scene.collides(b):
            continue
        hit = scene.first_hit(a, b)
        if hit is not None and scene.contacts(hit)[0].second not in scene.robot.arm.moving | {"table"}:
            break
    plan = moves.to_joints(right, right.start_state(home, a.tolist(), 1.0), b.tolist(), RequestBoxes())
    assert overlaps(right, home, plan) == []


def test_a_plan_does_not_tunnel_through_a_thin_wall(right: Arm, home: dict[str, float]) -> None:
    wall = box_from("sheet", (0.32, -0.21, 0.60), (0.24, 0.0002, 0.36))
    walled = right.scene(home, [wall])
    poses = [se3.make(DOWN, (0.32, y, 0.62)) for y in (-0.34, -0.08)]
    a, b = (next(s.q for s in right.inverse.solutions(p, 0.05) if not walled.collides(s.q)) for p in poses)
    assert walled.first_hit(a, b) is not None
    now = right.start_state(home, a.tolist(), 1.0)
    plan = moves.to_joints(right, now, b.tolist(), RequestBoxes([wall]))
    assert overlaps(right, home, plan, [wall]) == []


@pytest.mark.parametrize("beyond", [1e-9, 6e-9, 1e-6])
def test_a_start_outside_a_limit_by_rounding_is_no_error(beyond: float, right: Arm, home: dict[str, float]) -> None:
    start = np.array([home[name] for name in right.names])
    for i in (3, 6):
        q = start.copy()
        q[i] = right.kinematics.lower[i] - beyond
        if right.scene(home).collides(q):
            q = start.copy()
            q[i] = right.kinematics.upper[i] + beyond
        plan = moves.to_joints(right, right.start_state(home, q.tolist(), 1.0), start.tolist(), RequestBoxes())
        np.testing.assert_allclose(plan.q[-1], start, atol=1e-9)
        assert np.all(plan.q >= right.kinematics.lower - 1e-9)
        assert np.all(plan.q <= right.kinematics.upper + 1e-9)


def test_a_start_far_outside_a_limit_is_named(right: Arm, home: dict[str, float]) -> None:
    q = [home[name] for name in right.names]
    q[3] = float(right.kinematics.upper[3]) + 0.2
    assert refused("start: openarm_right_joint4", right.start_state, home, q).code is Code.LIMITS
