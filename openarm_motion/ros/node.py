# SPDX-License-Identifier: Apache-2.0
"""The motion node: plans and executes motions of each arm, and of both at once.

Offers the actions /motion/plan_approach, /motion/move, /motion/move_arms and /motion/execute, the service
/motion/compute_ik, the planning scene (`scene_executor`), and latched /motion/attached_objects: what each arm holds, as
far as plans say so. Poses are in the base frame or any frame that the description or /tf_static knows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, MoveArms, PlanApproach
from openarm_interfaces.srv import ComputeIK
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from trajectory_msgs.msg import JointTrajectory

from openarm_common.camera.cameras import load_cameras
from openarm_common.camera.housings import with_housings
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import matrix_to_pose
from openarm_common.ros.node import BaseNode, run
from openarm_common.ros.tf import RobotStateListener
from openarm_motion.config import MotionConfig
from openarm_motion.planning import moves
from openarm_motion.planning.alternative import explained, explained_approach, near_joints, near_pose
from openarm_motion.planning.approach import ApproachFailedError, ApproachPlan, plan_approach
from openarm_motion.planning.arm import Arm, Situation
from openarm_motion.planning.goals import posture
from openarm_motion.ros import convert
from openarm_motion.ros.both_executor import BothExecutor
from openarm_motion.ros.course_executor import CourseExecutor
from openarm_motion.ros.follower import Follower, Robot, Watch
from openarm_motion.ros.preview_publisher import PreviewPublisher
from openarm_motion.ros.scene_server import SceneExecutor, table_boxes
from openarm_motion.ros.situation import Situations
from openarm_motion.scene.memory import HeldMemory
from openarm_motion.scene.planning_scene import PlanningScene
from openarm_motion.timing.trajectory import Trajectory

Result = TypeVar("Result")

#: Pace of feedback while planning, s.
_FEEDBACK = 0.1
#: Arms that move have this long to come to rest when the process is to end, s.
_HOLD = 1.8


class MotionNode(BaseNode[MotionConfig]):
    """Plans and executes motions of each arm."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("motion", MotionConfig, **kwargs)
        scene = PlanningScene(table_boxes(self.config.scene))
        self._states = RobotStateListener(self, self.description)
        body = with_housings(self.description, load_cameras().values())
        self._arms = {name: Arm(name, body, self.config, scene.fixed) for name in self.config.arms}
        self._followers = {name: Follower(self, arm, self._states) for name, arm in self._arms.items()}
        self._claimed: set[str] = set()
        self._closing = False
        self._held = HeldMemory()
        self._preview = PreviewPublisher(self, self._arms)
        robot = Robot(self, self._states, self._arms, self._followers, self._held)
        self._courses = CourseExecutor(robot)
        self._situations = Situations(robot, scene)
        self._scene = SceneExecutor(self, scene, self._situations)
        self._both = BothExecutor(robot, self._situations)
        self._servers = [
            self._serve(PlanApproach, "/motion/plan_approach", self._on_plan),
            self._serve(MoveArm, "/motion/move", self._on_move),
            self._serve(MoveArms, "/motion/move_arms", self._on_move_both),
            self._serve(ExecuteTrajectory, "/motion/execute", self._on_execute),
        ]
        self.create_service(ComputeIK, "/motion/compute_ik", self._on_ik)
        self.create_timer(1.0, self._report, clock=self.steady_clock)
        for arm in self._arms.values():
            self.get_logger().info(f"{arm.name} arm: {', '.join(arm.names)}; inverse kinematics: {arm.inverse.method}")

    async def hold(self) -> None:
        """End all plans and motions; the arms hold where they are."""
        self._closing = True
        watch = Watch(self, self._states)
        try:
            await watch.until(lambda: not any(f.running for f in self._followers.values()), lambda: None, _HOLD)
        finally:
            watch.close()

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

        timer = self.create_timer(_FEEDBACK, lambda: handle.publish_feedback(feedback), clock=self.steady_clock)
        result = PlanApproach.Result(chosen=-1)
        try:
            arm, stopped = self._arm(goal.arm), self._stopper(handle)
            request = convert.request_from_msg(goal)
            if not len(goal.start):
                await self._situations.fresh()
            prepared = self._situations.prepare(
                arm,
                goal.start,
                goal.velocity_scale,
                stopped,
                (*request.obstacles, *convert.boxes_from_msg(goal.gone)),
                request.attached,
                goal.expected_scene_version,
            )
            result.scene_version = prepared.version

            def work() -> ApproachPlan:
                now = prepared.complete()
                return explained_approach(lambda: plan_approach(arm, now, request, report), arm, now, request)

            plan: ApproachPlan = await self.in_thread(work)
            result.wait = await self._courses.wait_for(arm, plan.transfer, request.attached, stopped)
            result.success, result.code, result.message = True, Code.OK.value, f"planned{prepared.note}"
            result.chosen = plan.chosen
            result.transfer = convert.trajectory_msg(plan.transfer)
            result.approach = convert.trajectory_msg(plan.approach)
            result.retreat = convert.trajectory_msg(plan.retreat)
            result.refusals = convert.refusals_msg(plan.refusals)
            result.limit_margins = list(plan.limit_margins)
            self._preview.show({goal.arm: (plan.transfer, plan.approach, plan.retreat)})
            self._held.expect(goal.arm, (plan.transfer, plan.approach), request.attached)
            self._held.expect(goal.arm, (plan.retreat,), plan.held_after)
        except ApproachFailedError as error:
            result.code, result.message = error.code.value, error.message
            result.refusals = convert.refusals_msg(error.refusals)
            result.failure = convert.failure_msg(error)
        except OpenArmError as error:
            result.code, result.message = error.code.value, error.message
            result.failure = convert.failure_msg(error)
        finally:
            self.destroy_timer(timer)
        result.planning_time = time.monotonic() - begin
        return self._end(handle, result)

    async def _on_move(self, handle: ServerGoalHandle) -> MoveArm.Result:
        goal: MoveArm.Goal = handle.request
        begin = time.monotonic()
        result, holding = MoveArm.Result(), ""
        try:
            arm = self._arm(goal.arm)
            with self._claim(goal.arm, wanted=not goal.plan_only):
                handle.publish_feedback(MoveArm.Feedback(stage="planning"))
                held, holding = self._held.on_request(goal.arm, convert.boxes_from_msg(goal.attached), goal.hand_empty)
                around = moves.Around(convert.boxes_from_msg(goal.obstacles), held)
                await self._situations.fresh()
                prepared = self._situations.prepare(
                    arm,
                    (),
                    goal.velocity_scale,
                    self._stopper(handle),
                    [*around.obstacles],
                    [*around.attached],
                    goal.expected_scene_version,
                )
                result.scene_version = prepared.version
                planner = self._planner_of(arm, goal, around)
                trajectory: Trajectory = await self.in_thread(lambda: planner(prepared.complete()))
                result.trajectory = convert.trajectory_msg(trajectory)
                result.planning_time = time.monotonic() - begin
                result.message = f"planned, {trajectory.duration:.2f} s{prepared.note}{holding}"
                self._preview.show({goal.arm: (trajectory,)})
                if not goal.plan_only:
                    self._situations.unchanged(prepared.version)
                    self._courses.hold(goal.arm, held)
                    feedback = MoveArm.Feedback(stage="executing")
                    result.waited = await self._follow(handle, arm, result.trajectory, feedback, goal.max_wait)
                    result.message = f"arrived{prepared.note}{holding}"
            result.success, result.code = True, Code.OK.value
        except OpenArmError as error:
            result.code, result.message = error.code.value, error.message + holding
            result.failure = convert.failure_msg(error)
        return self._end(handle, result)

    async def _on_move_both(self, handle: ServerGoalHandle) -> MoveArms.Result:
        goal: MoveArms.Goal = handle.request
        result = MoveArms.Result()
        try:
            arms = self._both.arms_of(goal)
            names = [arm.name for arm in arms]
            with self._claim(*names, wanted=not goal.plan_only):
                handle.publish_feedback(MoveArms.Feedback(stage="planning"))
                plan, held = await self._both.plan(goal, result, self._stopper(handle))
                self._preview.show({name: (part,) for name, part in zip(names, plan.trajectories, strict=True)})
                if not goal.plan_only:
                    self._situations.unchanged(result.scene_version)
                    for name, boxes in zip(names, held, strict=True):
                        self._courses.hold(name, boxes)
                    await self._both.follow(handle, arms, result.trajectories, self._stopper(handle))
                    result.message = f"arrived, {plan.separation * 1e3:.0f} mm apart on the way"
            result.success, result.code = True, Code.OK.value
        except OpenArmError as error:
            result.code, result.message = error.code.value, error.message
            result.failure = convert.failure_msg(error)
        return self._end(handle, result)

    async def _on_execute(self, handle: ServerGoalHandle) -> ExecuteTrajectory.Result:
        goal: ExecuteTrajectory.Goal = handle.request
        result = ExecuteTrajectory.Result()
        try:
            arm = self._arm(goal.arm)
            self._situations.unchanged(goal.scene_version)
            with self._claim(goal.arm, wanted=True):
                await self._situations.fresh()
                feedback = ExecuteTrajectory.Feedback()
                result.waited = await self._follow(handle, arm, goal.trajectory, feedback, goal.max_wait)
            result.success, result.code, result.message = True, Code.OK.value, "arrived"
        except OpenArmError as error:
            result.code, result.message = error.code.value, error.message
        return self._end(handle, result)

    # --- service
    def _on_ik(self, request: ComputeIK.Request, response: ComputeIK.Response) -> ComputeIK.Response:
        try:
            arm = self._arm(request.arm)
            pose = self._situations.pose(request.pose)
            now = self._situations.situation(arm, request.seed, 0.0, lambda: False)
            best = arm.inverse.nearest(pose, now.start, position_only=request.free_orientation)
            response.joint_positions = best.q.tolist()
            response.position_error, response.orientation_error = best.position_error, best.orientation_error
            response.nearest = matrix_to_pose(arm.kinematics.fk(best.q))
            if not best.success:
                free = request.free_orientation
                raise moves.unreachable(arm, pose, free_orientation=free, margin=0.0, near=now.start)
            response.success, response.code, response.message = True, Code.OK.value, "solved"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        return response

    # --- parts of these
    async def _follow(
        self, handle: ServerGoalHandle, arm: Arm, message: JointTrajectory, feedback: Any, max_wait: float
    ) -> float:
        def progress(value: float) -> None:
            feedback.progress = value
            handle.publish_feedback(feedback)

        return await self._courses.follow(arm, message, self._stopper(handle), progress, max_wait)

    def _planner_of(self, arm: Arm, goal: MoveArm.Goal, around: moves.Around) -> Callable[[Situation], Trajectory]:
        """The plan that a goal asks for, to be made in a thread; poses are looked up here, in the executor's thread."""
        if goal.kind == MoveArm.Goal.JOINTS:
            return lambda now: explained(
                lambda: moves.to_joints(arm, now, goal.joint_positions, around),
                lambda: near_joints(arm, now, around, np.array(goal.joint_positions)),
            )
        if goal.kind == MoveArm.Goal.NAMED:
            return lambda now: explained(
                lambda: moves.to_named(arm, now, goal.named, around),
                lambda: near_joints(arm, now, around, posture(arm, goal.named, now.start)),
            )
        pose = self._situations.pose(goal.pose)
        free = goal.free_orientation
        if goal.kind == MoveArm.Goal.POSE:
            return lambda now: explained(
                lambda: moves.to_pose(arm, now, pose, around, free_orientation=free),
                lambda: near_pose(arm, now, around, pose, free_orientation=free),
            )
        if goal.kind == MoveArm.Goal.LINEAR:
            return lambda now: moves.to_pose_on_line(arm, now, pose, around)
        raise OpenArmError(Code.INVALID_ARGUMENT, f"kind is {goal.kind}; valid: JOINTS 0, POSE 1, LINEAR 2, NAMED 3")

    def _arm(self, name: str) -> Arm:
        if name not in self._arms:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"arm is {name!r}; arms: {', '.join(self._arms)}")
        return self._arms[name]

    def _claim(self, *names: str, wanted: bool) -> _Claim:
        taken = [name for name in names if name in self._claimed]
        if wanted and taken:
            raise OpenArmError(Code.BUSY, f"the {taken[0]} arm is moving already; wait for the end, or cancel it first")
        return _Claim(self._claimed, names if wanted else ())

    def _stopper(self, handle: ServerGoalHandle) -> Callable[[], bool]:
        return lambda: self._closing or handle.is_cancel_requested

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
        moving = [name for name, follower in self._followers.items() if follower.running is not None]
        faults = [] if age <= self.config.execution.stale_after else ["no fresh /joint_states"]
        values: dict[str, object] = {"joint_state_age_s": round(age, 2), "moving": ", ".join(moving) or "none"}
        try:
            look = self._situations.look()
            values |= {"map_version": look.version, "map": look.why or f"{look.age_s:.1f} s old"}
        except OpenArmError as error:
            faults.append(error.message)
        self.diagnose(not faults, "; ".join(faults) or "ready", **values)


class _Claim:
    """Arms are taken while this is open."""

    def __init__(self, claimed: set[str], names: Sequence[str]) -> None:
        self._claimed, self._names = claimed, names

    def __enter__(self) -> None:
        self._claimed.update(self._names)

    def __exit__(self, *_: object) -> None:
        self._claimed.difference_update(self._names)


def main() -> None:
    """Run the node."""
    run(MotionNode)


if __name__ == "__main__":
    main()
