# SPDX-License-Identifier: Apache-2.0
"""The motion node against a fake robot: joint states and two FollowJointTrajectory controllers in the same process."""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from control_msgs.action import FollowJointTrajectory
from geometry_msgs.msg import PoseStamped, Vector3
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, PlanApproach
from openarm_interfaces.msg import ApproachTarget, CollisionBox
from openarm_interfaces.srv import ComputeIK
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.action.client import ClientGoalHandle
from rclpy.task import Future
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common import se3
from openarm_common.convert import (
    matrix_to_pose,
    matrix_to_transform,
    ns_to_stamp,
    trajectory_from_msg,
    trajectory_to_msg,
)
from openarm_common.description import RobotDescription
from openarm_common.errors import Code, OpenArmError
from openarm_common.node import QOS_COMMAND, QOS_LATCHED, QOS_STATIC_TF, BaseNode
from openarm_motion.node import MotionNode, table_boxes
from openarm_motion.planner import PlannedPath, PlanQuery

Result = FollowJointTrajectory.Result
HZ = 100
#: The fake robot's time runs this much faster than the wall clock.
FASTER = 4


class FakeRobot:
    """Publishes joint states, and follows trajectories exactly, in a time of its own."""

    def __init__(self, node, description: RobotDescription, state: dict[str, float]) -> None:
        self.node, self.state = node, dict(state)
        self.t_ns = 1_000_000_000
        self.silent = False
        self.answer: Callable[[FollowJointTrajectory.Result], None] = lambda result: None
        self.stuck: set[str] = set()
        self.accept = True
        self.cancelled: list[str] = []
        self.gone: set[str] = set()
        self.active: dict[str, tuple[int, list[str], np.ndarray, np.ndarray]] = {}
        self._wake = Future()
        self._publisher = node.create_publisher(JointState, "/joint_states", QOS_COMMAND)
        tf = node.create_publisher(TFMessage, "/tf_static", QOS_STATIC_TF)
        table = matrix_to_transform("world", "table", se3.make(None, (0.0, 0.0, 0.40)), 0)
        tf.publish(TFMessage(transforms=[table]))
        self.tf = tf
        node.create_timer(1.0 / HZ, self._tick)
        self.servers = {
            side: ActionServer(
                node,
                FollowJointTrajectory,
                f"/{side}_joint_trajectory_controller/follow_joint_trajectory",
                functools.partial(self._execute, side),
                goal_callback=lambda _: GoalResponse.ACCEPT if self.accept else GoalResponse.REJECT,
                cancel_callback=lambda _: CancelResponse.ACCEPT,
            )
            for side in ("left", "right")
        }

    def _tick(self) -> None:
        self.t_ns += FASTER * 10_000_000
        for start_ns, names, t, q in self.active.values():
            now = (self.t_ns - start_ns) * 1e-9
            for i, name in enumerate(names):
                if name not in self.stuck:
                    self.state[name] = float(np.interp(now, t, q[:, i]))
        if not self.silent:
            message = JointState(name=list(self.state), position=list(self.state.values()))
            message.header.stamp = ns_to_stamp(self.t_ns)
            self._publisher.publish(message)
        wake, self._wake = self._wake, Future()
        wake.set_result(None)

    async def _execute(self, side: str, handle) -> FollowJointTrajectory.Result:
        names, t, q, _, _ = trajectory_from_msg(handle.request.trajectory)
        self.active[side] = (self.t_ns, names, t, q)
        result = FollowJointTrajectory.Result(error_code=Result.SUCCESSFUL)
        end_ns = self.t_ns + int(t[-1] * 1e9)
        while self.t_ns < end_ns and side not in self.gone and not handle.is_cancel_requested:
            await self._wake
        self.active.pop(side)
        if side in self.gone:
            return result
        if handle.is_cancel_requested:
            self.cancelled.append(side)
            handle.canceled()
            result.error_code, result.error_string = Result.INVALID_GOAL, "cancelled"
            return result
        self.answer(result)
        handle.succeed() if result.error_code == Result.SUCCESSFUL else handle.abort()
        return result


