# SPDX-License-Identifier: Apache-2.0
"""MoveIt's clients and several arms or goals: groups of two arms, and a newer goal for an arm under way."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from control_msgs.action import ParallelGripperCommand
from moveit_msgs.action import ExecuteTrajectory, MoveGroup
from moveit_msgs.msg import Constraints, MotionPlanRequest, OrientationConstraint
from moveit_msgs.msg import MoveItErrorCodes as Codes
from moveit_msgs.srv import GetCartesianPath, GetPositionIK, GetStateValidity
from rclpy.action import ActionServer, CancelResponse
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectoryPoint

from openarm_common import se3
from openarm_motion.planning.dual_arm import DualArm
from tests.nodes.motion.conftest import SLOWER
from tests.nodes.motion.moveit_client import GROUP, SIDE, Client

pytestmark = pytest.mark.requirement("R-28")

BOTH, SIDES = "both_arms", ("left", "right")
DOWN = se3.rotation_from_z_y((0, 0, -1), (0, 1, 0))


class Arms(Client):
    """What a client of a group of two arms has in addition."""

    def __init__(self, bench) -> None:
        super().__init__(bench)
        self.arms = [bench.node.service.arms[side] for side in SIDES]
        self.names = [name for arm in self.arms for name in arm.names]

    def where(self) -> np.ndarray:
        return np.concatenate([self.bench.q(side) for side in SIDES])

    def posture(self, name: str = "official_home") -> np.ndarray:
        states = [self.bench.description.group_state(f"{side}_arm", name) for side in SIDES]
        return np.array([state[joint] for state, arm in zip(states, self.arms, strict=True) for joint in arm.names])

    def both_goal(self, q) -> MotionPlanRequest:
        return self.joint_goal(q, self.names, BOTH)

    def columns(self, trajectory) -> np.ndarray:
        """Positions of all joints at the points of a trajectory."""
        message = trajectory.joint_trajectory
        order = [list(message.joint_names).index(name) for name in self.names]
        return np.array([point.positions for point in message.points])[:, order]

    def begin(self, request: MotionPlanRequest, scale: float = 0.1):
        """Send a slow goal of /move_action, and wait until the arm has moved a little."""
        request.max_velocity_scaling_factor = request.max_acceleration_scaling_factor = scale
        before = self.where()
        _, future = self.bench.start(self.move, MoveGroup.Goal(request=request))
        self.ros.spin_until(lambda: np.abs(self.where() - before).max() > 0.01, what="the arm to move")
        return future


@pytest.fixture
def arms(moveit_bench) -> Arms:
    return Arms(moveit_bench)


def code(future, arms: Arms) -> int:
    return arms.ros.result(future).result.error_code.val


def test_a_joint_goal_of_both_arms_is_planned_apart_and_executed(arms: Arms) -> None:
    answer = arms.plan(arms.both_goal(arms.posture()))

    assert answer.error_code.val == Codes.SUCCESS, answer.error_code.message
    q = arms.columns(answer.trajectory)
    assert q[0] == pytest.approx(arms.where(), abs=1e-6)
    assert q[-1] == pytest.approx(arms.posture(), abs=1e-3)
    scene = DualArm(*arms.arms).scene(dict(arms.bench.robot.state))
    assert min(scene.separation(row) for row in q) > 0.02

    result = arms.bench.run(arms.execute, ExecuteTrajectory.Goal(trajectory=answer.trajectory))
    assert result.error_code.val == Codes.SUCCESS, result.error_code.message
    assert arms.where() == pytest.approx(arms.posture(), abs=2e-3)

    back = arms.bench.run(arms.move, MoveGroup.Goal(request=arms.both_goal(arms.posture("hands_up"))))
    assert back.error_code.val == Codes.SUCCESS, back.error_code.message
    assert arms.where() == pytest.approx(arms.posture("hands_up"), abs=2e-3)


def test_poses_of_one_tip_or_of_both_are_goals_of_a_group_of_two_arms(arms: Arms) -> None:
    places = {side: se3.make(DOWN, (0.30, y, 0.62)) for side, y in (("left", 0.18), ("right", -0.18))}
    parts = [arms.pose_constraints(places[arm.name], link=arm.kinematics.tool_link) for arm in arms.arms]
    request = arms.both_goal(arms.where())
    for wanted in ([parts[1]], parts):
        request.goal_constraints = [
            Constraints(
                position_constraints=[c for part in wanted for c in part.position_constraints],
                orientation_constraints=[c for part in wanted for c in part.orientation_constraints],
            )
        ]
        answer = arms.plan(request)
        assert answer.error_code.val == Codes.SUCCESS, answer.error_code.message
        ends = np.split(arms.columns(answer.trajectory)[-1], 2)
        for arm, end in zip(arms.arms, ends, strict=True):
            if len(wanted) == 2 or arm.name == "right":
                assert arm.kinematics.fk(end) == pytest.approx(places[arm.name], abs=2e-3)
            else:
                assert end == pytest.approx(arms.bench.q(arm.name), abs=1e-6), "what is not constrained stays"

    state = GetStateValidity.Request(group_name=BOTH, constraints=request.goal_constraints[0])
    state.robot_state.joint_state.name = arms.names
    state.robot_state.joint_state.position = arms.columns(answer.trajectory)[-1].tolist()
    judged = arms.call(GetStateValidity, "/check_state_validity", state)
    assert judged.valid
    assert [part.result for part in judged.constraint_result] == [True] * 4


def test_what_a_group_of_two_arms_does_not_do_is_refused_with_what_does(arms: Arms) -> None:
    request = arms.both_goal(arms.posture())
    request.goal_constraints = [request.goal_constraints[0]] * 2
    said = arms.plan(request).error_code.message
    assert "2 alternatives, expected one: not for a group of two arms; groups of one: left_arm, right_arm" in said
    request = arms.both_goal(arms.posture())
    request.path_constraints.orientation_constraints = [OrientationConstraint(link_name=arms.tool)]
    assert "path_constraints: not for a group of two arms" in arms.plan(request).error_code.message
    request = arms.both_goal(arms.posture())
    request.goal_constraints[0].joint_constraints[3].joint_name = "elbow"
    assert "constraint of joint 'elbow'; joints of the arms: openarm_left" in arms.plan(request).error_code.message
    line = arms.call(GetCartesianPath, "/compute_cartesian_path", GetCartesianPath.Request(group_name=BOTH))
    ik = GetPositionIK.Request()
    ik.ik_request.group_name = BOTH
    for code in (line.error_code, arms.call(GetPositionIK, "/compute_ik", ik).error_code):
        assert code.val == Codes.INVALID_GROUP_NAME
        assert "groups of one: left_arm, right_arm" in code.message


def test_a_trajectory_on_which_the_arms_would_meet_is_not_executed(arms: Arms) -> None:
    answer = arms.plan(arms.both_goal(arms.posture()))
    message = answer.trajectory.joint_trajectory
    middle = se3.make(DOWN, (0.30, 0.0, 0.62))
    ends = [arm.inverse.solutions(middle, 0.05)[0].q for arm in arms.arms]
    rows = np.linspace(arms.where(), np.concatenate(ends), 50)
    message.joint_names = arms.names
    message.points = [JointTrajectoryPoint(positions=row.tolist()) for row in rows]
    for k, point in enumerate(message.points):
        point.time_from_start.sec = k

    result = arms.bench.run(arms.execute, ExecuteTrajectory.Goal(trajectory=answer.trajectory))

    assert result.error_code.val == Codes.INVALID_MOTION_PLAN
    assert "plan the arms together" in result.error_code.message
    assert not arms.bench.robot.active


@pytest.mark.parametrize("group", [GROUP, BOTH])
def test_a_newer_goal_ends_the_one_under_way_and_begins_where_the_arm_is_then(arms: Arms, group: str) -> None:
    arms.bench.robot.speed = 1.0
    start, goal = arms.where(), arms.posture()
    first = arms.begin(arms.both_goal(goal) if group == BOTH else arms.joint_goal(arms.named()))
    assert SIDE in arms.bench.robot.active

    newer = arms.bench.run(arms.move, MoveGroup.Goal(request=arms.joint_goal(start[7:])))

    ended = arms.ros.result(first).result.error_code
    assert ended.val == Codes.PREEMPTED
    assert "a newer goal for the same joints came" in ended.message
    assert newer.error_code.val == Codes.SUCCESS, newer.error_code.message
    begun = np.array(newer.planned_trajectory.joint_trajectory.points[0].positions)
    assert np.abs(begun - start[7:]).max() > 0.01
    assert np.abs(begun - goal[7:]).max() > 0.01
    assert arms.where()[7:] == pytest.approx(start[7:], abs=2e-3)


def test_the_newest_of_many_goals_is_the_one_that_is_reached(arms: Arms) -> None:
    arms.bench.robot.speed = 1.0
    start = arms.where()[7:]
    futures = [arms.begin(arms.joint_goal(arms.named()))]
    for _ in range(3):
        futures.append(arms.bench.start(arms.move, MoveGroup.Goal(request=arms.joint_goal(arms.named())))[1])
    trajectory = arms.plan(arms.joint_goal(start)).trajectory  # a service takes no turn
    assert trajectory.joint_trajectory.points
    futures.append(arms.bench.start(arms.move, MoveGroup.Goal(request=arms.joint_goal(start)))[1])

    codes = [code(future, arms) for future in futures]

    assert codes == [Codes.PREEMPTED] * 4 + [Codes.SUCCESS]
    assert arms.where()[7:] == pytest.approx(start, abs=2e-3)


def test_a_goal_that_is_refused_or_of_another_arm_or_that_only_plans_ends_no_other(arms: Arms) -> None:
    arms.bench.robot.speed = SLOWER
    first = arms.begin(arms.joint_goal(arms.named()))
    wrong = arms.joint_goal(arms.named())
    wrong.planner_id = "RRTstar"
    refused = arms.bench.run(arms.move, MoveGroup.Goal(request=wrong))
    assert "planner_id is 'RRTstar', expected 'fast'" in refused.error_code.message
    only = MoveGroup.Goal(request=arms.joint_goal(arms.named()))
    only.planning_options.plan_only = True
    assert arms.bench.run(arms.move, only).error_code.val == Codes.SUCCESS
    left = arms.joint_goal(arms.posture()[:7], arms.names[:7], "left_arm")
    other = arms.begin(left)
    assert not first.done()
    arms.bench.robot.speed = 8.0

    assert code(first, arms) == Codes.SUCCESS
    assert code(other, arms) == Codes.SUCCESS
    assert arms.where() == pytest.approx(arms.posture(), abs=2e-3)


class Gripper:
    """A hand that moves until it is cancelled, but for goals that it reaches at once."""

    def __init__(self, arms: Arms, reached: float) -> None:
        self.asked: list[float] = []
        self._reached, self._wake = reached, arms.ros.node.create_timer(0.01, self._tick)
        self._waiting: list[Future] = []
        name = f"/{SIDE}_gripper_controller/gripper_cmd"
        accept = lambda _: CancelResponse.ACCEPT  # noqa: E731
        ActionServer(arms.ros.node, ParallelGripperCommand, name, self._execute, cancel_callback=accept)

    def _tick(self) -> None:
        waiting, self._waiting = self._waiting, []
        for future in waiting:
            future.set_result(None)

    async def _execute(self, handle) -> ParallelGripperCommand.Result:
        position = handle.request.command.position[0]
        self.asked.append(position)
        while position != self._reached and not handle.is_cancel_requested:
            self._waiting.append(Future())
            await self._waiting[-1]
        handle.canceled() if handle.is_cancel_requested else handle.succeed()
        return ParallelGripperCommand.Result(reached_goal=position == self._reached)


def test_a_hand_stops_for_a_cancelled_and_for_a_newer_goal_and_has_no_path_constraints(arms: Arms) -> None:
    finger = arms.bench.description.finger_joint(SIDE)
    limits = arms.bench.description.joint(finger)
    low, high = limits.lower, limits.upper
    gripper = Gripper(arms, high)
    arms.ros.spin_until(arms.group._hands._clients[SIDE].server_is_ready, what="the gripper")
    hand = lambda x: MoveGroup.Goal(request=arms.joint_goal([x], [finger], f"{SIDE}_gripper"))  # noqa: E731

    handle, future = arms.bench.start(arms.move, hand(low))
    arms.ros.spin_until(lambda: gripper.asked == [low], what="the hand to move")
    handle.cancel_goal_async()
    assert code(future, arms) == Codes.PREEMPTED
    _, future = arms.bench.start(arms.move, hand(0.5 * (low + high)))
    arms.ros.spin_until(lambda: len(gripper.asked) == 2, what="the hand to move")
    assert arms.bench.run(arms.move, hand(high)).error_code.val == Codes.SUCCESS
    assert code(future, arms) == Codes.PREEMPTED
    goal = hand(low)
    goal.request.path_constraints = goal.request.goal_constraints[0]
    said = arms.bench.run(arms.move, goal).error_code.message
    assert said == "path_constraints: group 'right_gripper' goes straight to its goal, expected none"
    goal = hand(low)
    goal.request.pipeline_id = "chomp"
    assert "pipeline_id is 'chomp'" in arms.bench.run(arms.move, goal).error_code.message
    assert gripper.asked == [low, 0.5 * (low + high), high]


def test_what_a_request_says_in_vain_is_said_or_refused_by_name(arms: Arms) -> None:
    request = arms.joint_goal(arms.named())
    request.goal_constraints[0].joint_constraints[2].weight = 0.25
    assert "every constraint is met, whatever its weight (0.25, 1)" in arms.plan(request).error_code.message
    request.goal_constraints[0].joint_constraints[2].weight = -1.0
    assert "joint3: weight is -1, expected a number >= 0" in arms.plan(request).error_code.message
    for field in ("max_velocity_scaling_factor", "max_acceleration_scaling_factor"):
        request = arms.joint_goal(arms.named())
        setattr(request, field, 1.5)
        assert f"{field} is 1.5, expected 0.001 to 1" in arms.plan(request).error_code.message
    request = arms.joint_goal(arms.named())
    request.start_state.joint_state.name = [arms.arm.names[0]]
    request.start_state.joint_state.position = [0.3]
    assert "start_state" not in arms.plan(request).error_code.message
    moved = arms.bench.run(arms.move, MoveGroup.Goal(request=request))
    assert moved.error_code.val == Codes.SUCCESS, moved.error_code.message
    assert "it started where the arm was, not in start_state" in moved.error_code.message


#: Both arms go to a posture; then one goes home, and is sent back on its way.
_PROGRAM = """
import json, sys, threading, time
import rclpy
from moveit_msgs.action import MoveGroup
from moveit_msgs.msg import MoveItErrorCodes
from pymoveit2 import MoveIt2
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

