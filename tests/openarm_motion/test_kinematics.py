# SPDX-License-Identifier: Apache-2.0
"""Forward, differential and numeric inverse kinematics."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_motion.kinematics.chain import ArmKinematics
from tests.refusals import refused

SIDES = ("left", "right")


@pytest.fixture(params=SIDES)
def arm(request: pytest.FixtureRequest, description: RobotDescription) -> ArmKinematics:
    return ArmKinematics(description, description.tcp_link(request.param))


def test_forward_kinematics_equal_the_description(arm: ArmKinematics, description: RobotDescription) -> None:
    rng = np.random.default_rng(3)
    for q in rng.uniform(arm.lower, arm.upper, (50, 7)):
        expected = description.link_pose(arm.tool_link, dict(zip(arm.names, q, strict=True)))
        np.testing.assert_allclose(arm.fk(q), expected, atol=1e-12)
    many = rng.uniform(arm.lower, arm.upper, (5, 7))
    np.testing.assert_allclose(arm.fk_many(many), [arm.fk(q) for q in many], atol=1e-15)


def test_jacobian_equals_finite_differences(arm: ArmKinematics) -> None:
    rng = np.random.default_rng(4)
    for q in rng.uniform(arm.lower, arm.upper, (20, 7)):
        h = 1e-6
        columns = []
        for e in np.eye(7):
            T_a, T_b = arm.fk(q - h * e), arm.fk(q + h * e)
            turn = se3.log_so3(T_b[:3, :3] @ T_a[:3, :3].T)
            columns.append(np.concatenate([T_b[:3, 3] - T_a[:3, 3], turn]) / (2.0 * h))
        np.testing.assert_allclose(arm.jacobian(q), np.array(columns).T, atol=1e-7)


@pytest.mark.requirement("A-66")
def test_reachable_poses_are_solved_to_a_tenth_of_a_millimetre(arm: ArmKinematics) -> None:
    rng = np.random.default_rng(66)
    solved = 0
    for q in rng.uniform(arm.lower, arm.upper, (300, 7)):
        target = arm.fk(q)
        result = arm.ik(target)
        if not result.success:
            continue
        reached = arm.fk(result.q)
        assert np.linalg.norm(reached[:3, 3] - target[:3, 3]) < 1e-4
        assert se3.angle_between(reached[:3, :3], target[:3, :3]) < np.radians(0.1)
        assert arm.margin(result.q) > -1e-9
        solved += 1
    assert solved >= 299


def test_position_alone_is_solved_without_regard_to_orientation(arm: ArmKinematics) -> None:
    rng = np.random.default_rng(5)
    for q in rng.uniform(arm.lower, arm.upper, (200, 7)):
        target = se3.make(se3.rot_x(1.0), arm.fk(q)[:3, 3])
        result = arm.ik(target, position_only=True)
        assert result.success
        np.testing.assert_allclose(arm.fk(result.q)[:3, 3], target[:3, 3], atol=1e-4)


def test_seed_decides_which_solution(arm: ArmKinematics) -> None:
    rng = np.random.default_rng(6)
    for q in rng.uniform(arm.lower + 0.3, arm.upper - 0.3, (50, 7)):
        result = arm.ik(arm.fk(q), q + rng.uniform(-0.05, 0.05, 7))
        assert result.success
        assert np.max(np.abs(result.q - q)) < 0.3


def test_margin_is_kept_from_every_limit(arm: ArmKinematics) -> None:
    rng = np.random.default_rng(7)
    for q in rng.uniform(arm.lower + 0.2, arm.upper - 0.2, (50, 7)):
        result = arm.ik(arm.fk(q), margin=0.1)
        assert result.success
        assert arm.margin(result.q) > 0.1 - 1e-9


def test_unreachable_pose_is_answered_with_the_nearest(arm: ArmKinematics) -> None:
    shoulder = np.array([0.0, 0.1535 if "left" in arm.tool_link else -0.1535, 0.698])
    target = se3.make(None, shoulder + np.array([1.0, 0.0, 0.0]))
    result = arm.ik(target, position_only=True)
    assert not result.success
    # straight out the tool reaches 0.6161 m from the shoulder
    assert result.position_error == pytest.approx(1.0 - 0.6161, abs=2e-3)
    np.testing.assert_allclose(
        np.linalg.norm(arm.fk(result.q)[:3, 3] - target[:3, 3]), result.position_error, atol=1e-9
    )


def test_same_seed_same_answer(arm: ArmKinematics) -> None:
    target = arm.fk(np.clip([0.5, 0.5, 0.2, 1.0, 0.3, 0.2, -0.2], arm.lower, arm.upper))
    np.testing.assert_array_equal(arm.ik(target, restarts=5).q, arm.ik(target, restarts=5).q)


def test_prismatic_and_continuous_joints_are_part_of_a_chain() -> None:
    text = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/><link name="d"/>
    <joint name="turn" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint>
    <joint name="slide" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="1 0 0"/>
    <limit lower="0.1" upper="0.9" effort="1" velocity="1"/></joint>
    <joint name="lift" type="prismatic"><parent link="c"/><child link="d"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
    arm = ArmKinematics(RobotDescription.from_urdf(text), "d")
    np.testing.assert_allclose(arm.fk([np.pi / 2, 0.5, 0.2])[:3, 3], [0.0, 0.5, 0.2], atol=1e-12)
    result = arm.ik(se3.make(None, (0.3, 0.4, -0.5)), position_only=True)
    assert result.success
    np.testing.assert_allclose(result.q, [np.arctan2(0.4, 0.3), 0.5, -0.5], atol=1e-4)


def test_wrong_input_is_refused_by_name(arm: ArmKinematics, description: RobotDescription) -> None:
    refused("tool link 'nowhere' is not in the URDF", ArmKinematics, description, "nowhere")
    refused("got 3 joint positions, expected 7", arm.fk, [0.0, 0.0, 0.0])
    assert "joint6 would be at 1.000 rad, allowed -0.735 to 0.735" in arm.outside([0, 0, 0, 1, 0, 1, 0], 0.05)
    assert arm.outside([0, 0, 0, 1, 0, 0, 0]) == ""
