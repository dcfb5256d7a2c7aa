# SPDX-License-Identifier: Apache-2.0
"""Arms on a lift: all that plans is of the height that was measured."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import ROBOT
from openarm_common.scene.scene import Scene
from openarm_evaluation.campaign.robot import SimRobot, SimulatedSenses
from openarm_motion.collision.fast import FastScene
from openarm_motion.collision.solids import box_from
from openarm_motion.config import MotionConfig
from openarm_motion.planning.lift import LiftedArms
from openarm_motion.service.motion_service import make_arms
from openarm_motion.service.requests import JointGoal, LineGoal, MoveRequest, PoseGoal

ROBOT_NAME = "openarm_v2_cell"
LIFT = "openarm_lifter_joint"
SIDE = "right"


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return RobotDescription.load(ROBOT_NAME)


@pytest.fixture(scope="module")
def home(robot) -> dict[str, float]:
    postures = [robot.group_state(f"{arm}_arm", "home") for arm in robot.arm_names]
    closed = {robot.finger_joint(arm): 0.0 for arm in robot.arm_names}
    return {name: value for posture in (*postures, closed) for name, value in posture.items()}


@pytest.fixture(scope="module")
def arms(robot) -> LiftedArms:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ROBOT, ROBOT_NAME)
        made = make_arms(MotionConfig(), robot, [])
    assert isinstance(made, LiftedArms)
    return made


@given(st.floats(0.0, 0.3))
@settings(max_examples=5)
def test_a_robot_at_a_height_has_the_poses_of_one_whose_lift_is_there(height: float) -> None:
    robot = RobotDescription.load(ROBOT_NAME)
    fixed = robot.with_fixed(LIFT, height)
    q = dict.fromkeys(robot.joints, 0.3)
    again = RobotDescription.from_urdf(fixed.urdf)
    assert fixed.lift is None
    assert fixed.joints[LIFT].type == again.joints[LIFT].type == "fixed"
    expected = robot.link_poses(q | {LIFT: height})
    for made in (fixed.link_poses(q), again.link_poses(q)):
        assert max(np.abs(made[link] - expected[link]).max() for link in expected) < 1e-12


def test_only_what_slides_is_fixed_so(robot) -> None:
    with pytest.raises(OpenArmError, match="openarm_left_joint1' is revolute, expected one that slides"):
        robot.with_fixed("openarm_left_joint1", 0.0)


@pytest.mark.long
def test_kinematics_and_collisions_are_those_of_the_measured_height(robot, home, arms) -> None:
    """FK and closed form as the robot's own kinematics has them; a box before the hand is hit at its height alone."""
    height = 0.137
    state = home | {LIFT: height}
    arms.follow(state)
    arm = arms[SIDE]
    q = np.array([state[name] for name in arm.names])
    pose = robot.link_pose(robot.tcp_link(SIDE), state)
    assert arms.height == pytest.approx(height, abs=2.6e-4)
    assert arm.inverse.method == "closed form"
    shift = se3.make(None, (0.0, 0.0, arms.height - height))
    np.testing.assert_allclose(arm.kinematics.fk(q), shift @ pose, atol=1e-9)
    assert min(np.abs(found.q - q).max() for found in arm.inverse.solutions(shift @ pose, near=q)) < 1e-3
    here, above = (box_from("box", tuple(pose[:3, 3] + (0.0, 0.0, up)), (0.04, 0.04, 0.04)) for up in (0.0, 0.25))
    for boxes, hit in (([], False), ([here], True), ([above], False)):
        scene = arm.scene(state, boxes)
        assert scene.collides(q) == hit
        assert FastScene([scene]).free_many(q[None])[0] == (not hit)


@pytest.mark.long
def test_arms_stay_those_of_a_height_that_is_near_enough_or_not_known(home, arms) -> None:
    arms.follow(home | {LIFT: 0.137})
    first = arms[SIDE]
    for state in (home, home | {LIFT: 0.1374}):
        arms.follow(state)
        assert arms[SIDE] is first
    arms.follow(home | {LIFT: 0.0})
    assert arms[SIDE] is not first
    arms.follow(home | {LIFT: 0.137})
    assert arms[SIDE] is first  # what was made is kept


