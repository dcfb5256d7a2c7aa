# SPDX-License-Identifier: Apache-2.0
"""The grasp node in process, between a robot, a planner and a detector that are fakes of this file.

The fakes speak the real interfaces. Robot time runs ten times as fast as the wall clock.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

import numpy as np
import pytest
from control_msgs.action import ParallelGripperCommand
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, Pick, PickTwo, PlanApproach
from openarm_interfaces.msg import GraspStatus, Refusal
from openarm_interfaces.srv import ComputeIK, ConfirmPlan, GetScene, Grasp
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose
from visualization_msgs.msg import MarkerArray

from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import matrix_to_pose, ns_to_stamp, pose_to_matrix, vector
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, reliable
from openarm_grasp.ros.client import GraspClient
from openarm_grasp.ros.node import GraspNode
from openarm_motion.kinematics.chain import ArmKinematics

BASE_FRAME = RobotDescription.load().base

Result = TypeVar("Result")

ARMS = ("left", "right")
CUBE = 0.05
STEP_S, STEP_NS = 0.01, 100_000_000
OPEN = 0.044


class FakeGraph(Node):
    """Robot, planner and detector in one node, with objects on a table in the head.

    Attributes:
        objects: Position of the centre by label.
        hands: What each hand holds.
        log: What was asked of arms and hands, in order.
        asked: The same of motions alone: arm, what, and how long it may rest first.
        during: Called at the start of a motion; may return a future that it waits for.
        slips: Closes that get nothing.
        stops: Where fingers stop, closed and open, m.
        scene: Version of the planning scene.
        executed: Trajectories.
        goal_ids: Of motions.
        step_ns: By which robot time advances at each joint state.
        silent: No joint states any more.
        blind: No detections any more.
    """

    def __init__(self, *, motion: bool = True, detector: bool = True) -> None:
        super().__init__("fakes")
        self._group = ReentrantCallbackGroup()
        self._servers: list[ActionServer] = []
        self.robot = RobotDescription.load()
        self.kinematics = {arm: ArmKinematics(self.robot, self.robot.tcp_link(arm)) for arm in ARMS}
        self.t_ns, self.step_ns = 5_000_000_000, STEP_NS
        self.silent = self.blind = False
        self.slips, self.scene, self.stops = 0, 1, (0.0, OPEN)
        self.executed: list[JointTrajectory] = []
        self.unreachable = False
        self.during: Callable[[str], Future | None] = lambda what: None
        self.objects = {"red": np.array([0.26, -0.2, 0.425]), "blue": np.array([0.26, 0.2, 0.425])}
        self.hands: dict[str, str] = {}
        self.log: list[str] = []
        self.asked: list[tuple[str, str, float]] = []
        self.cancelled: list[str] = []
        self.goal_ids: list[bytes] = []
        self._waiting: dict[bytes, Future] = {}
        self.efforts: dict[str, float] = {}
        self.q: dict[str, float] = {}
        for arm in ARMS:
            self.q |= self.robot.group_state(f"{arm}_arm", "home")
            self.q[self.robot.finger_joint(arm)] = 0.0
        self._states = self.create_publisher(JointState, "/joint_states", QOS_COMMAND)
        self.create_timer(STEP_S, self._publish_states)
        if detector:
            self._detections = self.create_publisher(Detection3DArray, "/detections_3d", reliable(5))
            self.create_timer(0.02, self._publish_detections)
        if motion:
            self._serve(PlanApproach, "/motion/plan_approach", self._plan)
            self._serve(ExecuteTrajectory, "/motion/execute", self._execute)
            self._serve(MoveArm, "/motion/move", self._move)
            self.create_service(ComputeIK, "/motion/compute_ik", self._ik)
            self.create_service(GetScene, "/motion/get_scene", self._get_scene)
        for arm in ARMS:
            self._serve(ParallelGripperCommand, f"/{arm}_gripper_controller/gripper_cmd", self._grip)

    @property
    def held(self) -> str | None:
        """What one of the hands holds."""
        return next(iter(self.hands.values()), None)

    # --- robot
    def _publish_states(self) -> None:
        if self.silent:
            return
        self.t_ns += self.step_ns
        message = JointState(name=list(self.q), position=list(self.q.values()))
        message.header.stamp = ns_to_stamp(self.t_ns)
        message.effort = [self.efforts.get(name, 0.0) for name in self.q]
        message.velocity = [0.0] * len(self.q)
        self._states.publish(message)

    def _grip(self, goal) -> ParallelGripperCommand.Result:
        (joint,), (position,) = goal.request.command.name, goal.request.command.position
        self.log.append(f"gripper {position:g}")
        result = ParallelGripperCommand.Result(reached_goal=True)
        arm = "left" if "left" in joint else "right"
        tcp = self.tcp(arm)
        near = [n for n, p in self.objects.items() if np.linalg.norm(tcp[:2] - p[:2]) < 0.02 and tcp[2] < 0.45]
        if position > 0.0:
            if arm in self.hands:
                self.objects[self.hands.pop(arm)] = np.array([*tcp[:2], 0.425])
        elif near and not self.slips:
            self.hands[arm], position = near[0], CUBE / 2.0
            result.stalled, result.reached_goal = True, False
        else:
            self.slips = max(0, self.slips - 1)
        self.q[joint] = float(np.clip(position, *self.stops))
        self.efforts[joint] = -30.0 if arm in self.hands else 4000.0 * (position - self.q[joint])
        goal.succeed()
        return result

    def tcp(self, arm: str) -> np.ndarray:
        return self.robot.link_pose(self.robot.tcp_link(arm), self.q)[:3, 3]

    # --- planner
    def _plan(self, goal) -> PlanApproach.Result:
        request, result = goal.request, PlanApproach.Result(chosen=-1)
        self.log.append(f"plan {request.arm}")
        if self.unreachable:
            result.code, result.message = "UNREACHABLE", f"{request.arm} arm: too far"
            result.refusals = [
                Refusal(id=way.id, code="UNREACHABLE", message=f"{way.id}: too far for it") for way in request.targets
            ]
            goal.abort()
            return result
        target = request.targets[0]
        p = pose_to_matrix(target.pose)[:3, 3]
        end = p + np.array([target.retreat_offset.x, target.retreat_offset.y, target.retreat_offset.z])
        before = p + np.array([target.approach_offset.x, target.approach_offset.y, target.approach_offset.z])
        start = np.array(request.start or [self.q[n] for n in self.robot.arm_joints(request.arm)])
        q = self._reach(request.arm, before)
        down = self._reach(request.arm, p, q)
        q = down if request.blend_approach else q
        result.transfer = self._trajectory(request.arm, start, q)
        result.approach = self._trajectory(request.arm, q, down)
        result.retreat = self._trajectory(request.arm, down, self._reach(request.arm, end, down))
        result.scene_version = self.scene
        result.success, result.code, result.chosen = True, "OK", 0
        result.limit_margins = [0.25] + [math.nan] * (len(request.targets) - 1)
        goal.succeed()
        return result

    def _reach(self, arm: str, p: np.ndarray, q0: np.ndarray | None = None) -> np.ndarray:
        start = q0 if q0 is not None else [self.q[n] for n in self.robot.arm_joints(arm)]
        return self.kinematics[arm].ik(se3.make(p=p), start, position_only=True, restarts=0).q

    def _trajectory(self, arm: str, start: np.ndarray, end: np.ndarray) -> JointTrajectory:
        points = [JointTrajectoryPoint(positions=(start + u * (end - start)).tolist()) for u in (0.0, 0.5, 1.0)]
        for i, point in enumerate(points):
            point.time_from_start.sec = i
        return JointTrajectory(joint_names=list(self.robot.arm_joints(arm)), points=points)

    async def _execute(self, goal) -> ExecuteTrajectory.Result:
        result = ExecuteTrajectory.Result()
        if await self._interrupted(goal, "execute"):
            result.code, result.message = "CANCELLED", "cancelled"
            return result
        trajectory = goal.request.trajectory
        self.executed.append(trajectory)
        self.q |= dict(zip(trajectory.joint_names, trajectory.points[-1].positions, strict=True))
        self._carry(goal.request.arm)
        goal.succeed()
        result.success, result.code = True, "OK"
        return result

    async def _move(self, goal) -> MoveArm.Result:
        request, result = goal.request, MoveArm.Result()
        if await self._interrupted(goal, f"move {request.named or 'linear'}"):
            result.code, result.message = "CANCELLED", "cancelled"
            return result
        if request.kind == MoveArm.Goal.NAMED:
            self.q |= self.robot.group_state(f"{request.arm}_arm", request.named)
        else:
            q = self._reach(request.arm, pose_to_matrix(request.pose.pose)[:3, 3])
            self.q |= dict(zip(self.robot.arm_joints(request.arm), q.tolist(), strict=True))
        self._carry(request.arm)
        goal.succeed()
        result.success, result.code = True, "OK"
        return result

    def _carry(self, arm: str) -> None:
        if arm in self.hands:
            self.objects[self.hands[arm]] = self.tcp(arm) + np.array([0.0, 0.0, 0.013])

    async def _interrupted(self, goal, what: str) -> bool:
        self.log.append(what)
        self.goal_ids.append(bytes(goal.goal_id.uuid))
        self.asked.append((goal.request.arm, what, goal.request.max_start_delay))
        waiting = self.during(what)
        if waiting is not None:
            self._waiting[bytes(goal.goal_id.uuid)] = waiting
            await waiting
        if goal.is_cancel_requested:
            self.cancelled.append(what)
            goal.canceled()
            return True
        return False

    def _get_scene(self, _, response):
        response.version = self.scene
        return response

    def _ik(self, request, response):
        response.code = "UNREACHABLE"
        T = pose_to_matrix(request.pose.pose)
        T[0, 3] -= 0.25
        response.nearest = matrix_to_pose(T)
        return response

    # --- detector
    def _publish_detections(self) -> None:
        if self.blind or not self._detections.get_subscription_count():
            return
        message = Detection3DArray()
        message.header.frame_id = BASE_FRAME
        message.header.stamp = ns_to_stamp(self.t_ns)
        for label, p in self.objects.items():
            found = ObjectHypothesisWithPose()
            found.hypothesis.class_id, found.hypothesis.score = label, 0.9
            item = Detection3D(header=message.header, results=[found])
            # As the real one: what is lifted is a tall box.
            height = p[2] + CUBE / 2.0 - 0.4
            item.bbox.center = matrix_to_pose(se3.make(p=(p[0], p[1], 0.4 + height / 2.0)))
            item.bbox.size = vector((CUBE, CUBE, height))
            message.detections.append(item)
        self._detections.publish(message)

    def _serve(self, kind, name, execute) -> None:
        server = ActionServer(self, kind, name, execute, callback_group=self._group, cancel_callback=self._cancel)
        self._servers.append(server)

    def lose_hand(self, arm: str) -> None:
        """Let the controller of a hand be gone."""
        self._servers.pop(-1 if arm == ARMS[-1] else -2).destroy()

    def close(self) -> None:
        for server in self._servers:
            server.destroy()

    def _cancel(self, goal) -> CancelResponse:
        waiting = self._waiting.get(bytes(goal.goal_id.uuid))
        if waiting is not None and not waiting.done():
            waiting.set_result(None)
        return CancelResponse.ACCEPT


class Bench:
    """The node under test, the fakes, and what was heard."""

    def __init__(self, ros, *, learn: bool = False, **fakes: bool) -> None:
        self.ros = ros
        self.world: FakeGraph = ros.add(FakeGraph(**fakes))
        self.node: GraspNode = ros.start(GraspNode, limits__ready_timeout=60.0, hand__learn=learn)
        probe = ros.node
        latched = QoSProfile(depth=20, reliability=QOS_LATCHED.reliability, durability=QOS_LATCHED.durability)
        self.status: list[GraspStatus] = ros.hear(GraspStatus, "/grasp/status", latched)
        self.markers: list[MarkerArray] = ros.hear(MarkerArray, "/grasp/markers", QOS_LATCHED)
        self.service = probe.create_client(Grasp, "/grasp")
        self.confirm = probe.create_client(ConfirmPlan, "/grasp/confirm")
        self.action = ActionClient(probe, Pick, "/grasp/pick")
        self.two = ActionClient(probe, PickTwo, "/grasp/pick_two")
        ros.spin_until(lambda: self.status, what="the first status")

    def ask(self, label: str = "red", **request) -> Grasp.Response:
        return self.ros.call(self.service, Grasp.Request(label=label, **request), 60.0)

    def answer(self, plan_id: str, *, accept: bool) -> ConfirmPlan.Response:
        return self.ros.call(self.confirm, ConfirmPlan.Request(plan_id=plan_id, accept=accept))

    def states(self) -> list[str]:
        return [s.state for s in self.status]

    def until(self, condition: Callable[[], object], *, what: str = "") -> None:
        self.ros.spin_until(condition, 60.0, what)

    def in_thread(self, work: Callable[[], Result]) -> Result:
        """What blocks elsewhere, while the nodes are spun here."""
        with ThreadPoolExecutor(1) as worker:
            done = worker.submit(work)
            self.until(done.done, what="the thread ends")
            return done.result()

    def program(self, work: Callable[[GraspClient], Result]) -> Result:
        """What a program does with the client."""

        def run() -> Result:
            with GraspClient() as grasp:
                return work(grasp)

        return self.in_thread(run)


def silence(message: str) -> float:
    """How long the robot was silent, by the message of a failure, s; what the node itself was halted is left out."""
    return float(re.search(r"silent for ([\d.]+) s", message)[1])


@pytest.fixture
def benches(ros) -> Callable[..., Bench]:
    """Makes a bench; `motion=False` or `detector=False` leaves that node out."""
    return partial(Bench, ros)


@pytest.fixture
def bench(benches) -> Bench:
    """With everything."""
    return benches()
