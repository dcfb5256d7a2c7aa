# SPDX-License-Identifier: Apache-2.0
"""`arm_control` before the controllers of openarm_ros2: arms as owners have them go where they should."""

from __future__ import annotations

import numpy as np
import pytest
from control_msgs.action import FollowJointTrajectory, ParallelGripperCommand
from control_msgs.msg import JointTrajectoryControllerState
from rclpy.action import ActionClient
from rclpy.qos import qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import QOS_COMMAND
from openarm_control.ros.node import ArmControl
from tests.nodes.conftest import Bench

#: In one process with the robot and the test, neither of them in real time: a robot that is late is off its path.
PATIENT = {"stale_after": 5.0, "trajectory.path_tolerance": 1.0, "trajectory.goal_time": 20.0, "dynamics_seed": 1}


@pytest.fixture
def robot(bridge) -> Bench:
    """The bridge as openarm_ros2."""
    return bridge(images=False, scene="empty", profile="openarm", controllers="openarm_ros2")


@pytest.fixture
def bench(robot: Bench) -> Bench:
    """And the node before it."""
    robot.client = robot.ros.start(ArmControl, **PATIENT)
    robot.passed_on = robot.collect(JointState, "/arm_control/joint_states", QOS_COMMAND)
    name = "/arm_control/right_joint_trajectory_controller/controller_state"
    robot.states = robot.collect(JointTrajectoryControllerState, name, QOS_COMMAND)
    robot.ros.spin_until(lambda: robot.states, what="the state of a controller")
    return robot


def move(bench: Bench, prefix: str, offset: float, seconds: float) -> FollowJointTrajectory.Result:
    """Move the arm sideways from near zero, where activation leaves it."""
    start = [0.05, 0.05, 0.0, 0.05, 0.0, 0.0, 0.0]
    goal = bench.goal((0.5, start), (seconds, [q + offset * (i == 1) for i, q in enumerate(start)]))
    client = ActionClient(
        bench.ros.node, FollowJointTrajectory, f"{prefix}/right_joint_trajectory_controller/follow_joint_trajectory"
    )
    _, result = bench.ros.send_goal(client, goal)
    return bench.ros.result(result).result


def errors(bench: Bench, since: int) -> np.ndarray:
    return np.abs([state.error.positions for state in bench.states[since:]])


@pytest.mark.requirement("R-03", "A-25")
def test_a_soft_arm_follows_a_motion_and_arrives(bench: Bench) -> None:
    """There is no clock, no velocity of a finger and no effort."""
    clocks = bench.collect(Clock, "/clock", qos_profile_sensor_data)
    result = move(bench, "/arm_control", 0.3, 1.0)
    assert result.error_code == 0, result.error_string
    bench.ros.spin_until(lambda: errors(bench, -30).max() < 0.02, what="an arm that rests where it should")
    at = dict(zip(bench.joints[-1].name, bench.joints[-1].position, strict=True))
    assert at["openarm_right_joint2"] == pytest.approx(bench.states[-1].reference.positions[1], abs=0.02)
    assert clocks == []
    finger = bench.joints[-1].name.index(bench.FINGER)
    assert all(message.velocity[finger] == message.effort[finger] == 0.0 for message in bench.joints)
    targets = bench.client._driver.targets
    bench.ros.spin_until(lambda: not np.isnan(targets(0)).all(), what="targets that the controllers say")
    assert np.isnan(targets(2**62)).all(), "older than asked for"


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.requirement("R-03", "A-25")
def test_a_soft_arm_is_near_to_its_path_all_the_way(bench: Bench) -> None:
    since = len(bench.states)
    assert move(bench, "/arm_control", 0.6, 2.0).error_code == 0
    assert np.quantile(errors(bench, since).max(axis=1), 0.75) < 0.1  # it is late at times where the machine is busy


@pytest.mark.long
@pytest.mark.requirement("R-03")
def test_the_same_motion_sent_to_the_robot_itself_is_a_blow(robot: Bench) -> None:
    """Two points, which such controllers do not join."""
    bench, before = robot, robot.position("openarm_right_joint2")
    assert move(bench, "", 0.6, 2.0).error_code == 0
    assert bench.position("openarm_right_joint2") - before > 0.4
    shoulder = bench.joints[-1].name.index("openarm_right_joint2")
    fastest = max(abs(message.velocity[shoulder]) for message in bench.joints)
    assert fastest > 2.0  # 0.6 rad in 2 s would be 0.45 rad/s at most


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.requirement("R-03")
def test_joint_states_come_at_each_physics_step_and_are_passed_on_at_the_rate_of_control(bench: Bench) -> None:
    had, since = len(bench.joints), len(bench.passed_on)
    bench.spin_sim(1.0)
    steps = np.diff([stamp_to_ns(message.header.stamp) for message in bench.joints[had:]])
    # a busy probe misses some, and a busy robot sets its stamps to the wall clock once in a while
    assert np.any(steps == 2_000_000)
    assert np.mean(steps % 2_000_000 == 0) > 0.9
    assert 30 <= len(bench.passed_on) - since <= 110  # 100; fewer where the machine is busy


@pytest.mark.long
@pytest.mark.requirement("R-03", "P-22")
def test_a_hand_opens_and_closes_and_the_emergency_stop_is_of_this_node(bench: Bench) -> None:
    hand = ActionClient(bench.ros.node, ParallelGripperCommand, "/arm_control/right_gripper_controller/gripper_cmd")
    for position in (0.02, 0.0):
        command = ParallelGripperCommand.Goal(command=JointState(name=[bench.FINGER], position=[position]))
        answer = bench.ros.result(bench.ros.send_goal(hand, command)[1]).result
        assert (answer.reached_goal, answer.stalled) == (True, False)
        assert bench.position(bench.FINGER) == pytest.approx(position, abs=0.002)
    start = [0.05, 0.05, 0.0, 0.05, 0.0, 0.0, 0.0]
    name = "/arm_control/right_joint_trajectory_controller/follow_joint_trajectory"
    client = ActionClient(bench.ros.node, FollowJointTrajectory, name)
    goal = bench.goal((0.5, start), (60.0, [q + 0.8 * (i == 1) for i, q in enumerate(start)]))
    _, result = bench.ros.send_goal(client, goal)
    bench.spin_sim(0.3)
    assert bench.call(Trigger, "/stop").success
    assert bench.ros.result(result).result.error_string.startswith("the emergency stop is latched")
    assert bench.call(Trigger, "/arm_control/reset").success
    assert move(bench, "/arm_control", 0.1, 0.8).error_code == 0
