# SPDX-License-Identifier: Apache-2.0
"""Single motions: to joints, poses, postures, along lines."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_grasp.config import LEAST_SCALE
from openarm_motion.collision.solids import Box
from openarm_motion.config import MotionConfig, MotionLimits
from openarm_motion.planning import moves
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.moves import RequestBoxes
from openarm_motion.timing.trajectory import Trajectory

NOTHING = RequestBoxes()
T_base_table = se3.make(None, (0.0, 0.0, 0.40))


def refused(code: Code, call, *args, **kwargs) -> str:
    """Message of the error that a call must end with."""
    with pytest.raises(OpenArmError) as caught:
        call(*args, **kwargs)
    assert caught.value.code == code, caught.value
    return caught.value.message


def assert_free(arm: Arm, state: dict[str, float], trajectory: Trajectory) -> None:
    scene = arm.scene(state)
    for q in trajectory.at(np.linspace(0.0, trajectory.duration, 200))[0]:
        assert not scene.collides(q), scene.contacts(q)[0]


@pytest.mark.requirement("A-66")
def test_the_sample_target_is_solved_with_free_orientation_and_refused_with_a_vertical_tool(
    arms: dict[str, Arm], home: dict[str, float]
) -> None:
    arm = arms["left"]
    now = arm.start_state(home)
    pose = T_base_table @ se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.4, 0.2, 0.3))
    trajectory = moves.to_pose(arm, now, pose, NOTHING, position_only=True)
    np.testing.assert_allclose(arm.kinematics.fk(trajectory.q[-1])[:3, 3], pose[:3, 3], atol=1e-4)
    assert_free(arm, home, trajectory)
    message = refused(Code.UNREACHABLE, moves.to_pose, arm, now, pose, NOTHING)
    assert "left arm can't reach (0.400, 0.200, 0.700) m" in message
    assert "6 mm short" in message
    assert "nearest reachable pose is" in message


@pytest.mark.parametrize("side", ["left", "right"])
def test_from_hanging_zero_to_home_by_name(arms: dict[str, Arm], home: dict[str, float], side: str) -> None:
    arm = arms[side]
    state = dict.fromkeys(home, 0.0)
    trajectory = moves.to_named(arm, arm.start_state(state), "home", NOTHING)
    np.testing.assert_allclose(trajectory.q[-1], [home[name] for name in arm.names], atol=1e-9)
    assert trajectory.names == arm.names
    assert_free(arm, state, trajectory)
    assert "states:" in refused(Code.INVALID_ARGUMENT, moves.to_named, arm, arm.start_state(state), "yoga", NOTHING)


def test_to_a_pose_in_the_nearest_configuration(right: Arm, home: dict[str, float]) -> None:
    pose = se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.28, -0.22, 0.55))
    now = right.start_state(home, scale=1.0)
    trajectory = moves.to_pose(right, now, pose, NOTHING)
    np.testing.assert_allclose(right.kinematics.fk(trajectory.q[-1]), pose, atol=1e-9)
    assert_free(right, home, trajectory)
    # elbow over, as home is: the largest joint travel is 0.87 rad in the median of the region
    assert np.max(np.abs(trajectory.q[-1] - now.start)) < 1.3


@pytest.mark.requirement("B-47")
def test_a_line_may_pass_by_an_object_nearer_than_a_free_path(right: Arm, home: dict[str, float]) -> None:
    now = right.start_state(right.with_gripper(home, 0.044))
    T = right.kinematics.fk(now.start)
    # a post between the open fingers, 6 mm from the left one
    post = Box("post", T @ se3.make(None, (0.0, 0.033, 0.02)), np.array([0.01, 0.01, 0.06]))
    back = T @ se3.make(None, (0.0, 0.0, -0.05))
    assert moves.to_pose_on_line(right, now, back, RequestBoxes([post])).duration > 0.0


def test_goals_that_collide_or_break_limits_are_refused_by_name(right: Arm, home: dict[str, float]) -> None:
    now = right.start_state(home)
    low = next(s.q for s in right.inverse.solutions(se3.make(np.diag([1.0, -1.0, -1.0]), (0.25, -0.25, 0.39)), 0.0))
    message = refused(Code.IN_COLLISION, moves.to_joints, right, now, low.tolist(), NOTHING)
    assert message.startswith("goal of the right arm: openarm_right_")
    assert "table" in message
    message = refused(Code.LIMITS, moves.to_joints, right, now, [0, 0, 0, 3.0, 0, 0, 0], NOTHING)
    assert "openarm_right_joint4 would be at 3.000 rad, allowed 0.000 to 2.443" in message
    message = refused(Code.INVALID_ARGUMENT, moves.to_joints, right, now, [0, 0, float("nan"), 0, 0, 0, 0], NOTHING)
    assert "openarm_right_joint3 is nan" in message
    message = refused(Code.INVALID_ARGUMENT, moves.to_joints, right, now, [0.0], NOTHING)
    assert "goal has 1 joint positions, expected 7" in message
    pose = se3.make(np.diag([1.0, -1.0, -1.0]), (0.25, -0.25, 0.38))
    message = refused(Code.IN_COLLISION, moves.to_pose, right, now, pose, NOTHING)
    assert "table" in message
    assert "configurations collide" in message


def test_start_states_are_checked(right: Arm, home: dict[str, float]) -> None:
    message = refused(Code.NOT_READY, right.start_state, {})
    assert "lacks openarm_right_joint1" in message
    assert right.start_state({}, [0.0] * 7).start.tolist() == [0.0] * 7
    message = refused(Code.INVALID_ARGUMENT, right.start_state, home, (), 2.0)
    assert "velocity_scale is 2.0" in message
    refused(Code.LIMITS, right.start_state, home, [0, 0, 0, -0.2, 0, 0, 0])
    # a joint that sags a little below its limit is a reading, not a fault
    assert right.start_state(home, [0, 0, 0, -0.01, 0, 0, 0]).start[3] == 0.0


def test_the_slowest_motion_of_a_grasp_is_one_that_is_planned(right: Arm) -> None:
    assert right.scale(LEAST_SCALE) == LEAST_SCALE
    assert "expected 0.001 to 1" in refused(Code.INVALID_ARGUMENT, right.scale, 0.99 * LEAST_SCALE)


def test_velocity_scale_stretches_time(right: Arm, home: dict[str, float]) -> None:
    goal = [home[name] + 0.2 for name in right.names]
    fast, slow = (moves.to_joints(right, right.start_state(home, scale=s), goal, NOTHING).duration for s in (1.0, 0.25))
    assert slow > 1.5 * fast


@pytest.mark.requirement("B-13")
def test_another_arm_is_a_matter_of_configuration(six: RobotDescription) -> None:
    limits = MotionLimits(velocity=(1.0,) * 6, acceleration=(3.0,) * 6, jerk=(30.0,) * 6)
    config = MotionConfig(arms=("main",), tool_link="tool", group="{arm}", limits=limits, scene="")
    arm = Arm("main", six, config)
    now = arm.start_state(dict.fromkeys(arm.names, 0.1))
    pose = arm.kinematics.fk(np.array([0.5, 0.6, 1.0, 0.2, 0.5, 0.1]))
    trajectory = moves.to_pose(arm, now, pose, NOTHING)
    np.testing.assert_allclose(arm.kinematics.fk(trajectory.q[-1]), pose, atol=1e-3)
    with pytest.raises(OpenArmError, match=r"limits.velocity has 0 numbers, arm 'main' has 6 joints: waist"):
        Arm("main", six, MotionConfig(arms=("main",), tool_link="tool"))
