# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics of poses near joint limits, on them, and of singular ones: what exists is found and is correct."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.robot_models import load_arm
from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from openarm_motion.config import MotionConfig, MotionLimits
from openarm_motion.kinematics.chain import ArmKinematics, IkResult
from openarm_motion.kinematics.inverse import InverseKinematics
from openarm_motion.kinematics.srs import SrsArm
from openarm_motion.planning import moves
from openarm_motion.planning.approach import ApproachRequest, Target, plan_approach
from openarm_motion.planning.arm import Arm

#: Tolerance of a solution: position (m), rotation (rad).
POSITION, ROTATION = 1e-5, 1e-4
ROBOTS = ("left", "right", "six", "seven", "straight", "panda", "ur5e")
CLOSED = ("right", "straight")
#: Where a joint is: somewhere, within 1e-3 rad of a limit, on a limit.
_PLACES = st.tuples(st.sampled_from(["inside", "near", "on"]), st.booleans(), st.floats(0.0, 1.0))
places = st.lists(_PLACES, min_size=7, max_size=7)


@pytest.fixture(scope="module")
def solvers(
    description: RobotDescription, six: RobotDescription, seven: RobotDescription, straight: RobotDescription
) -> dict[str, InverseKinematics]:
    tools = {side: (description, description.tcp_link(side)) for side in ("left", "right")}
    tools |= {"six": (six, "tool"), "seven": (seven, "tool"), "straight": (straight, "tool")}
    chains = {name: ArmKinematics(*of) for name, of in tools.items()}
    return {name: InverseKinematics(chains.get(name) or load_arm(name).kinematics) for name in ROBOTS}


def configuration(arm: ArmKinematics, drawn: list[tuple[str, bool, float]]) -> Array:
    q = np.empty(arm.n)
    for i in range(arm.n):
        where, high, u = drawn[i]
        depth = u * (arm.upper[i] - arm.lower[i]) if where == "inside" else 1e-3 * u if where == "near" else 0.0
        q[i] = arm.upper[i] - depth if high else arm.lower[i] + depth
    return q


def assert_reached(arm: ArmKinematics, q: Array, pose: Array, *, position_only: bool = False) -> None:
    reached = arm.fk(q)
    assert np.linalg.norm(reached[:3, 3] - pose[:3, 3]) <= POSITION * 1.001
    assert position_only or se3.angle_between(reached[:3, :3], pose[:3, :3]) <= ROTATION * 1.001
    assert arm.margin(q) >= 0.0


@pytest.mark.requirement("A-66", "B-07", "B-13", "R-31")
@pytest.mark.parametrize("name", ROBOTS)
@settings(max_examples=30)
@given(drawn=places)
def test_a_configuration_within_the_limits_is_found(
    solvers: dict[str, InverseKinematics], name: str, drawn: list[tuple[str, bool, float]]
) -> None:
    inverse = solvers[name]
    arm = inverse.kinematics
    pose = arm.fk(configuration(arm, drawn))
    found = inverse.solutions(pose)
    assert found
    for solution in found:
        assert_reached(arm, solution.q, pose)
    one = inverse.nearest(pose)
    assert one.success
    assert_reached(arm, one.q, pose)


@pytest.mark.parametrize("name", ["right", "seven", "ur5e"])
@settings(max_examples=15)
@given(drawn=places)
def test_a_position_within_the_limits_is_found(
    solvers: dict[str, InverseKinematics], name: str, drawn: list[tuple[str, bool, float]]
) -> None:
    inverse = solvers[name]
    arm = inverse.kinematics
    pose = arm.fk(configuration(arm, drawn))
    found = inverse.position_solutions(pose)
    assert found
    for solution in found:
        assert_reached(arm, solution.q, pose, position_only=True)


@pytest.mark.parametrize("margin", [0.0, 0.05])
@pytest.mark.parametrize("name", CLOSED)
@settings(max_examples=30)
@given(drawn=places)
def test_no_interval_of_the_elbow_is_too_narrow_for_the_closed_form(
    solvers: dict[str, InverseKinematics], name: str, margin: float, drawn: list[tuple[str, bool, float]]
) -> None:
    arm = solvers[name].kinematics
    # a hair within the limits less the margin, and swivel angles a quarter of a turn apart
    kept = margin + 1e-6
    q = np.clip(configuration(arm, drawn), arm.lower + kept, arm.upper - kept)
    pose = arm.fk(q)
    if abs(q[3]) < 1e-3:
        return  # a straight elbow magnifies rounding to 1e-8 rad: left to the numeric solver
    found = SrsArm(arm).sweep(pose, np.linspace(-np.pi, np.pi, 4, endpoint=False), margin)
    assert found
    for solution in found:
        np.testing.assert_allclose(arm.fk(solution.q), pose, atol=1e-8)
        assert arm.margin(solution.q) >= margin - 1e-12


