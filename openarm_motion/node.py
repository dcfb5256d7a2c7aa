# SPDX-License-Identifier: Apache-2.0
"""The motion node: plans and executes motions of each arm.

Offers the actions /motion/plan_approach, /motion/move and /motion/execute, the service /motion/compute_ik, and latched
/motion/attached_objects: what each arm holds, as far as plans say so. Poses are in the base frame or any frame that
the description or /tf_static knows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, PlanApproach
from openarm_interfaces.srv import ComputeIK
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from openarm_common.cameras import load_cameras
from openarm_common.convert import matrix_to_pose, pose_to_matrix, trajectory_from_msg
from openarm_common.errors import Code, OpenArmError
from openarm_common.housings import with_housings
from openarm_common.node import BASE_FRAME, QOS_LATCHED, BaseNode, run
from openarm_common.scene import load_scene
from openarm_common.tf import RobotStateListener
from openarm_motion import convert, moves
from openarm_motion.approach import ApproachFailedError, ApproachPlan, plan_approach
from openarm_motion.arm import Arm, Situation
from openarm_motion.checks import check_against_others, check_trajectory
from openarm_motion.collision import Box, box_from
from openarm_motion.config import MotionConfig
from openarm_motion.executor import Follower, Watch, stale
from openarm_motion.memory import HeldMemory
from openarm_motion.trajectory import Trajectory

Array = NDArray[np.float64]
Result = TypeVar("Result")

#: Pace of feedback while planning, s.
_FEEDBACK = 0.1


class MotionNode(BaseNode[MotionConfig]):
    """Plans and executes motions of each arm."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("motion", MotionConfig, **kwargs)
        static = table_boxes(self.config.scene)
        self._states = RobotStateListener(self, self.description)
        robot = with_housings(self.description, load_cameras().values())
        self._arms = {name: Arm(name, robot, self.config, static) for name in self.config.arms}
        self._followers = {name: Follower(self, arm, self._states) for name, arm in self._arms.items()}
        self._claimed: set[str] = set()
        self._closing = False
        self._held = HeldMemory()
        self._attached = self.create_publisher(MarkerArray, "/motion/attached_objects", QOS_LATCHED)
        self._publish_held()
        self._servers = [
            self._serve(PlanApproach, "/motion/plan_approach", self._on_plan),
            self._serve(MoveArm, "/motion/move", self._on_move),
            self._serve(ExecuteTrajectory, "/motion/execute", self._on_execute),
        ]
        self.create_service(ComputeIK, "/motion/compute_ik", self._on_ik)
        self.create_timer(1.0, self._report, clock=self.wall_clock)
        for name, arm in self._arms.items():
            self.get_logger().info(f"{name} arm: {', '.join(arm.names)}; inverse kinematics: {arm.inverse.method}")

    def close(self) -> None:
        """Stop planning, then as every node."""
        self._closing = True
        while self._servers:
            self._servers.pop().destroy()
        super().close()

    # --- actions
    async def _on_plan(self, handle: ServerGoalHandle) -> PlanApproach.Result:
        goal: PlanApproach.Goal = handle.request
        begin = time.monotonic()
        feedback = PlanApproach.Feedback(stage="checking")

        def report(stage: str, tried: int) -> None:
            feedback.stage, feedback.tried = stage, tried

        timer = self.create_timer(_FEEDBACK, lambda: handle.publish_feedback(feedback), clock=self.wall_clock)
        result = PlanApproach.Result(chosen=-1)
        try:
            arm = self._arm(goal.arm)
            request = convert.request_from_msg(goal)
            if not len(goal.start):
                await self._fresh()
            now = self._situation(arm, goal.start, goal.velocity_scale, self._stopper(handle))
            plan: ApproachPlan = await self.in_thread(plan_approach, arm, now, request, report)
            result.success, result.code, result.message = True, Code.OK.value, "planned"
            result.chosen = plan.chosen
            result.transfer = convert.trajectory_msg(plan.transfer)
            result.approach = convert.trajectory_msg(plan.approach)
            result.retreat = convert.trajectory_msg(plan.retreat)
            result.refusals = convert.refusals_msg(plan.refusals)
            self._held.expect(goal.arm, (plan.transfer, plan.approach), request.attached)
            self._held.expect(goal.arm, (plan.retreat,), plan.held_after)
        except ApproachFailedError as error:
            result.code, result.message = error.code.value, error.message
            result.refusals = convert.refusals_msg(error.refusals)
        except OpenArmError as error:
            result.code, result.message = error.code.value, error.message
        finally:
            self.destroy_timer(timer)
        result.planning_time = time.monotonic() - begin
        return self._end(handle, result)

    async def _on_move(self, handle: ServerGoalHandle) -> MoveArm.Result:
        goal: MoveArm.Goal = handle.request
        begin = time.monotonic()
        result = MoveArm.Result()
        try:
            arm = self._arm(goal.arm)
            with self._claim(goal.arm, wanted=not goal.plan_only):
                handle.publish_feedback(MoveArm.Feedback(stage="planning"))
                await self._fresh()
                now = self._situation(arm, (), goal.velocity_scale, self._stopper(handle))
                around = moves.Around(convert.boxes_from_msg(goal.obstacles), convert.boxes_from_msg(goal.attached))
                trajectory: Trajectory = await self.in_thread(self._planner_of(arm, now, goal, around))
                result.trajectory = convert.trajectory_msg(trajectory)
                result.planning_time = time.monotonic() - begin
                result.message = f"planned, {trajectory.duration:.2f} s"
                if not goal.plan_only:
                    self._hold(goal.arm, tuple(around.attached))
                    await self._follow(handle, arm, result.trajectory, MoveArm.Feedback(stage="executing"))
                    result.message = "arrived"
            result.success, result.code = True, Code.OK.value
        except OpenArmError as error:
            result.code, result.message = error.code.value, error.message
        return self._end(handle, result)

    async def _on_execute(self, handle: ServerGoalHandle) -> ExecuteTrajectory.Result:
        goal: ExecuteTrajectory.Goal = handle.request
        result = ExecuteTrajectory.Result()
        try:
            arm = self._arm(goal.arm)
            with self._claim(goal.arm, wanted=True):
                await self._fresh()
                await self._follow(handle, arm, goal.trajectory, ExecuteTrajectory.Feedback())
            result.success, result.code, result.message = True, Code.OK.value, "arrived"
        except OpenArmError as error:
            result.code, result.message = error.code.value, error.message
        return self._end(handle, result)

    # --- service
    def _on_ik(self, request: ComputeIK.Request, response: ComputeIK.Response) -> ComputeIK.Response:
        try:
            arm = self._arm(request.arm)
            pose = self._pose(request.pose)
            now = self._situation(arm, request.seed, 0.0, lambda: False)
            best = arm.inverse.nearest(pose, now.start, position_only=request.free_orientation)
            response.joint_positions = best.q.tolist()
            response.position_error, response.orientation_error = best.position_error, best.orientation_error
            response.nearest = matrix_to_pose(arm.kinematics.fk(best.q))
            if not best.success:
                raise moves.unreachable(arm, pose, free_orientation=request.free_orientation, margin=0.0)
            response.success, response.code, response.message = True, Code.OK.value, "solved"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        return response

    # --- parts of these
    async def _follow(self, handle: ServerGoalHandle, arm: Arm, message: JointTrajectory, feedback: Any) -> None:
        names, t, q, v, _ = trajectory_from_msg(message)
        stamp_ns, state = self._states.buffer.latest()
        motion = check_trajectory(arm, names, t, q, v, state)
        others = [f.running.rest(stamp_ns) for f in self._followers.values() if f.running is not None]
        check_against_others(arm, motion, state, others)
        held = self._held.expected(arm.name, motion)
        if held is not None:
            self._hold(arm.name, held)

        def progress(value: float) -> None:
            feedback.progress = value
            handle.publish_feedback(feedback)

        await self._followers[arm.name].follow(message, motion, self._stopper(handle), progress)

    def _planner_of(
        self, arm: Arm, now: Situation, goal: MoveArm.Goal, around: moves.Around
    ) -> Callable[[], Trajectory]:
        """The plan that a goal asks for, to be made in a thread; poses are looked up here, in the executor's thread."""
        if goal.kind == MoveArm.Goal.JOINTS:
            return lambda: moves.to_joints(arm, now, goal.joint_positions, around)
        if goal.kind == MoveArm.Goal.NAMED:
            return lambda: moves.to_named(arm, now, goal.named, around)
        if goal.kind == MoveArm.Goal.POSE:
            pose = self._pose(goal.pose)
            return lambda: moves.to_pose(arm, now, pose, around, free_orientation=goal.free_orientation)
        if goal.kind == MoveArm.Goal.LINEAR:
            pose = self._pose(goal.pose)
            return lambda: moves.to_pose_on_line(arm, now, pose, around)
        raise OpenArmError(Code.INVALID_ARGUMENT, f"kind is {goal.kind}; valid: JOINTS 0, POSE 1, LINEAR 2, NAMED 3")

    def _situation(self, arm: Arm, start: Sequence[float], scale: float, stopped: Callable[[], bool]) -> Situation:
        """The robot as it is now; a given start is enough where the joint states are missing."""
        state: dict[str, float] = {}
        age = self._states.age_s()
        if age <= self.config.execution.stale_after:
            state = self._states.buffer.latest()[1]
        elif len(start) == 0:
            raise stale(age)
        return arm.situation(state, start, scale, stopped)

    async def _fresh(self) -> None:
        """Wait a moment for a fresh joint state; see `Watch.fresh`."""
        if self._states.age_s() <= self.config.execution.stale_after:
            return
        watch = Watch(self, self._states)
        try:
            await watch.fresh()
        finally:
            watch.close()

    def _pose(self, message: PoseStamped) -> Array:
        """`T_base_pose` (4, 4) of a pose in any known frame."""
        T_frame_pose = pose_to_matrix(message.pose)
        frame = message.header.frame_id
        if frame in ("", BASE_FRAME):
            return T_frame_pose
        buffer = self._states.buffer
        stamp_ns = buffer.latest()[0] if self._states.age_s() < float("inf") else 0
        return buffer.lookup(self.description.root, frame, stamp_ns) @ T_frame_pose

    def _arm(self, name: str) -> Arm:
        if name not in self._arms:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"arm is {name!r}; arms: {', '.join(self._arms)}")
        return self._arms[name]

    def _claim(self, name: str, *, wanted: bool) -> _Claim:
        if wanted and name in self._claimed:
            raise OpenArmError(Code.BUSY, f"the {name} arm is moving already; wait for the end, or cancel it first")
        return _Claim(self._claimed, name if wanted else None)

    def _stopper(self, handle: ServerGoalHandle) -> Callable[[], bool]:
        return lambda: self._closing or handle.is_cancel_requested

    def _hold(self, name: str, boxes: tuple[Box, ...]) -> None:
        if self._held.hold(name, boxes):
            self._publish_held()

    def _publish_held(self) -> None:
        held = {name: (self._arms[name].kinematics.tool_link, boxes) for name, boxes in self._held.held.items()}
        self._attached.publish(convert.markers_msg(held))

    def _serve(self, kind: Any, name: str, execute: Callable[[ServerGoalHandle], Any]) -> ActionServer:
        return ActionServer(self, kind, name, execute, cancel_callback=lambda _: CancelResponse.ACCEPT)

    @staticmethod
    def _end(handle: ServerGoalHandle, result: Result) -> Result:
        """Set the goal's status by the result's code."""
        code = getattr(result, "code", "")
        if code == Code.OK:
            handle.succeed()
        elif code == Code.CANCELLED and handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()
        return result

    def _report(self) -> None:
        age = self._states.age_s()
        fresh = age <= self.config.execution.stale_after
        moving = [name for name, follower in self._followers.items() if follower.running is not None]
        message = "ready" if fresh else "no fresh /joint_states"
        self.diagnose(fresh, message, joint_state_age_s=round(age, 2), moving=", ".join(moving) or "none")


class _Claim:
    """An arm is taken while this is open."""

    def __init__(self, claimed: set[str], name: str | None) -> None:
        self._claimed, self._name = claimed, name

    def __enter__(self) -> None:
        if self._name is not None:
            self._claimed.add(self._name)

    def __exit__(self, *_: object) -> None:
        if self._name is not None:
            self._claimed.discard(self._name)


def table_boxes(scene: str) -> tuple[Box, ...]:
    """The table top of a scene as an obstacle; none for an empty name.

    Raises:
        OpenArmError: SCENE_INVALID, from the scene.
    """
    if not scene:
        return ()
    table = load_scene(scene).table
    x, y = table.centre
    return (box_from("table", (x, y, table.top_z - 0.5 * table.thickness), table.extents),)


def main() -> None:
    """Run the node."""
    run(MotionNode)


if __name__ == "__main__":
    main()