class Bench:
    """A motion node, a fake robot, and clients."""

    def __init__(self, ros, description: RobotDescription) -> None:
        self.ros, self.description = ros, description
        home = {**description.group_state("left_arm", "home"), **description.group_state("right_arm", "home")}
        fingers = {description.finger_joint("left"): 0.0, description.finger_joint("right"): 0.0}
        # a coroutine of the robot must not keep its own timer from running
        self.robot = FakeRobot(ros.add(RobotNode()), description, {**home, **fingers})
        self.node = ros.add(MotionNode())
        self.plan_client = ActionClient(ros.node, PlanApproach, "/motion/plan_approach")
        self.move_client = ActionClient(ros.node, MoveArm, "/motion/move")
        self.execute_client = ActionClient(ros.node, ExecuteTrajectory, "/motion/execute")
        self.ik_client = ros.node.create_client(ComputeIK, "/motion/compute_ik")
        self.markers: list[MarkerArray] = []
        ros.node.create_subscription(MarkerArray, "/motion/attached_objects", self.markers.append, QOS_LATCHED)
        ros.spin_until(lambda: self.node._states.age_s() < 0.5, 10.0, "joint states")
        ros.spin_until(lambda: "table" in self.node._states.buffer._static, 10.0, "the table's frame")
        for follower in self.node._followers.values():
            ros.spin_until(follower._client.server_is_ready, 10.0, "controllers")

    def start(self, client: ActionClient, goal, **kwargs) -> tuple[ClientGoalHandle, Future]:
        handle, future = self.ros.send_goal(client, goal, **kwargs)
        assert handle.accepted
        return handle, future

    def run(self, client: ActionClient, goal, timeout: float = 10.0, **kwargs):
        """Send a goal and return its result."""
        _, future = self.start(client, goal, **kwargs)
        return self.ros.result(future, timeout).result

    def begin(self, side: str, trajectory: JointTrajectory) -> tuple[ClientGoalHandle, Future]:
        """Send a trajectory and wait until the arm is on its way."""
        goal = ExecuteTrajectory.Goal(arm=side, trajectory=trajectory)
        handle, future = self.start(self.execute_client, goal)
        self.ros.spin_until(lambda: side in self.robot.active or future.done(), 10.0, "the arm to start")
        assert not future.done(), future.result()
        return handle, future

    def q(self, side: str) -> np.ndarray:
        return np.array([self.robot.state[name] for name in self.description.arm_joints(side)])

    def held(self) -> list[str]:
        """Ids of what the latest marker array shows as held."""
        if not self.markers:
            return []
        return [marker.ns for marker in self.markers[-1].markers if marker.action == Marker.ADD]


class RobotNode(BaseNode):
    """A node whose callbacks overlap, as the bridge's do."""

    def __init__(self) -> None:
        from openarm_common.config import Config

        super().__init__("fake_robot", Config)


@pytest.fixture(scope="module")
def description() -> RobotDescription:
    return RobotDescription.load()


@pytest.fixture
def bench(ros, description: RobotDescription) -> Iterator[Bench]:
    return Bench(ros, description)


def stamped(T: np.ndarray, frame: str = "") -> PoseStamped:
    pose = PoseStamped(pose=matrix_to_pose(T))
    pose.header.frame_id = frame
    return pose


DOWN = se3.rotation_from_z_y((0, 0, -1), (0, 1, 0))


def named(arm: str = "right", posture: str = "official_home", **kwargs) -> MoveArm.Goal:
    return MoveArm.Goal(arm=arm, kind=MoveArm.Goal.NAMED, named=posture, velocity_scale=1.0, **kwargs)


