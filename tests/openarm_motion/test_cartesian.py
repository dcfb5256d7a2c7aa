# SPDX-License-Identifier: Apache-2.0
"""Straight lines of the tool."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_motion.collision.solids import box_from
from openarm_motion.kinematics.chain import ArmKinematics, IkSolution
from openarm_motion.kinematics.inverse import InverseKinematics
from openarm_motion.kinematics.line import line_contact, line_poses, solve_line
from openarm_motion.planning.arm import Arm
from tests.refusals import refused


def down(x: float, y: float, z: float) -> np.ndarray:
    return se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (x, y, z))


def at_home(arm: Arm, home: dict[str, float]) -> tuple[IkSolution, np.ndarray]:
    """Where a line begins: the solution and its pose."""
    start = arm.inverse.classify([home[name] for name in arm.names])
    return start, arm.kinematics.fk(start.q)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.requirement("B-47")
def test_a_line_is_straight_to_a_tenth_of_a_millimetre_and_keeps_its_branch(arms: dict[str, Arm], side: str) -> None:
    arm = arms[side]
    sign = 1.0 if side == "left" else -1.0
    T_a, T_b = down(0.25, sign * 0.25, 0.43), down(0.25, sign * 0.25, 0.55)
    followed = 0
    for solution in arm.inverse.solutions(T_a, 0.06):
        try:
            line = solve_line(arm.inverse, solution, T_a, T_b, 0.05)
        except OpenArmError:
            continue  # some branches end at a joint limit
        followed += 1
        # also between its points, where a follower interpolates
        between = np.concatenate([line.q, 0.5 * (line.q[1:] + line.q[:-1])])
        poses = arm.kinematics.fk_many(between)
        np.testing.assert_allclose(poses[:, :2, 3], np.tile(T_a[:2, 3], (len(poses), 1)), atol=1e-4)
        assert max(se3.angle_between(p[:3, :3], T_a[:3, :3]) for p in poses) < 2e-3
        assert np.max(np.abs(np.diff(line.q, axis=0))) < 0.2
        assert arm.inverse.classify(line.q[-1]).branch == solution.branch
        np.testing.assert_allclose(arm.kinematics.fk(line.q[-1]), T_b, atol=1e-9)
        np.testing.assert_allclose(line.s, np.linspace(0, 0.12, len(line.s)), atol=1e-12)
    assert followed >= 3


def test_a_turn_on_the_spot_is_a_line_too(right: Arm, home: dict[str, float]) -> None:
    start, T = at_home(right, home)
    line = solve_line(right.inverse, start, T, T @ se3.make(se3.rot_z(0.3)), 0.0)
    poses = right.kinematics.fk_many(line.q)
    np.testing.assert_allclose(poses[:, :3, 3], np.tile(T[:3, 3], (len(poses), 1)), atol=1e-9)
    assert line.s[-1] == pytest.approx(0.2 * 0.3)


def test_reversed_line_goes_back(right: Arm, home: dict[str, float]) -> None:
    start, T = at_home(right, home)
    line = solve_line(right.inverse, start, T, se3.make(p=(0.0, 0.0, -0.1)) @ T, 0.0)
    back = line.reversed()
    np.testing.assert_array_equal(back.q[0], line.q[-1])
    np.testing.assert_allclose(back.q[-1], start.q, atol=1e-9)
    assert back.s[0] == 0.0
    assert np.all(np.diff(back.s) > 0.0)


def test_a_line_out_of_reach_says_where_it_ends_and_why(right: Arm, home: dict[str, float]) -> None:
    start, T = at_home(right, home)
    goal = se3.make(p=(0.5, 0.0, 0.0)) @ T
    said = r"line of 500 mm ends after \d+ mm: .*(m from the shoulder|would be at)"
    assert refused(said, solve_line, right.inverse, start, T, goal, 0.05).code is Code.UNREACHABLE


def test_a_collision_on_a_line_is_found_in_its_middle(right: Arm, home: dict[str, float]) -> None:
    start, T = at_home(right, home)
    line = solve_line(right.inverse, start, T, se3.make(p=(0.0, 0.0, -0.15)) @ T, 0.0)
    assert line_contact(right.scene(home), line) is None
    middle = T[:3, 3] + [0.0, 0.0, -0.075]
    post = box_from("post", middle, (0.02, 0.02, 0.02))
    assert not right.scene(home, [post]).collides(line.q[0])
    assert not right.scene(home, [post]).collides(line.q[-1])
    contact = line_contact(right.scene(home, [post]), line)
    assert contact is not None
    assert contact.second == "post"


def test_poses_of_a_line_are_dense_enough() -> None:
    T_a, T_b = np.eye(4), se3.make(se3.rot_x(0.5), (0.0, 0.0, 0.2))
    poses, s = line_poses(T_a, T_b)
    assert np.max(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)) <= 0.005 + 1e-12
    turns = [se3.angle_between(a[:3, :3], b[:3, :3]) for a, b in itertools.pairwise(poses)]
    assert max(turns) <= 0.025 + 1e-9
    assert s[-1] == pytest.approx(0.2 + 0.2 * 0.5)
    assert len(line_poses(T_a, T_a)[0]) >= 6


@pytest.mark.requirement("B-07")
def test_a_line_of_an_arm_of_another_build(six: RobotDescription) -> None:
    inverse = InverseKinematics(ArmKinematics(six, "tool"))
    start = inverse.classify(np.array([0.2, 0.5, 1.2, 0.1, 0.6, 0.3]))
    T = inverse.kinematics.fk(start.q)
    goal = se3.make(p=(0.0, 0.05, -0.1)) @ T
    line = solve_line(inverse, start, T, goal, 0.0)
    between = inverse.kinematics.fk_many(0.5 * (line.q[1:] + line.q[:-1]))[:, :3, 3]
    direct = line_poses(T, goal)[0][:, :3, 3]
    assert np.max(np.linalg.norm(between - 0.5 * (direct[1:] + direct[:-1]), axis=1)) < 1e-4
    np.testing.assert_allclose(inverse.kinematics.fk(line.q[-1]), goal, atol=2e-4)