def done(robot: SimRobot, work):
    """The answer of a request, one control tick a turn."""
    while True:
        try:
            work.send(None)
        except StopIteration as end:
            return end.value
        robot.tick()


def to_height(height: float, scale: float = 0.0) -> MoveRequest:
    return MoveRequest("lift", JointGoal(np.array([height])), scale=scale)


def at(robot: SimRobot) -> float:
    return float(robot.world.data.joint(LIFT).qpos[0])


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> SimRobot:
    """With its lift at 0.12 m."""
    monkeypatch.setenv(ROBOT, ROBOT_NAME)
    senses = SimulatedSenses(depth_noise=False, sets=("motion.map.use=off", "mujoco_bridge.profile=ideal"))
    robot = SimRobot(Scene(name="empty"), senses, posture={LIFT: 0.12})
    robot.pass_time(0.2)
    return robot


@pytest.mark.long
@pytest.mark.requirement("R-05")
def test_the_tool_goes_to_a_pose_in_the_base_frame_at_any_height(simulated: SimRobot) -> None:
    """Planned from measured joints, carried out by the simulated robot, seen in the simulation itself."""
    down = se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.42, -0.25, 1.30))
    answer = done(simulated, simulated.motion.move(MoveRequest(SIDE, PoseGoal(down))))
    assert answer.error is None, answer.message
    simulated.pass_time(0.5)
    site = simulated.world.data.site(simulated.description.tcp_link(SIDE))
    assert np.linalg.norm(site.xpos - down[:3, 3]) < 0.003
    assert at(simulated) == pytest.approx(0.12, abs=0.001)


@pytest.mark.long
@pytest.mark.requirement("R-05")
def test_the_lift_moves_with_both_arms_and_what_is_planned_next_is_of_its_new_height(simulated: SimRobot) -> None:
    joints = [name for arm in simulated.description.arms.values() for name in arm.joints]
    columns = simulated.columns(joints)
    before = simulated.world.read_joints().position[columns]
    answer = done(simulated, simulated.motion.move(to_height(0.05, scale=1.0)))
    assert answer.error is None, answer.message
    assert answer.trajectory is not None
    assert np.abs(answer.trajectory.v).max() <= 0.05 + 1e-9  # m/s, of the URDF
    assert at(simulated) == pytest.approx(0.05, abs=0.001)
    np.testing.assert_allclose(simulated.world.read_joints().position[columns], before, atol=0.01)
    assert isinstance(simulated.motion.arms, LiftedArms)
    assert simulated.motion.arms.height == pytest.approx(0.05, abs=0.001)


def test_a_lift_that_would_hit_something_does_not_move(simulated: SimRobot) -> None:
    """At the top the fingers of the home posture are in the roof; a solid over a hand is met on the way."""
    tool = simulated.world.data.site(simulated.description.tcp_link(SIDE)).xpos
    bar = box_from("bar", (tool[0], tool[1], tool[2] + 0.12), (0.05, 0.05, 0.05))
    for height, solids, words in ((0.3, (), "openarm_cell"), (0.2, (bar,), "bar"), (0.31, (), "allowed 0 to 0.3 m")):
        simulated.motion.apply_scene(clear=True, remove=(), add=solids)
        answer = done(simulated, simulated.motion.move(to_height(height)))
        assert answer.error is not None
        assert words in answer.message
        assert at(simulated) == pytest.approx(0.12, abs=0.001)


def test_what_is_no_height_is_refused(simulated: SimRobot) -> None:
    for goal in (JointGoal(np.zeros(7)), JointGoal(np.array([np.nan])), LineGoal(np.eye(4))):
        answer = done(simulated, simulated.motion.move(MoveRequest("lift", goal)))
        assert "takes a joint goal of one position, m" in answer.message