# --- inverse kinematics
def test_a66_compute_ik_in_the_table_frame(bench: Bench) -> None:
    target = se3.make(DOWN, (0.4, 0.2, 0.3))
    request = ComputeIK.Request(arm="left", pose=stamped(target, "table"), free_orientation=True)
    answer = bench.ros.call(bench.ik_client, request)
    assert (answer.success, answer.code) == (True, "OK")
    assert answer.position_error < 1e-4
    reached = bench.description.link_pose(
        "openarm_left_hand_tcp", dict(zip(bench.description.arm_joints("left"), answer.joint_positions, strict=True))
    )
    np.testing.assert_allclose(reached[:3, 3], [0.4, 0.2, 0.7], atol=1e-4)
    request.free_orientation = False
    answer = bench.ros.call(bench.ik_client, request)
    assert (answer.success, answer.code) == (False, "UNREACHABLE")
    assert "left arm can't reach (0.400, 0.200, 0.700) m" in answer.message
    assert 0.0 < answer.position_error < 0.1
    assert abs(answer.nearest.position.x - 0.4) < 0.1


def test_compute_ik_answers_what_is_wrong(bench: Bench) -> None:
    answer = bench.ros.call(bench.ik_client, ComputeIK.Request(arm="third", pose=stamped(np.eye(4))))
    assert (answer.code, answer.message) == ("INVALID_ARGUMENT", "arm is 'third'; arms: left, right")
    answer = bench.ros.call(bench.ik_client, ComputeIK.Request(arm="left", pose=stamped(np.eye(4), "nowhere")))
    assert answer.code == "NO_TRANSFORM"
    assert "table" in answer.message
    bad = PoseStamped()
    bad.pose.orientation.w = 0.0
    answer = bench.ros.call(bench.ik_client, ComputeIK.Request(arm="left", pose=bad))
    assert answer.code == "INVALID_ARGUMENT"


# --- moves
def test_a25_a_move_is_planned_sent_as_joint_targets_and_verified(bench: Bench) -> None:
    feedback: list[tuple[str, float]] = []
    goal = named()
    result = bench.run(
        bench.move_client, goal, feedback_callback=lambda m: feedback.append((m.feedback.stage, m.feedback.progress))
    )
    assert (result.success, result.code, result.message) == (True, "OK", "arrived")
    np.testing.assert_allclose(bench.q("right"), [0, 0, 0, 1.5708, 0, 0, 0], atol=1e-3)
    assert result.trajectory.joint_names == list(bench.description.arm_joints("right"))
    assert len(result.trajectory.points[0].accelerations) == 7
    assert feedback[0][0] == "planning"
    assert feedback[-1] == ("executing", 1.0)
    assert result.planning_time < 5.0


def test_plan_only_moves_nothing(bench: Bench) -> None:
    before = bench.q("right")
    result = bench.run(bench.move_client, named(plan_only=True))
    assert result.success
    assert len(result.trajectory.points) > 10
    np.testing.assert_array_equal(bench.q("right"), before)


def test_every_kind_of_move(bench: Bench) -> None:
    arm = bench.node._arms["left"]
    T = arm.kinematics.fk(bench.q("left"))
    below = T.copy()
    below[2, 3] -= 0.08
    result = bench.run(
        bench.move_client, MoveArm.Goal(arm="left", kind=MoveArm.Goal.LINEAR, pose=stamped(below), velocity_scale=1.0)
    )
    assert result.success, result.message
    np.testing.assert_allclose(arm.kinematics.fk(bench.q("left")), below, atol=1e-3)
    pose = se3.make(DOWN, (0.26, 0.24, 0.15))
    result = bench.run(
        bench.move_client,
        MoveArm.Goal(arm="left", kind=MoveArm.Goal.POSE, pose=stamped(pose, "table"), velocity_scale=1.0),
    )
    assert result.success, result.message
    np.testing.assert_allclose(arm.kinematics.fk(bench.q("left"))[:3, 3], [0.26, 0.24, 0.55], atol=1e-3)
    home = [bench.description.group_state("left_arm", "home")[n] for n in bench.description.arm_joints("left")]
    result = bench.run(
        bench.move_client,
        MoveArm.Goal(arm="left", kind=MoveArm.Goal.JOINTS, joint_positions=home, velocity_scale=1.0),
    )
    assert result.success, result.message
    np.testing.assert_allclose(bench.q("left"), home, atol=1e-3)


