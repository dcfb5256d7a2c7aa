# SPDX-License-Identifier: Apache-2.0
"""Closed-form inverse kinematics."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_motion.kinematics.chain import ArmKinematics
from openarm_motion.kinematics.inverse import InverseKinematics
from openarm_motion.kinematics.srs import SrsArm
from tests.refusals import refused

mirror = RobotDescription.load().mirrored

SWIVELS = np.linspace(-np.pi, np.pi, 24, endpoint=False)


@pytest.fixture(scope="module")
def solvers(description: RobotDescription) -> dict[str, SrsArm]:
    robots = {"": description, "v2 ": RobotDescription.load("openarm_v2")}
    sides = [(name + side, robot, side) for name, robot in robots.items() for side in ("left", "right")]
    return {key: SrsArm(ArmKinematics(robot, robot.tcp_link(side))) for key, robot, side in sides}


@pytest.mark.requirement("B-07")
@pytest.mark.parametrize("side", ["left", "right", "v2 left", "v2 right"])
def test_a_configuration_is_found_again_from_its_pose_swivel_and_branch(solvers: dict[str, SrsArm], side: str) -> None:
    solver = solvers[side]
    arm = solver.kinematics
    rng = np.random.default_rng(2)
    for q in rng.uniform(arm.lower, arm.upper, (300, 7)):
        found = solver.classify(q)
        again = solver.solve(arm.fk(q), found.swivel, found.branch)
        assert again is not None
        np.testing.assert_allclose(again, q, atol=1e-6 if "v2" in side else 1e-7)


def test_branches_are_all_configurations_at_a_swivel_angle(solvers: dict[str, SrsArm]) -> None:
    # an independent count: numeric solutions at the same swivel angle are among the closed-form ones
    solver = solvers["right"]
    arm = solver.kinematics
    rng = np.random.default_rng(8)
    for q in rng.uniform(arm.lower + 0.1, arm.upper - 0.1, (10, 7)):
        pose = arm.fk(q)
        for seed in rng.uniform(arm.lower, arm.upper, (10, 7)):
            result = arm.ik(pose, seed, restarts=0, tolerance=(1e-9, 1e-9))
            if not result.success:
                continue
            swivel = solver.classify(result.q).swivel
            solutions = solver.sweep(pose, np.array([swivel]), margin=-1e-6)
            assert min(np.max(np.abs(s.q - result.q)) for s in solutions) < 1e-5


def test_left_arm_mirrors_the_right_one(solvers: dict[str, SrsArm]) -> None:
    right, left = solvers["right"], solvers["left"]
    flip = np.diag([1.0, -1.0, 1.0])
    rng = np.random.default_rng(9)
    for q in rng.uniform(right.kinematics.lower, right.kinematics.upper, (50, 7)):
        pose = right.kinematics.fk(q)
        # a reflection on both sides of a rotation is a rotation; the hand is mirrored in its own y
        mirrored = se3.make(flip @ pose[:3, :3] @ flip, flip @ pose[:3, 3])
        ours = {tuple(np.round(mirror(s.q), 6) + 0.0) for s in right.sweep(pose, SWIVELS)}
        theirs = {tuple(np.round(s.q, 6) + 0.0) for s in left.sweep(mirrored, -SWIVELS)}
        assert ours == theirs


def test_swivel_is_zero_where_the_elbow_is_lowest(solvers: dict[str, SrsArm]) -> None:
    solver = solvers["right"]
    arm = solver.kinematics
    pose = arm.fk([0.3, 0.4, 0.2, 1.4, 0.0, 0.0, 0.0])

    def elbow_z(swivel: float) -> float:
        q = solver.solve(pose, swivel, 0)
        assert q is not None
        return float(arm.joint_axes(q)[0][3][2])

    assert elbow_z(0.0) < min(elbow_z(s) for s in (-0.5, 0.5, 1.5, 3.0))


def test_lengths_are_those_of_the_table(solvers: dict[str, SrsArm]) -> None:
    solver = solvers["right"]
    np.testing.assert_allclose(solver.shoulder, [0.0, -0.1535, 0.698], atol=1e-9)
    far = se3.make(np.diag([1.0, -1.0, -1.0]), (0.0, -0.1535, 0.698 - 0.1801 - 0.5))
    assert solver.sweep(far, SWIVELS) == []
    miss = solver.miss(far, SWIVELS)
    assert miss.too_far == pytest.approx(0.5 - 0.436, abs=1e-9)
    assert "arm reaches 0.436 m (64 mm short)" in solver.distance_text(miss.too_far)


def test_the_joint_that_binds_is_named(description: RobotDescription) -> None:
    inverse = InverseKinematics(ArmKinematics(description, description.tcp_link("right")))
    # a hand that points back at the robot would have to fold past joint 6 and 7
    pose = se3.make(se3.rotation_from_z_y((-1, 0, 0), (0, 1, 0)), (0.10, -0.20, 0.60))
    assert not inverse.solutions(pose, 0.05)
    assert "would be at" in inverse.why_not(pose, 0.05)
    assert "nearest reachable pose" in inverse.why_not(pose, 0.05)


@pytest.mark.requirement("B-07")
def test_an_arm_of_another_build_falls_back_to_the_numeric_solver(six: RobotDescription) -> None:
    arm = ArmKinematics(six, "tool")
    refused(r"not a spherical-revolute-spherical arm: it has 6 joints", SrsArm, arm)
    inverse = InverseKinematics(arm)
    assert inverse.method.startswith("numeric")
    rng = np.random.default_rng(10)
    for q in rng.uniform(arm.lower + 0.2, arm.upper - 0.2, (20, 6)):
        solutions = inverse.solutions(arm.fk(q), near=q)
        assert any(np.max(np.abs(s.q - q)) < 1e-2 for s in solutions)
        for solution in solutions:
            np.testing.assert_allclose(arm.fk(solution.q), arm.fk(q), atol=1e-3)
    assert "nearest reachable pose" in inverse.why_not(se3.make(None, (2.0, 0.0, 0.5)))


def test_wrong_geometry_is_refused(description: RobotDescription) -> None:
    text = description.urdf.replace('xyz="0.0375 0 0.1205"', 'xyz="0.0375 0.01 0.1205"')
    assert text != description.urdf
    bent = RobotDescription.from_urdf(text)
    refused("miss a common point", SrsArm, ArmKinematics(bent, description.tcp_link("right")))
