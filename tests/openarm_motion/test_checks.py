# SPDX-License-Identifier: Apache-2.0
"""Checks of trajectories before they are sent."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code
from openarm_motion.collision.solids import Box
from openarm_motion.planning import moves
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.moves import RequestBoxes
from openarm_motion.scene.held import HeldObjects
from openarm_motion.timing.checks import check_against_others, check_trajectory
from openarm_motion.timing.trajectory import Motion, Trajectory
from tests.refusals import refuses


@pytest.fixture
def plan(right: Arm, home: dict[str, float]) -> Trajectory:
    goal = [home[name] + 0.1 for name in right.names]
    return moves.to_joints(right, right.start_state(home), goal, RequestBoxes())


def fault(arm: Arm, state: dict[str, float], plan: Trajectory, code: Code, **change) -> str:
    values = {"names": plan.names, "t": plan.t, "q": plan.q.copy(), "v": plan.v.copy(), **change}
    with refuses(code) as caught:
        check_trajectory(arm, Motion(**values), state)
    return caught.value.message


def test_what_was_planned_passes(right: Arm, home: dict[str, float], plan: Trajectory) -> None:
    motion = check_trajectory(right, Motion(plan.names, plan.t, plan.q, plan.v), home)
    assert motion.duration == plan.duration
    # columns in another order are put right
    order = [3, 1, 2, 0, 6, 5, 4]
    names = tuple(plan.names[i] for i in order)
    again = check_trajectory(right, Motion(names, plan.t, plan.q[:, order], plan.v[:, order]), home)
    np.testing.assert_array_equal(again.q, plan.q)
    assert check_trajectory(right, Motion(plan.names, plan.t, plan.q), home).names == right.names


def test_joints_numbers_and_limits_are_refused_by_name(right: Arm, home: dict[str, float], plan: Trajectory) -> None:
    invalid, limits = Code.INVALID_ARGUMENT, Code.LIMITS
    names = ("elbow", *plan.names[1:])
    message = fault(right, home, plan, invalid, names=names)
    assert "unknown elbow, missing openarm_right_joint1; expected openarm_right_joint1" in message
    assert "no points" in fault(right, home, plan, invalid, t=plan.t[:0], q=plan.q[:0], v=None)
    q = plan.q.copy()
    q[4, 2] = np.nan
    assert "position of openarm_right_joint3 at point 4 is nan" in fault(right, home, plan, invalid, q=q)
    v = plan.v.copy()
    v[5, 6] = np.inf
    assert "velocity of openarm_right_joint7 at point 5 is inf" in fault(right, home, plan, invalid, v=v)
    t = plan.t.copy()
    t[3] = t[2]
    assert "time of point 3" in fault(right, home, plan, invalid, t=t)
    q = plan.q.copy()
    q[7, 3] = 2.6
    assert "openarm_right_joint4 at point 7 is 2.6000 rad, limits 0.0000 to 2.44" in fault(
        right, home, plan, limits, q=q
    )
    v = plan.v.copy()
    v[5, 0] = 2.5
    assert "openarm_right_joint1 at point 5 moves at 2.50 rad/s, limit 2.00" in fault(right, home, plan, limits, v=v)
    assert "limit" in fault(right, home, plan, limits, t=plan.t * 0.05, v=None)
    moved = {**home, plan.names[1]: home[plan.names[1]] + 0.2}
    message = fault(right, moved, plan, invalid)
    assert "starts with openarm_right_joint2 at 2.200 rad, the arm is at 2.400" in message


@pytest.mark.requirement("A-68")
def test_a_motion_into_the_other_arm_is_refused(arms: dict[str, Arm], home: dict[str, float]) -> None:
    left, right = arms["left"], arms["right"]
    pose = se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.26, 0.0, 0.60))
    plans = {a.name: moves.to_pose(a, a.start_state(home), pose, RequestBoxes()) for a in (left, right)}
    motions = {n: Motion(p.names, p.t, p.q) for n, p in plans.items()}
    check_against_others(right, motions["right"], home)
    # the left arm stands at the place
    there = {**home, **dict(zip(left.names, motions["left"].q[-1].tolist(), strict=True))}
    with refuses(Code.IN_COLLISION, r"right arm after .*openarm_left_"):
        check_against_others(right, motions["right"], there)


@pytest.mark.requirement("A-68")
def test_motions_that_begin_together_are_checked_at_the_same_moments(
    arms: dict[str, Arm], home: dict[str, float]
) -> None:
    left, right = arms["left"], arms["right"]
    pose = se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.26, 0.0, 0.60))
    plan = moves.to_pose(right, right.start_state(home), pose, RequestBoxes())
    there = Motion(plan.names, plan.t, plan.q)
    other = moves.to_pose(left, left.start_state(home), pose, RequestBoxes())
    away = Motion(other.names, other.t, other.q[::-1])
    inside = {**home, **dict(zip(left.names, away.q[0].tolist(), strict=True))}

    with refuses(Code.IN_COLLISION, r"wait until the other arm"):
        check_against_others(right, there.later(away.duration), inside)
    check_against_others(right, there.later(away.duration), inside, [(left, away)])
    with refuses(Code.IN_COLLISION, r"right arm after .*openarm_left_.*; plan the arms together"):
        check_against_others(right, there, home, [(left, Motion(other.names, other.t, other.q))])


def test_what_is_held_follows_the_plan(plan: Trajectory) -> None:
    memory = HeldObjects()
    box = Box("cube", np.eye(4), np.array([0.05, 0.05, 0.05]))
    memory.expect("right", plan, [box])
    motion = Motion(plan.names, plan.t, plan.q)
    expected = memory.expected("right", motion)
    assert expected is not None
    assert expected.held == (box,)
    assert memory.expected("left", motion) is None
    assert memory.expected("right", Motion(plan.names, plan.t, plan.q[::-1])) is None
    assert memory.hold("right", [box])
    assert not memory.hold("right", [Box("cube", np.eye(4), np.array([0.05, 0.05, 0.05]))])
    assert dict(memory.held) == {"right": (memory.held["right"][0],)}
    assert memory.hold("right", ())
    assert dict(memory.held) == {}