def test_refused_moves_say_why(bench: Bench) -> None:
    cases = [
        (MoveArm.Goal(arm="left", kind=9), "INVALID_ARGUMENT", "kind is 9"),
        (named(posture="yoga"), "INVALID_ARGUMENT", "no state 'yoga'"),
        (
            MoveArm.Goal(arm="right", kind=MoveArm.Goal.JOINTS, joint_positions=[0.0] * 6),
            "INVALID_ARGUMENT",
            "goal has 6",
        ),
        (
            MoveArm.Goal(arm="right", kind=MoveArm.Goal.POSE, pose=stamped(se3.make(DOWN, (0.25, -0.25, 0.38)))),
            "IN_COLLISION",
            "table",
        ),
        (
            MoveArm.Goal(arm="left", kind=MoveArm.Goal.POSE, pose=stamped(se3.make(DOWN, (0.4, 0.2, 0.3)), "table")),
            "UNREACHABLE",
            "nearest reachable pose",
        ),
        (
            MoveArm.Goal(arm="right", kind=3, named="home", velocity_scale=1.5),
            "INVALID_ARGUMENT",
            "velocity_scale is 1.5",
        ),
        (
            named(obstacles=[CollisionBox(id="flat", size=Vector3(x=0.1, y=0.1, z=0.0))]),
            "INVALID_ARGUMENT",
            "box 'flat' has size",
        ),
    ]
    for goal, code, text in cases:
        result = bench.run(bench.move_client, goal)
        assert (result.success, result.code) == (False, code), result.message
        assert text in result.message


def test_both_arms_move_at_once_and_one_arm_only_once(bench: Bench) -> None:
    right = bench.start(bench.move_client, named("right"))[1]
    left = bench.start(bench.move_client, named("left"))[1]
    bench.ros.spin_until(lambda: len(bench.robot.active) == 2, 5.0, "both arms on their way")
    second = bench.run(bench.move_client, named("right", "home"))
    assert (second.success, second.code) == (False, "BUSY")
    assert "right arm is moving already" in second.message
    for future in (left, right):
        assert bench.ros.result(future).result.success
    # free again
    assert bench.run(bench.move_client, named("right", "home")).success


def test_the_executor_answers_while_a_plan_is_searched(bench: Bench) -> None:
    for name in bench.description.arm_joints("right"):
        bench.robot.state[name] = 0.0
    bench.ros.spin_until(lambda: abs(bench.node._states.buffer.latest()[1]["openarm_right_joint2"]) < 1e-9)
    future = bench.start(bench.move_client, named("right", "home", plan_only=True))[1]
    begin = time.monotonic()
    answer = bench.ros.call(bench.ik_client, ComputeIK.Request(arm="left", pose=stamped(np.eye(4))))
    assert answer.code == "UNREACHABLE"
    assert time.monotonic() - begin < 1.0
    assert bench.ros.result(future).result.success


# --- approaches
def approach_goal(**kwargs) -> PlanApproach.Goal:
    target = ApproachTarget(id="top", pose=matrix_to_pose(se3.make(DOWN, (0.26, -0.24, 0.425))), score=1.0)
    target.approach_offset.z, target.retreat_offset.z = 0.08, 0.12
    far = ApproachTarget(id="far", pose=matrix_to_pose(se3.make(DOWN, (0.7, -0.24, 0.425))), score=2.0)
    cube = CollisionBox(id="cube", pose=matrix_to_pose(se3.make(None, (0.26, -0.24, 0.425))))
    cube.size.x = cube.size.y = cube.size.z = 0.05
    return PlanApproach.Goal(
        arm="right", targets=[far, target], obstacles=[cube], touchable=["cube"], velocity_scale=1.0, **kwargs
    )