@pytest.mark.parametrize("name", CLOSED)
def test_every_interval_that_a_fine_grid_shows_has_a_solution(solvers: dict[str, InverseKinematics], name: str) -> None:
    solver = SrsArm(solvers[name].kinematics)
    arm = solver.kinematics
    grid, coarse = (np.linspace(-np.pi, np.pi, k, endpoint=False) for k in (360, 4))
    step, intervals = grid[1] - grid[0], 0
    for q in np.random.default_rng(31).uniform(arm.lower, arm.upper, (15, 7)):
        pose = arm.fk(q)
        ours = solver.sweep(pose, coarse)
        for branch in range(8):
            there = [solver.solve(pose, float(s), branch) for s in grid]
            inside = np.array([q is not None and arm.margin(q) >= 0.0 for q in there])
            at = np.array([s.swivel for s in ours if s.branch == branch])
            for first in np.flatnonzero(inside & ~np.roll(inside, 1)):
                length = int(np.argmin(np.roll(inside, -first)))
                along = (at - grid[first] + step) % (2.0 * np.pi)
                assert np.any(along <= (length + 1) * step)
                intervals += 1
    assert intervals > 20


@pytest.mark.parametrize("name", ROBOTS)
def test_what_the_numeric_solver_returns_meets_the_tolerance(solvers: dict[str, InverseKinematics], name: str) -> None:
    """With a wide tolerance of one error, a smaller sum of both may come first and miss the other."""
    arm = solvers[name].kinematics
    for q in np.random.default_rng(32).uniform(arm.lower, arm.upper, (120, arm.n)):
        pose = arm.fk(q)
        for tolerance in ((1e-4, 3e-2), (1e-2, 1e-4)):
            result = arm.ik(pose, tolerance=tolerance)
            if result.success:
                reached = arm.fk(result.q)
                assert np.linalg.norm(reached[:3, 3] - pose[:3, 3]) <= tolerance[0]
                assert se3.angle_between(reached[:3, :3], pose[:3, :3]) <= tolerance[1]


@settings(max_examples=100)
@given(st.floats(0.0, 2.0), st.floats(0.0, np.pi), st.booleans())
def test_what_is_away_never_reads_as_nothing(position: float, rotation: float, free: bool) -> None:
    if position < POSITION and (free or rotation < ROTATION):
        return
    text = IkResult(False, np.zeros(1), position, rotation).away(position_only=free)
    assert not re.search(r"(?<![\d.])0(\.0+)? ?(mm|°)", text), text


@pytest.fixture(scope="module")
def planned(arms: dict[str, Arm], six: RobotDescription) -> dict[str, Arm]:
    limits = MotionLimits(velocity=(1.0,) * 6, acceleration=(3.0,) * 6, jerk=(30.0,) * 6)
    config = MotionConfig(arms=("six",), tool_link="tool", group="{arm}", limits=limits, scene="")
    return {**arms, "six": Arm("six", six, config)}


@pytest.mark.parametrize("name", ["left", "right", "six"])
@settings(max_examples=15)
@given(drawn=places)
def test_a_pose_is_not_refused_for_the_margin(
    planned: dict[str, Arm], name: str, drawn: list[tuple[str, bool, float]]
) -> None:
    arm = planned[name]
    pose = arm.kinematics.fk(configuration(arm.kinematics, drawn))
    now = arm.start_state(dict.fromkeys(arm.names, 0.1))
    goals = moves.goal_configurations(arm, now, now.start, pose)
    margin = arm.config.planning.joint_margin
    kept = [arm.kinematics.margin(q) >= margin - 1e-9 for q in goals]
    assert all(kept) or not any(kept)
    for q in goals:
        assert_reached(arm.kinematics, q, pose)


def _at_the_limit(arm: Arm, home: dict[str, float]) -> Array:
    """A pose that is reached near to a joint limit alone: the wrist bent and turned as far as it goes."""
    q = np.array([home[name] for name in arm.names])
    q[5] = arm.upper[5] - 0.005
    q[6] = arm.upper[6] - 0.005
    pose = arm.kinematics.fk(q)
    assert not arm.inverse.solutions(pose, arm.config.planning.joint_margin)
    return pose


def test_a_goal_that_only_the_margin_rules_out_is_planned(right: Arm, home: dict[str, float]) -> None:
    pose = _at_the_limit(right, home)
    trajectory = moves.to_pose(right, right.start_state(home), pose, moves.RequestBoxes())
    assert_reached(right.kinematics, trajectory.q[-1], pose)
    assert right.kinematics.margin(trajectory.q) >= -1e-9


def test_an_approach_that_only_the_margin_rules_out_says_so(right: Arm, home: dict[str, float]) -> None:
    pose = _at_the_limit(right, home)
    target = Target("t", pose, np.array([0.0, 0.0, 0.02]), np.array([0.0, 0.0, 0.02]))
    with pytest.raises(OpenArmError) as caught:
        plan_approach(right, right.start_state(home), ApproachRequest((target,)))
    assert caught.value.code == Code.UNREACHABLE
    said = re.search(r"(\w+) would be at (-?[\d.]+) rad, ([\d.]+) rad from its limit", caught.value.message)
    assert said is not None, caught.value.message
    assert said[1] in right.names
    assert float(said[3]) < 0.05
    assert "only nearer to a joint limit than the margin of 0.05 rad" in caught.value.message
