# SPDX-License-Identifier: Apache-2.0
"""A fake robot for the motion node: joint states and two FollowJointTrajectory controllers in the same process."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from control_msgs.action import FollowJointTrajectory
from geometry_msgs.msg import PoseStamped
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, MoveArms, PlanApproach
from openarm_interfaces.srv import ApplyScene, ComputeIK, GetScene
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.action.client import ClientGoalHandle
from rclpy.duration import Duration
from rclpy.task import Future
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common import se3
from openarm_common.config import Config
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import (
    matrix_to_pose,
    matrix_to_transform,
    ns_to_stamp,
    stamp_to_ns,
    trajectory_from_msg,
)
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_STATIC_TF, BaseNode
from openarm_motion.planning.dual_arm import DualArm
from openarm_motion.ros.node import MotionNode
from tests.conftest import own_domain

Result = FollowJointTrajectory.Result
HZ = 100
#: The fake robot's time runs this much faster than the wall clock; and while something is planned or disturbed on its
#: way, where a slow machine must be in time, too.
FASTER, SLOWER = 4.0, 0.05


class FakeRobot:
    """Publishes joint states, and follows trajectories exactly, in a time of its own."""

    def __init__(self, node, description: RobotDescription, state: dict[str, float]) -> None:
        self.node, self.state = node, dict(state)
        self.t_ns = 1_000_000_000
        #: Seconds of its time per second of the wall clock.
        self.speed = FASTER
        self.silent = False
        self.answer: Callable[[FollowJointTrajectory.Result], None] = lambda result: None
        self.stuck: set[str] = set()
        #: Joints that stay this far from where they should be, rad.
        self.sag: dict[str, float] = {}
        self.accept = True
        self.cancelled: list[str] = []
        self.ignore_regions: set[str] = set()
        #: Sides whose controller gives up after so many seconds of a motion.
        self.fail_after: dict[str, float] = {}
        #: Whether feedback says how far along its trajectory an arm is.
        self.tells = True
        self.active: dict[str, tuple[int, list[str], np.ndarray, np.ndarray]] = {}
        self._wake = Future()
        self.goal_ids: list[bytes] = []
        #: Goal tolerances of what was sent, rad; of one kind, or the controller's own.
        self.tolerances: list[set[float]] = []
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
        self.t_ns += round(self.speed * 10_000_000)
        for start_ns, names, t, q in self.active.values():
            now = (self.t_ns - start_ns) * 1e-9
            for i, name in enumerate(names):
                if name not in self.stuck:
                    self.state[name] = float(np.interp(now, t, q[:, i])) + self.sag.get(name, 0.0)
        if not self.silent:
            message = JointState(name=list(self.state), position=list(self.state.values()))
            message.header.stamp = ns_to_stamp(self.t_ns)
            self._publisher.publish(message)
        wake, self._wake = self._wake, Future()
        wake.set_result(None)

    def _progress(self, elapsed_ns: int) -> FollowJointTrajectory.Feedback:
        feedback = FollowJointTrajectory.Feedback()
        feedback.header.stamp = ns_to_stamp(self.t_ns)
        feedback.desired.time_from_start = Duration(nanoseconds=elapsed_ns).to_msg()
        return feedback

    async def _execute(self, side: str, handle) -> FollowJointTrajectory.Result:
        self.goal_ids.append(bytes(handle.goal_id.uuid))
        self.tolerances.append({joint.position for joint in handle.request.goal_tolerance})
        names, t, q, _, _ = trajectory_from_msg(handle.request.trajectory)
        begin_ns = stamp_to_ns(handle.request.trajectory.header.stamp) or self.t_ns
        self.active[side] = (begin_ns, names, t, q)
        result = FollowJointTrajectory.Result(error_code=Result.SUCCESSFUL)
        end_ns = begin_ns + int(t[-1] * 1e9)
        fail_ns = begin_ns + int(self.fail_after.get(side, 1e6) * 1e9)
        told = False
        while self.t_ns < min(end_ns, fail_ns) and side not in self.ignore_regions and not handle.is_cancel_requested:
            await self._wake
            if self.tells and not told and self.t_ns > begin_ns:
                told = True
                handle.publish_feedback(self._progress(self.t_ns - begin_ns))
        self.active.pop(side)
        if side in self.ignore_regions:
            return result
        if handle.is_cancel_requested:
            self.cancelled.append(side)
            handle.canceled()
            result.error_code, result.error_string = Result.INVALID_GOAL, "cancelled"
            return result
        if self.t_ns >= fail_ns:
            result.error_code, result.error_string = Result.PATH_TOLERANCE_VIOLATED, "off the path"
        self.answer(result)
        handle.succeed() if result.error_code == Result.SUCCESSFUL else handle.abort()
        return result


class Bench:
    """A motion node, a fake robot, and clients."""

    #: Rotation of a tool that looks down, its opening along y.
    DOWN = se3.rotation_from_z_y((0, 0, -1), (0, 1, 0))

    def __init__(self, ros, description: RobotDescription, *, motion: bool = True, **parameters) -> None:
        self.ros, self.description = ros, description
        home = {**description.group_state("left_arm", "home"), **description.group_state("right_arm", "home")}
        fingers = {description.finger_joint("left"): 0.0, description.finger_joint("right"): 0.0}
        # a coroutine of the robot must not keep its own timer from running
        self.robot = FakeRobot(ros.add(RobotNode()), description, {**home, **fingers})
        self.plan_client = ActionClient(ros.node, PlanApproach, "/motion/plan_approach")
        self.move_client = ActionClient(ros.node, MoveArm, "/motion/move")
        self.execute_client = ActionClient(ros.node, ExecuteTrajectory, "/motion/execute")
        self.both_client = ActionClient(ros.node, MoveArms, "/motion/move_arms")
        self.apply_client = ros.node.create_client(ApplyScene, "/motion/apply_scene")
        self.get_client = ros.node.create_client(GetScene, "/motion/get_scene")
        self.ik_client = ros.node.create_client(ComputeIK, "/motion/compute_ik")
        self.markers: list[MarkerArray] = ros.hear(MarkerArray, "/motion/attached_objects", QOS_LATCHED)
        if motion:
            self._add_motion(ros.start(MotionNode, **parameters))

    def _add_motion(self, node: MotionNode) -> None:
        self.node, ros = node, self.ros
        ros.spin_until(lambda: node.robot.state_age() < 0.5, what="joint states")
        ros.spin_until(lambda: "table" in node.robot.states._static, what="the table's frame")
        for arm in node.service.arms:
            ros.spin_until(node.robot.controller(arm).ready, what="controllers")

    def start(self, client: ActionClient, goal, **kwargs) -> tuple[ClientGoalHandle, Future]:
        handle, future = self.ros.send_goal(client, goal, **kwargs)
        assert handle.accepted
        return handle, future

    def run(self, client: ActionClient, goal, **kwargs):
        """Send a goal and return its result."""
        _, future = self.start(client, goal, **kwargs)
        return self.ros.result(future).result

    def done(self, client: ActionClient, goal):
        """Send a goal that must succeed, and return its result."""
        result = self.run(client, goal)
        assert result.success, result.message
        return result

    def refused(self, client: ActionClient, goal, code: str, text: str = "") -> str:
        """Send a goal that must fail with a code and a text, and return the message."""
        result = self.run(client, goal)
        assert (result.success, result.code) == (False, code), result.message
        assert text in result.message
        return result.message

    def begin(self, side: str, trajectory: JointTrajectory) -> tuple[ClientGoalHandle, Future]:
        """Send a trajectory and wait until the arm is on its way."""
        goal = ExecuteTrajectory.Goal(arm=side, trajectory=trajectory)
        handle, future = self.start(self.execute_client, goal)
        self.under_way(side)
        assert not future.done(), future.result()
        self.robot.speed = SLOWER
        return handle, future

    def under_way(self, side: str) -> None:
        """Wait until a controller has a trajectory."""
        self.ros.spin_until(lambda: side in self.robot.active, what=f"the {side} arm to be commanded")

    @staticmethod
    def stamped(T: np.ndarray, frame: str = "") -> PoseStamped:
        """A pose message."""
        pose = PoseStamped(pose=matrix_to_pose(T))
        pose.header.frame_id = frame
        return pose

    @staticmethod
    def named(arm: str = "right", posture: str = "official_home", **kwargs) -> MoveArm.Goal:
        """A goal to a posture at full speed."""
        return MoveArm.Goal(arm=arm, kind=MoveArm.Goal.NAMED, named=posture, velocity_scale=1.0, **kwargs)

    def slow_plan(self, side: str = "right") -> JointTrajectory:
        """A motion that takes long enough to be disturbed."""
        return slower(self.run(self.move_client, self.named(side, plan_only=True)).trajectory)

    def separation(self, *futures: Future) -> float:
        """Wait for results; the least distance of the arms in the states meanwhile, m."""
        both = DualArm(*(self.node.service.arms[side] for side in ("left", "right")))
        seen: list[dict[str, float]] = []
        ended = lambda: seen.append(dict(self.robot.state)) or all(future.done() for future in futures)  # noqa: E731
        self.ros.spin_until(ended, what="both arms")
        scene = both.scene(seen[0])
        return min(scene.separation(q) for q in np.unique([[s[name] for name in both.names] for s in seen], axis=0))

    def q(self, side: str) -> np.ndarray:
        return np.array([self.robot.state[name] for name in self.description.arm_joints(side)])

    def held(self) -> list[str]:
        """Ids of what the latest marker array shows as held."""
        if not self.markers:
            return []
        return [marker.ns for marker in self.markers[-1].markers if marker.action == Marker.ADD]


def slower(trajectory: JointTrajectory, factor: int = 8) -> JointTrajectory:
    """Stretch a trajectory in time."""
    for point in trajectory.points:
        ns = factor * (point.time_from_start.sec * 10**9 + point.time_from_start.nanosec)
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(ns, 10**9)
        point.velocities = [v / factor for v in point.velocities]
        point.accelerations = [a / factor**2 for a in point.accelerations]
    return trajectory


class RobotNode(BaseNode):
    """A node whose callbacks overlap, as the bridge's do."""

    def __init__(self) -> None:
        super().__init__("fake_robot", Config)


@pytest.fixture
def ros_domain() -> Iterator[int]:
    """A domain for each test: clients and servers of actions stay in their participant, and each slows discovery."""
    with own_domain() as domain:
        yield domain


@pytest.fixture
def make_bench(ros, description: RobotDescription) -> Callable[..., Bench]:
    """Makes the motion node and its robot; keyword arguments are the node's parameters."""
    return functools.partial(Bench, ros, description)


@pytest.fixture
def bench(make_bench) -> Bench:
    return make_bench()


@pytest.fixture
def moveit_bench(make_bench) -> Bench:
    """With the nodes that answer clients of MoveIt."""
    return make_bench(move_group__enabled=True, servo__enabled=True)