def test_a_grasp_is_planned_executed_and_shown_as_attached_b47(bench: Bench) -> None:
    plan = bench.run(bench.plan_client, approach_goal(attached_after_approach=True))
    assert (plan.success, plan.code, plan.chosen) == (True, "OK", 1), plan.message
    assert [(r.id, r.code) for r in plan.refusals] == [("far", "UNREACHABLE")]
    assert plan.planning_time < 3.0
    for part, held in ((plan.transfer, []), (plan.approach, []), (plan.retreat, ["right/cube"])):
        result = bench.run(bench.execute_client, ExecuteTrajectory.Goal(arm="right", trajectory=part))
        assert result.success, result.message
        bench.ros.spin_until(lambda held=held: bench.held() == held, 5.0, f"{held} shown as attached")
    marker = bench.markers[-1].markers[-1]
    assert marker.header.frame_id == "openarm_right_hand_tcp"
    assert marker.scale.x == pytest.approx(0.05)
    arm = bench.node._arms["right"]
    np.testing.assert_allclose(arm.kinematics.fk(bench.q("right"))[:3, 3], [0.26, -0.24, 0.545], atol=1e-3)


def test_an_approach_that_fails_carries_all_refusals(bench: Bench) -> None:
    goal = approach_goal()
    goal.targets = goal.targets[:1]
    plan = bench.run(bench.plan_client, goal)
    assert (plan.success, plan.code, plan.chosen) == (False, "UNREACHABLE", -1)
    assert plan.message.startswith("right arm: far: ")
    assert [(r.id, r.code) for r in plan.refusals] == [("far", "UNREACHABLE")]
    goal = approach_goal()
    goal.touchable = ["cup"]
    assert bench.run(bench.plan_client, goal).code == "INVALID_ARGUMENT"


# --- execution
def slow_plan(bench: Bench) -> JointTrajectory:
    """A motion that takes long enough to be disturbed: 40 s of the robot's time, 10 of the wall clock."""
    goal = named(plan_only=True)
    goal.velocity_scale = 0.02
    return bench.run(bench.move_client, goal).trajectory


def test_a_bad_trajectory_is_refused_with_joint_and_value(bench: Bench) -> None:
    good = slow_plan(bench)
    names, t, q, v, a = trajectory_from_msg(good)
    cases = []
    cases.append((["elbow", *names[1:]], q, "INVALID_ARGUMENT", "unknown elbow"))
    wrong = q.copy()
    wrong[3, 2] = np.nan
    cases.append((names, wrong, "INVALID_ARGUMENT", "openarm_right_joint3 at point 3 is nan"))
    wrong = q.copy()
    wrong[3, 3] = 4.0
    cases.append((names, wrong, "LIMITS", "openarm_right_joint4 at point 3 is 4.0000 rad"))
    for joints, positions, code, text in cases:
        message = trajectory_to_msg(joints, t, positions, v, a)
        result = bench.run(bench.execute_client, ExecuteTrajectory.Goal(arm="right", trajectory=message))
        assert (result.success, result.code) == (False, code)
        assert text in result.message
    assert not bench.robot.active


def test_cancel_holds(bench: Bench) -> None:
    handle, future = bench.start(bench.execute_client, ExecuteTrajectory.Goal(arm="right", trajectory=slow_plan(bench)))
    bench.ros.spin_until(lambda: "right" in bench.robot.active, 5.0, "the arm to start")
    bench.ros.result(handle.cancel_goal_async())
    answer = bench.ros.result(future)
    assert answer.status == 5  # canceled
    assert (answer.result.success, answer.result.code) == (False, "CANCELLED")
    assert bench.robot.cancelled == ["right"]
    assert "holds" in answer.result.message


def test_the_controllers_reason_is_passed_on(bench: Bench) -> None:
    def violate(result: FollowJointTrajectory.Result) -> None:
        result.error_code, result.error_string = Result.PATH_TOLERANCE_VIOLATED, "joint2 0.08 rad off the path"

    bench.robot.answer = violate
    result = bench.run(bench.move_client, named())
    assert (result.success, result.code) == (False, "EXECUTION_FAILED")
    assert "PATH_TOLERANCE_VIOLATED: joint2 0.08 rad off the path" in result.message
    bench.robot.accept = False
    result = bench.run(bench.move_client, named("left"))
    assert result.code == "EXECUTION_FAILED"
    assert "rejected" in result.message