asked = json.loads(sys.argv[1])
rclpy.init()
node = Node("program")
names = asked["base"], asked["tool"]
make = lambda group: MoveIt2(node, asked[group]["joints"], *names, group, use_move_group_action=True)
both, one = make("both_arms"), make("right_arm")
executor = SingleThreadedExecutor()
executor.add_node(node)
threading.Thread(target=executor.spin, daemon=True).start()
ActionClient(node, MoveGroup, "move_action").wait_for_server()
both.wait_for_joint_state(30.0)
both.max_velocity = both.max_acceleration = one.max_velocity = one.max_acceleration = 1.0
one.num_planning_attempts = 3
both.move_to_configuration(asked["both_arms"]["goal"])
print(both.wait_until_executed(), flush=True)
one.max_velocity = one.max_acceleration = 0.1
one.move_to_configuration(asked["right_arm"]["goal"])
time.sleep(0.5)
both.move_to_configuration(asked["both_arms"]["goal"])
print(both.wait_until_executed(), flush=True)
print(one.wait_until_executed(), flush=True)
print(one.get_last_execution_error_code().val == MoveItErrorCodes.PREEMPTED, flush=True)
"""


def test_a_program_on_pymoveit2_moves_both_arms_and_takes_over_from_its_own_goal(arms: Arms) -> None:
    pytest.importorskip("pymoveit2", reason="needs the extra moveit")
    arms.bench.robot.speed = 1.0
    asked = {
        "base": arms.bench.description.base,
        "tool": arms.tool,
        BOTH: {"joints": arms.names, "goal": arms.posture().tolist()},
        GROUP: {"joints": list(arms.arm.names), "goal": arms.where()[7:].tolist()},
    }
    env = {**os.environ, "ROS_DOMAIN_ID": str(arms.node.context.get_domain_id())}
    with subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, json.dumps(asked)], env=env, stdout=subprocess.PIPE, text=True
    ) as program:
        arms.ros.spin_until(lambda: program.poll() is not None, what="the program")
        said = program.stdout.read().split()
    assert said == ["True", "True", "False", "True"]
    assert arms.where() == pytest.approx(arms.posture(), abs=5e-3)
