# SPDX-License-Identifier: Apache-2.0
"""The grasp node in process, between a robot, a planner and a detector that are fakes of this file.

The fakes speak the real interfaces. Robot time runs five times as fast as the wall clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Thread

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from control_msgs.action import ParallelGripperCommand
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, Pick, PlanApproach
from openarm_interfaces.msg import GraspStatus
from openarm_interfaces.srv import ComputeIK, Grasp
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.task import Future
from scipy.optimize import least_squares
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose
from visualization_msgs.msg import MarkerArray

from openarm_common import se3
from openarm_common.convert import matrix_to_pose, ns_to_stamp, pose_to_matrix, vector
from openarm_common.description import RobotDescription
from openarm_common.errors import Code, OpenArmError
from openarm_common.node import BASE_FRAME, QOS_COMMAND, QOS_LATCHED, reliable
from openarm_grasp.client import GraspClient
from openarm_grasp.node import GraspNode

ARMS = ("left", "right")
CUBE = 0.05
STEP_S, STEP_NS = 0.01, 50_000_000
OPEN = 0.044


class FakeGraph(Node):
    """Robot, planner and detector in one node, with objects on a table in the head.

    Attributes:
        objects: Position of the centre by label.
        log: What was asked of arms and hands, in order.
        during: Called at the start of a motion; may return a future that it waits for.
        slips: Closes that get nothing.
        silent: No joint states any more.
    """

    def __init__(self, *, motion: bool = True, detector: bool = True) -> None:
        super().__init__("fakes")
        self._group = ReentrantCallbackGroup()
        self._servers: list[ActionServer] = []
        self.robot = RobotDescription.load()
        self.t_ns = 5_000_000_000
        self.silent = False
        self.slips = 0
        self.unreachable = False
        self.during: Callable[[str], Future | None] = lambda what: None
        self.objects = {"red": np.array([0.26, -0.2, 0.425]), "blue": np.array([0.26, 0.2, 0.425])}
        self.held: str | None = None
        self.log: list[str] = []
        self.cancelled: list[str] = []
        self._waiting: Future | None = None
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
        for arm in ARMS:
            self._serve(ParallelGripperCommand, f"/{arm}_gripper_controller/gripper_cmd", self._grip)

    # --- robot
    def _publish_states(self) -> None:
        if self.silent:
            return
        self.t_ns += STEP_NS
        message = JointState(name=list(self.q), position=list(self.q.values()))
        message.header.stamp = ns_to_stamp(self.t_ns)
        message.effort = [self.efforts.get(name, 0.0) for name in self.q]
        message.velocity = [0.0] * len(self.q)
        self._states.publish(message)

    def _grip(self, goal) -> ParallelGripperCommand.Result:
        (joint,), (position,) = goal.request.command.name, goal.request.command.position
        self.log.append(f"gripper {position:g}")
        result = ParallelGripperCommand.Result(reached_goal=True)
        tcp = self.tcp("left" if "left" in joint else "right")
        near = [n for n, p in self.objects.items() if np.linalg.norm(tcp[:2] - p[:2]) < 0.02 and tcp[2] < 0.45]
        if position > 0.0:
            if self.held:
                self.objects[self.held] = np.array([*tcp[:2], 0.425])
            self.held = None
        elif near and not self.slips:
            self.held, position = near[0], CUBE / 2.0
            result.stalled, result.reached_goal = True, False
        else:
            self.slips = max(0, self.slips - 1)
        self.q[joint] = position
        self.efforts[joint] = -30.0 if self.held else 0.0
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
            goal.abort()
            return result
        target = request.targets[0]
        p = pose_to_matrix(target.pose)[:3, 3]
        end = p + np.array([target.retreat_offset.x, target.retreat_offset.y, target.retreat_offset.z])
        before = p + np.array([target.approach_offset.x, target.approach_offset.y, target.approach_offset.z])
        q = self._reach(request.arm, before)
        result.transfer = self._trajectory(request.arm, q)
        q = self._reach(request.arm, p, q)
        result.approach = self._trajectory(request.arm, q)
        result.retreat = self._trajectory(request.arm, self._reach(request.arm, end, q))
        result.success, result.code, result.chosen = True, "OK", 0
        goal.succeed()
        return result

    def _reach(self, arm: str, p: np.ndarray, q0: np.ndarray | None = None) -> np.ndarray:
        names = self.robot.arm_joints(arm)
        lower, upper = self.robot.limits(names)
        start = q0 if q0 is not None else np.array([self.q[n] for n in names])
        link = self.robot.tcp_link(arm)

        def error(q):
            return self.robot.link_pose(link, dict(zip(names, q, strict=True)))[:3, 3] - p

        return least_squares(error, np.clip(start, lower + 0.01, upper - 0.01), bounds=(lower, upper)).x

    def _trajectory(self, arm: str, q: np.ndarray) -> JointTrajectory:
        return JointTrajectory(
            joint_names=list(self.robot.arm_joints(arm)), points=[JointTrajectoryPoint(positions=q.tolist())]
        )

    async def _execute(self, goal) -> ExecuteTrajectory.Result:
        result = ExecuteTrajectory.Result()
        if await self._interrupted(goal, "execute"):
            result.code, result.message = "CANCELLED", "cancelled"
            return result
        trajectory = goal.request.trajectory
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
        if self.held:
            self.objects[self.held] = self.tcp(arm) + np.array([0.0, 0.0, 0.013])

    async def _interrupted(self, goal, what: str) -> bool:
        self.log.append(what)
        self._waiting = self.during(what)
        if self._waiting is not None:
            await self._waiting
        if goal.is_cancel_requested:
            self.cancelled.append(what)
            goal.canceled()
            return True
        return False

    def _ik(self, request, response):
        response.code = "UNREACHABLE"
        T = pose_to_matrix(request.pose.pose)
        T[0, 3] -= 0.25
        response.nearest = matrix_to_pose(T)
        return response

    # --- detector
    def _publish_detections(self) -> None:
        if not self._detections.get_subscription_count():
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

    def close(self) -> None:
        for server in self._servers:
            server.destroy()

    def _cancel(self, goal) -> CancelResponse:
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_result(None)
        return CancelResponse.ACCEPT


class Bench:
    """The node under test, the fakes, and what was heard."""

    def __init__(self, ros, **fakes: bool) -> None:
        self.ros = ros
        self.world: FakeGraph = ros.add(FakeGraph(**fakes))
        self.node: GraspNode = ros.add(GraspNode(parameter_overrides=[Parameter("limits.ready_timeout", value=5.0)]))
        self.status: list[GraspStatus] = []
        self.markers: list[MarkerArray] = []
        probe = ros.node
        latched = QoSProfile(depth=20, reliability=QOS_LATCHED.reliability, durability=QOS_LATCHED.durability)
        probe.create_subscription(GraspStatus, "/grasp/status", self.status.append, latched)
        probe.create_subscription(MarkerArray, "/grasp/markers", self.markers.append, QOS_LATCHED)
        self.service = probe.create_client(Grasp, "/grasp")
        self.action = ActionClient(probe, Pick, "/grasp/pick")

    def ask(self, label: str = "red", timeout: float = 30.0, **request) -> Grasp.Response:
        return self.ros.call(self.service, Grasp.Request(label=label, **request), timeout)

    def states(self) -> list[str]:
        return [s.state for s in self.status]

    def until(self, condition: Callable[[], object], timeout: float = 20.0, what: str = "") -> None:
        self.ros.spin_until(condition, timeout, what)


@pytest.fixture
def bench(ros) -> Bench:
    return Bench(ros)


def test_a_grasp_by_service_places_the_object_and_tells_its_states(bench):
    answer = bench.ask()
    assert answer.success, answer.message
    assert (answer.code, answer.label, answer.arm, answer.attempts) == ("OK", "red", "right", 1)
    target = answer.place_position
    assert bench.world.objects["red"][:2] == pytest.approx((target.x, target.y), abs=0.005)
    bench.until(lambda: bench.states()[-1] == "IDLE" and len(bench.status) > 5)
    seen = bench.states()
    order = [s for i, s in enumerate(seen) if i == 0 or s != seen[i - 1]]
    names = "IDLE DETECT TRANSFORM PLAN MOVE_TO_PREGRASP MOVE_TO_GRASP CLOSE_GRIPPER LIFT PLACE RESET IDLE"
    assert " ".join(order) == names
    assert all(s.reason for s in bench.status)
    stamps = [s.header.stamp.sec + s.header.stamp.nanosec * 1e-9 for s in bench.status[1:]]
    assert stamps == sorted(stamps)
    assert stamps[0] >= 5.0
    assert answer.duration == pytest.approx(stamps[-1] - stamps[0], abs=0.2)


def test_b51_b53_b71_order_of_hand_and_arm(bench):
    assert bench.ask().success
    log = [entry for entry in bench.world.log if not entry.startswith("plan")]
    assert sorted(log[:2]) == ["execute", "gripper 0.044"]  # at the same time
    assert log[2:] == [
        "execute",  # to the grasp
        "gripper 0",
        "execute",  # lift
        "execute",  # carry
        "execute",  # down
        "gripper 0.044",
        "execute",  # leave
        "move home",
    ]


def test_p01_the_action_gives_feedback_and_the_same_answer(bench):
    heard: list[str] = []
    goal = Pick.Goal(label="blue", has_place_position=True)
    goal.place_position.x, goal.place_position.y = 0.3, 0.3
    _, result = bench.ros.send_goal(
        bench.action, goal, feedback_callback=lambda m: heard.append(m.feedback.status.state)
    )
    answer = bench.ros.result(result, 30.0).result
    assert answer.success, answer.message
    assert answer.arm == "left"
    assert (answer.place_position.x, answer.place_position.y) == (0.3, 0.3)
    assert bench.world.objects["blue"][:2] == pytest.approx((0.3, 0.3), abs=0.005)
    assert {"DETECT", "PLAN", "LIFT", "PLACE"} <= set(heard)


def test_a71_an_empty_hand_is_tried_again_and_then_named(bench):
    bench.world.slips = 99
    answer = bench.ask()
    assert (answer.code, answer.attempts) == ("GRASP_MISSED", 3)
    assert "closed on nothing" in answer.message
    assert bench.world.q[bench.world.robot.finger_joint("right")] == OPEN
    assert bench.world.log[-1] == "move home"


def test_a70_a_slip_is_made_good_by_the_next_attempt(bench):
    bench.world.slips = 1
    answer = bench.ask()
    assert answer.success, answer.message
    assert answer.attempts == 2


def test_a_second_request_is_refused_at_once(bench):
    held_up = Future()
    bench.world.during = lambda what: held_up if what == "execute" else None
    first = bench.service.call_async(Grasp.Request(label="red"))
    bench.until(lambda: "execute" in bench.world.log, what="the arm moves")
    begin = time.monotonic()
    second = bench.ask("blue")
    assert time.monotonic() - begin < 0.5
    assert (second.success, second.code) == (False, "BUSY")
    _, result = bench.ros.send_goal(bench.action, Pick.Goal(label="blue"))
    assert bench.ros.result(result).result.code == "BUSY"
    held_up.set_result(None)
    assert bench.ros.result(first, 30.0).success


def test_an_unknown_object_is_refused_with_what_is_in_view(bench):
    answer = bench.ask("mug")
    assert (answer.code, answer.message) == ("UNKNOWN_OBJECT", "no 'mug' in view; in view: blue, red")
    assert not [entry for entry in bench.world.log if entry.startswith(("plan", "execute"))]


def test_out_of_reach_names_the_nearest_arm_distance(bench):
    bench.world.unreachable = True
    answer = bench.ask()
    assert answer.code == "UNREACHABLE"
    assert "right arm gets within 250 mm" in answer.message
    assert "too far" in answer.message
    assert "execute" not in bench.world.log


def test_an_unknown_arm_and_a_place_off_the_table_are_refused(bench):
    answer = bench.ask(arm="middle")
    assert answer.code == "INVALID_ARGUMENT"
    assert "auto, left, right" in answer.message
    request = Grasp.Request(label="red", has_place_position=True)
    request.place_position.x = 3.0
    answer = bench.ros.call(bench.service, request, 20.0)
    assert answer.code == "INVALID_ARGUMENT"
    assert "not on the table" in answer.message


def test_a_dry_run_moves_nothing(bench):
    answer = bench.ask(dry_run=True)
    assert answer.success, answer.message
    assert bench.world.log == ["plan right", "plan right"]
    bench.until(lambda: bench.markers, what="markers of the candidates")
    assert len(bench.markers[-1].markers) > 20


def test_p01_p21_a_cancel_stops_the_arm_and_keeps_the_hand_closed(bench):
    never = Future()
    bench.world.during = lambda what: never if bench.world.held else None
    handle, result = bench.ros.send_goal(bench.action, Pick.Goal(label="red"))
    bench.until(lambda: bench.world.held and bench.world.log[-1] == "execute", what="the lift")
    bench.ros.result(handle.cancel_goal_async())
    answer = bench.ros.result(result, 5.0)
    assert answer.status == GoalStatus.STATUS_CANCELED
    assert answer.result.code == "CANCELLED"
    assert bench.world.cancelled == ["execute"]
    assert bench.world.held == "red"
    assert bench.world.log[-1] == "execute"
    assert bench.world.log.count("gripper 0.044") == 1
    # The next grasp would drop what is held: refused until the hand is open.
    bench.world.during = lambda what: None
    refused = bench.ask()
    assert refused.code == "NOT_READY"
    assert "still holds" in refused.message


def test_a_robot_that_goes_silent_ends_the_grasp_within_two_seconds(bench):
    never = Future()
    bench.world.during = lambda what: never if what == "execute" else None
    asked = bench.service.call_async(Grasp.Request(label="red"))
    bench.until(lambda: "execute" in bench.world.log, what="the arm moves")
    bench.world.silent = True
    begin = time.monotonic()
    answer = bench.ros.result(asked, 5.0)
    assert answer.code == "ROBOT_LOST"
    assert time.monotonic() - begin < 2.0
    never.set_result(None)
    # And it works again when the robot is back.
    bench.world.silent, bench.world.during = False, lambda what: None
    assert bench.ask().success


def test_without_motion_or_detector_the_answer_names_what_is_missing(ros):
    bench = Bench(ros, motion=False, detector=False)
    answer = bench.ask()
    assert answer.code == "NOT_READY"
    assert "/motion/plan_approach (motion node)" in answer.message
    assert "/detections_3d (detector)" in answer.message
    assert "joint_states" not in answer.message


def test_b69_nothing_is_subscribed_while_idle_and_detections_only_while_looking(bench):
    probe = bench.ros.node
    assert probe.count_subscribers("/joint_states") == 0
    assert probe.count_subscribers("/detections_3d") == 0
    held_up = Future()
    bench.world.during = lambda what: held_up if what == "execute" else None
    asked = bench.service.call_async(Grasp.Request(label="red"))
    bench.until(lambda: "execute" in bench.world.log, what="the arm moves")
    bench.until(lambda: probe.count_subscribers("/detections_3d") == 0, what="detections are left")
    assert probe.count_subscribers("/joint_states") == 1
    held_up.set_result(None)
    assert bench.ros.result(asked, 30.0).success
    bench.until(lambda: probe.count_subscribers("/joint_states") == 0, what="joint states are left")
    assert probe.count_subscribers("/detections_3d") == 0


def test_b48_a_pregrasp_within_the_path_tolerance_is_refused_at_start(ros):
    wrong = [Parameter("approach.pregrasp_distance", value=0.05), Parameter("approach.path_tolerance", value=0.04)]
    with pytest.raises(OpenArmError, match="at least twice path_tolerance") as error:
        GraspNode(parameter_overrides=wrong)
    assert error.value.code is Code.CONFIG_INVALID


def test_the_client_picks_from_plain_python(bench):
    heard: list[str] = []
    results = []

    def script() -> None:
        with GraspClient() as grasp:
            results.append(grasp.pick("red", on_feedback=lambda status: heard.append(status.state)))
            results.append(grasp.pick("mug"))

    thread = Thread(target=script)
    thread.start()
    bench.until(lambda: not thread.is_alive(), 60.0, "the script ends")
    thread.join()
    assert results[0].success, results[0].message
    assert results[0].raise_for_code() is results[0]
    assert "LIFT" in heard
    assert results[1].code is Code.UNKNOWN_OBJECT
    with pytest.raises(OpenArmError, match="no 'mug' in view"):
        results[1].raise_for_code()


def test_p01_p02_the_client_picks_and_places_in_two_requests(bench):
    results = []

    def script() -> None:
        with GraspClient() as grasp:
            results.append(grasp.pick("red", phase="pick"))
            results.append(grasp.pick("blue"))
            results.append(grasp.pick("red", phase="place", place=(0.3, -0.3)))

    thread = Thread(target=script)
    thread.start()
    bench.until(lambda: not thread.is_alive(), 60.0, "the script ends")
    thread.join()
    picked, other, placed = results
    assert (picked.outcome, picked.code) == ("SUCCESS", Code.OK), picked.message
    assert (other.outcome, other.code) == ("REFUSED", Code.NOT_READY)
    assert "still holds 'red'" in other.message
    assert (placed.outcome, placed.label) == ("SUCCESS", "red"), placed.message
    assert bench.world.objects["red"][:2] == pytest.approx((0.3, -0.3), abs=0.005)


def test_the_client_can_cancel_from_its_feedback(bench):
    results = []

    def script() -> None:
        with GraspClient() as grasp:
            results.append(grasp.pick("red", on_feedback=lambda s: grasp.cancel() if s.state == "PLAN" else None))

    thread = Thread(target=script)
    thread.start()
    bench.until(lambda: not thread.is_alive(), 60.0, "the script ends")
    thread.join()
    assert results[0].code is Code.CANCELLED


def test_the_client_notices_that_the_node_is_gone(bench):
    bench.world.during = lambda what: Future()
    errors: list[OpenArmError] = []

    def script() -> None:
        with GraspClient() as grasp:
            try:
                grasp.pick("red")
            except OpenArmError as error:
                errors.append(error)

    thread = Thread(target=script)
    thread.start()
    bench.until(lambda: "execute" in bench.world.log, what="the arm moves")
    bench.ros.executor.remove_node(bench.node)
    bench.ros.nodes.remove(bench.node)
    bench.node.close()
    bench.node.destroy_node()
    bench.until(lambda: not thread.is_alive(), 20.0, "the script ends")
    thread.join()
    assert errors[0].code is Code.NOT_READY


def test_the_client_says_when_nobody_answers(ros):
    with GraspClient(timeout=0.2) as grasp, pytest.raises(OpenArmError, match="is the graph up") as error:
        grasp.pick("red")
    assert error.value.code is Code.NOT_READY
