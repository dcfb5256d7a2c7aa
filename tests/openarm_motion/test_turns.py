# SPDX-License-Identifier: Apache-2.0
"""Joints that turn without end: any start, the short way, the other way where something is in the way, no jump."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.robot_models import load_arm
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.servos import ArmLoad
from openarm_common.robot.turns import nearest_turns, other_ways
from openarm_common.types import Array
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.config import MotionConfig, MotionLimits, PlanningConfig, ServoingConfig
from openarm_motion.constraints.asked import CartesianGoal, RegionGoal
from openarm_motion.constraints.cartesian import along
from openarm_motion.constraints.plans import to_region
from openarm_motion.constraints.queries import at_pose, solve
from openarm_motion.constraints.regions import JointInterval, TaskRegion
from openarm_motion.kinematics.chain import ArmKinematics
from openarm_motion.kinematics.inverse import InverseKinematics
from openarm_motion.planning import moves
from openarm_motion.planning.approach import ApproachRequest, Target, plan_approach
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.moves import RequestBoxes
from openarm_motion.servo.arm_servo import ArmServo, ServoCommand
from openarm_motion.servo.surroundings import Surroundings
from openarm_motion.timing.checks import check_trajectory
from openarm_motion.timing.trajectory import Motion

pytestmark = pytest.mark.requirement("B-07")
NAMES = ("six", "straight")
#: A bent posture of each robot, to which turns of the first and the last joint are added.
BENT = {"six": (0.0, 0.6, 0.9, 0.2, 0.7, 0.0), "straight": (0.0, 0.7, 0.2, 1.1, -0.3, 0.8, 0.0)}
ENDS = (0, -1)


def made(name: str, description: RobotDescription, planner: str = "fast") -> Arm:
    n = len(BENT[name])
    limits = MotionLimits(velocity=(1.0,) * n, acceleration=(3.0,) * n, jerk=(30.0,) * n)
    planning = PlanningConfig(planner=planner, time_limit=4.0)
    config = MotionConfig(arms=(name,), tool_link="tool", group="{arm}", limits=limits, planning=planning, scene="")
    return Arm(name, description, config)


@pytest.fixture(scope="module", params=NAMES)
def arm(request: pytest.FixtureRequest, turning: dict[str, RobotDescription]) -> Arm:
    return made(request.param, turning[request.param])


def at(arm: Arm, first: float, last: float) -> Array:
    q = np.array(BENT[arm.name])
    q[0], q[-1] = first, last
    return q


def planned(arm: Arm, start: Array, goal: Array, *boxes: Box) -> Array:
    """Positions (m, n) of a plan; no joint jumps, and it begins where the arm is."""
    now = arm.start_state(dict(zip(arm.names, start.tolist(), strict=True)))
    q = moves.to_joints(arm, now, goal, RequestBoxes(boxes)).q
    np.testing.assert_array_equal(q[0], start)
    assert np.abs(np.diff(q, axis=0)).max() < 0.2
    return q


def test_the_nearest_turn_is_that_of_joints_without_limits_alone() -> None:
    q = nearest_turns([-3.1, -3.1, 0.4], [3.1, 3.1, 13.0], np.array([math.inf, 3.2, math.inf]))
    np.testing.assert_allclose(q, [2 * math.pi - 3.1, -3.1, 0.4 + 4 * math.pi])
    ways = other_ways(np.array([[3.2, 0.5, 1.0]]), np.array([3.1, 0.0, 2.0]), np.array([math.inf, 3.2, math.inf]))
    np.testing.assert_allclose(ways, [[3.2 - 2 * math.pi, 0.5, 1.0], [3.2, 0.5, 1.0 + 2 * math.pi]])


@pytest.mark.parametrize(
    ("start", "goal", "end"),
    [
        (3.1, -3.1, 2 * math.pi - 3.1),
        (-3.1, 3.1, 3.1 - 2 * math.pi),
        (4.0, 0.5, 2 * math.pi + 0.5),
        (4.0, 4.5, 4.5),
        (13.0, 0.0, 4 * math.pi),
        (-13.0, 13.0, 13.0 - 8 * math.pi),
    ],
)
def test_a_joint_goal_is_reached_by_the_short_way_from_any_start(
    arm: Arm, start: float, goal: float, end: float
) -> None:
    q = planned(arm, at(arm, start, start), at(arm, goal, goal))
    np.testing.assert_allclose(q[-1], at(arm, end, end), atol=1e-9)
    for joint in ENDS:
        assert np.abs(np.diff(q[:, joint])).sum() == pytest.approx(abs(end - start), abs=1e-6)


def test_a_joint_with_limits_keeps_its_turn(six: RobotDescription) -> None:
    arm = made("six", six)
    q = planned(arm, at(arm, 2.8, 2.9), at(arm, -2.8, -2.9))
    np.testing.assert_allclose(q[-1], at(arm, -2.8, -2.9), atol=1e-9)


@pytest.mark.parametrize("planner", ["fast", "ompl"])
def test_where_something_is_in_the_short_way_the_other_way_is_gone(
    turning: dict[str, RobotDescription], planner: str
) -> None:
    arm = made("six", turning["six"], planner)
    start, goal = at(arm, 2.4, 0.0), at(arm, -2.4, 0.0)
    assert planned(arm, start, goal)[-1, 0] == pytest.approx(2 * math.pi - 2.4)
    wall = box_from("wall", (-0.7, 0.0, 0.9), (1.2, 0.02, 1.8))
    roof = box_from("roof", (0.0, 0.0, 0.72), (2.0, 2.0, 0.02))  # the arm can't lean over to the other side, either
    assert planned(arm, start, goal, wall, roof)[-1, 0] == pytest.approx(-2.4)


@pytest.mark.parametrize("turn", [-13.0, 0.0, 3.1, 4.0, 13.0])
def test_inverse_kinematics_answers_near_to_the_seed(arm: Arm, turn: float) -> None:
    seed, there = at(arm, turn, turn), at(arm, turn + 0.4, turn - 0.3)
    pose = arm.kinematics.fk(there)
    best = arm.inverse.nearest(pose, seed)
    assert best.success
    np.testing.assert_allclose(arm.kinematics.fk(best.q), pose, atol=1e-4)
    found = arm.inverse.solutions(pose, 0.05, seed)
    assert found
    for q in (best.q, *(one.q for one in found)):
        assert np.abs(q - seed)[list(ENDS)].max() <= math.pi + 1e-9
    assert min(np.abs(one.q - there).max() for one in found) < (1e-3 if arm.name == "six" else 0.2)


@pytest.mark.parametrize("name", NAMES)
def test_every_pose_is_found_whatever_the_turns(turning: dict[str, RobotDescription], name: str) -> None:
    inverse = InverseKinematics(ArmKinematics(turning[name], "tool"))
    assert inverse.method.startswith("closed form" if name == "straight" else "numeric")
    arm, rng = inverse.kinematics, np.random.default_rng(4)
    for _ in range(60):
        q, near = rng.uniform(*arm.span), rng.uniform(-20.0, 20.0, arm.n)
        pose = arm.fk(q)
        for found in (inverse.solutions(pose), inverse.solutions(pose, near=near)):
            poses = arm.fk_many(np.array([one.q for one in found]))
            np.testing.assert_allclose(poses, np.broadcast_to(pose, poses.shape), atol=2e-4)
        assert inverse.nearest(pose).success


def test_a_pose_and_a_line_go_across_the_seam(arm: Arm) -> None:
    start = at(arm, 3.1, 3.1)
    now = arm.start_state(dict(zip(arm.names, start.tolist(), strict=True)), scale=0.5)
    goal = arm.kinematics.fk(at(arm, 3.25, 3.3))
    for plan in (moves.to_pose, moves.to_pose_on_line):
        q = plan(arm, now, goal, RequestBoxes()).q
        np.testing.assert_allclose(arm.kinematics.fk(q[-1]), goal, atol=1e-3)
        assert np.abs(np.diff(q, axis=0)).max() < 0.2
        assert np.abs(q - start)[:, list(ENDS)].max() < 1.5
    path = along(arm, now, CartesianGoal((goal,)), RequestBoxes())
    assert path.fraction == 1.0
    assert np.abs(np.diff(path.q, axis=0)).max() < 0.2


def test_an_approach_across_the_seam_is_one_motion(arm: Arm) -> None:
    start = at(arm, 9.4, 9.4)
    now = arm.start_state(dict(zip(arm.names, start.tolist(), strict=True)), scale=0.5)
    pose, back = arm.kinematics.fk(at(arm, -3.1, 2.9)), np.array([0.0, 0.0, 0.05])
    plan = plan_approach(arm, now, ApproachRequest((Target("t", pose, back, back),)))
    before = start
    for part in plan.parts:
        np.testing.assert_allclose(part.q[0], before, atol=1e-6)
        assert np.abs(np.diff(part.q, axis=0)).max() < 0.2
        before = part.q[-1]


def test_constraints_of_a_joint_hold_in_any_turn(arm: Arm) -> None:
    start, upper = at(arm, 3.1, 13.0), dict(zip(arm.names, arm.upper, strict=True))
    now = arm.start_state(dict(zip(arm.names, start.tolist(), strict=True)))
    there = zip(arm.names, at(arm, -3.1, 0.5).tolist(), strict=True)
    wanted = [JointInterval(name, q, 0.01, 0.01, upper=upper[name]) for name, q in there]
    path = TaskRegion((JointInterval(arm.names[0], -math.pi, 0.2, 0.2, upper=math.inf),))
    q = to_region(arm, now, RegionGoal((TaskRegion(tuple(wanted)),), path), RequestBoxes()).q
    np.testing.assert_allclose(q[-1, list(ENDS)], [2 * math.pi - 3.1, 4 * math.pi + 0.5], atol=1e-9)
    pose = arm.kinematics.fk(at(arm, -3.1, 0.5))
    q = solve(arm, now, RequestBoxes(), at_pose(pose, TaskRegion((wanted[0],))), avoid_collisions=True)
    assert abs(q[0] - (2 * math.pi - 3.1)) < 0.02
    np.testing.assert_allclose(arm.kinematics.fk(q), pose, atol=1e-3)


def test_a_trajectory_of_another_turn_is_sent_in_the_turn_that_the_arm_is_in(arm: Arm) -> None:
    here, way = at(arm, 13.0, 3.1), np.zeros(arm.kinematics.n)
    way[-1] = 0.2
    q = at(arm, 13.0 - 4 * math.pi, 3.1 - 2 * math.pi)
    given = Motion(arm.names, np.array([0.0, 1.0]), np.stack([q, q + way]))
    sent = check_trajectory(arm, given, dict(zip(arm.names, here.tolist(), strict=True)))
    np.testing.assert_allclose(sent.q, [here, here + way], atol=1e-9)


def test_servoing_turns_on_across_the_seam(arm: Arm) -> None:
    q = at(arm, 0.0, 3.0)
    state = dict(zip(arm.names, q.tolist(), strict=True))
    config = ServoingConfig()
    around = Surroundings.of([arm], arm.start_state(state), [()], config.clearance, config.lag)
    servo, t_ns, sent = ArmServo(arm, config, 0.05), 1_000_000_000, list[tuple[Motion, int]]()
    jog = np.zeros(arm.kinematics.n)
    jog[-1] = 1.0
    for _ in range(150):
        t_ns += 10_000_000
        servo.take(ServoCommand(jog, t_ns * 1e-9, is_twist=False))
        wrapped = (q + math.pi) % math.tau - math.pi  # of an encoder that knows one turn
        found = servo.tick(t_ns, t_ns * 1e-9, (t_ns, wrapped), around, {})
        sent += [] if found is None else [found]
        motion, stamp_ns = sent[-1]
        q = motion.states(np.array([(t_ns - stamp_ns) * 1e-9]))[0]
        assert servo.report.text == ""
    assert q[-1] > 3.8


def test_torques_are_those_of_the_posture_in_any_turn(arm: Arm) -> None:
    load = ArmLoad(arm.description, arm.names, "tool")
    still = np.zeros(arm.kinematics.n)
    np.testing.assert_allclose(
        load.torque_of_mass(at(arm, 0.3, 13.0)), load.torque_of_mass(at(arm, 0.3 - math.tau, 13.0)), atol=1e-9
    )
    assert np.isfinite(load.torque(at(arm, 4.0, 0.0), still, still)).all()


def test_a_panda_with_an_endless_wrist_goes_the_short_way() -> None:
    arm = load_arm("panda", endless="panda_joint7")
    low, high = (ends.copy() for ends in arm.kinematics.span)
    low[-1], high[-1] = -6.0, 6.0
    scene, rng, straight = arm.scene({}), np.random.default_rng(1), 0
    while straight < 12:
        start, goal = rng.uniform(low, high, (2, 7))
        if scene.collides(start) or scene.collides(goal):
            continue
        q = planned(arm, start, goal)
        way = abs(math.remainder(goal[-1] - start[-1], math.tau))
        assert abs(q[-1, -1] - start[-1]) == pytest.approx(way, abs=1e-6)
        straight += np.abs(np.diff(q[:, -1])).sum() < way + 1e-6


def test_constraints_of_moveit_know_which_joints_turn_without_end(turning: dict[str, RobotDescription]) -> None:
    messages = pytest.importorskip("moveit_msgs.msg")
    convert = pytest.importorskip("openarm_motion.ros.move_group.convert")
    description = turning["six"]
    arm = made("six", description)
    names = [messages.JointConstraint(joint_name=name, position=-3.1) for name in ("waist", "shoulder", "flange")]
    region = convert.Converter(description, None, lambda pose, _: pose).region(
        messages.Constraints(joint_constraints=names), "six"
    )
    assert [math.isinf(interval.upper) for interval in region.joints] == [True, False, True]
    q = np.array([[2 * math.pi - 3.1, 2 * math.pi - 3.1, 0.0, 0.0, 0.0, -3.1 - 4 * math.pi]])
    beyond = region.outside(arm.names, q, arm.kinematics.fk_many(q))
    np.testing.assert_allclose([float(part[0]) for _, part in beyond], [0.0, 2 * math.pi, 0.0], atol=1e-9)


def test_the_distance_from_limits_is_that_of_the_joints_that_have_some(arm: Arm) -> None:
    kinematics, q = arm.kinematics, at(arm, 40.0, -13.0)
    inner = slice(1, -1)
    room = np.minimum(q - kinematics.lower, kinematics.upper - q)[inner]
    assert kinematics.margin(q) == pytest.approx(room.min())
    assert kinematics.outside(q, 0.05) == ""
    q[1] = 9.0
    assert kinematics.outside(q).startswith(f"{arm.names[1]} would be at 9.000 rad, allowed")