def test_a71_a_controller_that_says_success_is_not_evidence(bench: Bench) -> None:
    bench.robot.stuck = {"openarm_right_joint2"}
    result = bench.run(bench.move_client, named())
    assert (result.success, result.code) == (False, "EXECUTION_FAILED")
    assert "openarm_right_joint2 ended" in result.message
    assert "rad from its goal" in result.message


def test_a_silent_robot_ends_a_motion_within_two_seconds(bench: Bench) -> None:
    _, future = bench.begin("right", slow_plan(bench))
    bench.robot.silent = True
    begin = time.monotonic()
    result = bench.ros.result(future).result
    assert time.monotonic() - begin < 2.0
    assert (result.success, result.code) == (False, "ROBOT_LOST")
    assert "no /joint_states" in result.message
    # and nothing new is begun
    bench.ros.spin_until(lambda: bench.node._states.age_s() > 0.6, 5.0)
    result = bench.run(bench.move_client, named("left"))
    assert result.code == "NOT_READY"
    assert "no fresh /joint_states" in result.message


def test_a_controller_that_vanishes_ends_a_motion_within_two_seconds(bench: Bench) -> None:
    _, future = bench.begin("right", slow_plan(bench))
    begin = time.monotonic()
    bench.robot.servers["right"].destroy()
    bench.robot.gone.add("right")
    result = bench.ros.result(future).result
    assert time.monotonic() - begin < 2.0
    assert (result.success, result.code) == (False, "ROBOT_LOST")


def test_b49_table_comes_from_the_scene_description() -> None:
    (table,) = table_boxes("empty")
    np.testing.assert_allclose(table.T[:3, 3], [0.46, 0.0, 0.38])
    np.testing.assert_allclose(table.size, [0.70, 1.20, 0.04])
    assert table_boxes("") == ()


def test_b50_obstacles_travel_with_the_request(bench: Bench) -> None:
    # no planning scene that could lack them: the same goal is refused with the box and planned without it
    arm = bench.node._arms["right"]
    goal = named("right", "official_home", plan_only=True)
    tip = arm.kinematics.fk([0, 0, 0, 1.5708, 0, 0, 0])
    goal.obstacles = [CollisionBox(id="box", pose=matrix_to_pose(tip), size=Vector3(x=0.05, y=0.05, z=0.05))]
    result = bench.run(bench.move_client, goal)
    assert result.code == "IN_COLLISION"
    assert "box" in result.message
    assert bench.run(bench.move_client, named("right", "official_home", plan_only=True)).success


class WaitingPlanner:
    """Searches until it is stopped."""

    def __init__(self) -> None:
        self.searching = threading.Event()

    def plan(self, query: PlanQuery) -> PlannedPath:
        self.searching.set()
        deadline = time.monotonic() + 20.0
        while not query.stopped():
            assert time.monotonic() < deadline, "nobody stopped the search"
            threading.Event().wait(0.01)
        raise OpenArmError(Code.CANCELLED, "planning was stopped")


def test_a_search_ends_by_cancel(bench: Bench) -> None:
    planner = bench.node._arms["right"]._planner = WaitingPlanner()
    for client, goal in ((bench.move_client, named()), (bench.plan_client, approach_goal())):
        planner.searching.clear()
        handle, future = bench.start(client, goal)
        bench.ros.spin_until(planner.searching.is_set, 5.0, "the search")
        bench.ros.result(handle.cancel_goal_async())
        answer = bench.ros.result(future)
        assert answer.status == 5  # canceled
        assert answer.result.code == "CANCELLED"


def test_a_search_ends_with_the_node(bench: Bench) -> None:
    planner = bench.node._arms["right"]._planner = WaitingPlanner()
    bench.start(bench.move_client, named())
    bench.ros.spin_until(planner.searching.is_set, 5.0, "the search")
    begin = time.monotonic()
    bench.node.close()
    assert time.monotonic() - begin < 1.0
