# SPDX-License-Identifier: Apache-2.0
"""The motion node: serves `openarm_motion.service.motion_service.MotionService` over ROS.

Actions /motion/plan_approach, /motion/move, /motion/move_arms and /motion/execute; services /motion/compute_ik,
/motion/apply_scene and /motion/get_scene; latched /motion/scene, /motion/preview and /motion/attached_objects. Poses
are in the base frame or any frame that the description or /tf_static knows. The nodes `move_group` and
`servo_node` of the same process answer to MoveIt's names.
"""

from __future__ import annotations

import importlib
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, TypeVar

from openarm_interfaces.action import ExecuteTrajectory, MoveArm, MoveArms, PlanApproach
from openarm_interfaces.srv import ApplyScene, ComputeIK, GetScene
from rclpy.action import CancelResponse
from rclpy.action.server import ServerGoalHandle
from visualization_msgs.msg import MarkerArray

from openarm_common.camera.cameras import CameraConfig
from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.distance_field import DistanceFieldReader, field_path
from openarm_common.priority import use_fifo
from openarm_common.ros.actions import ActionServer
from openarm_common.ros.convert import matrix_to_pose, pose_to_matrix
from openarm_common.ros.holds import HoldListener
from openarm_common.ros.node import QOS_LATCHED, BaseNode, run
from openarm_common.scene.scene import load_scene
from openarm_motion.config import MotionConfig
from openarm_motion.ros import convert
from openarm_motion.ros.robot import NodeRobot
from openarm_motion.service.faults import PlanFaults
from openarm_motion.service.motion_service import MotionService, Report, make_arms, table_box
from openarm_motion.service.requests import (
    ApproachAnswer,
    ExecuteRequest,
    MotionAnswer,
    MoveAnswer,
    MoveArmsAnswer,
    MoveArmsRequest,
    MoveRequest,
)
from openarm_motion.timing.trajectory import Trajectory

AnswerT = TypeVar("AnswerT", bound=MotionAnswer)
RequestT = TypeVar("RequestT")
MovingT = TypeVar("MovingT", ExecuteRequest, MoveRequest, MoveArmsRequest)

#: Adapters that are imported, with MoveIt's messages, where they are wanted.
_MOVE_GROUP, _SERVO = "openarm_motion.ros.move_group.node", "openarm_motion.ros.servo_node"
#: Pace of feedback while planning, s.
_FEEDBACK = 0.1
#: Arms that move have this long to come to rest when the process is to end, s.
_HOLD = 1.8


def _adapter(module: str) -> Any:
    """Import an adapter.

    Raises:
        OpenArmError: ENVIRONMENT, without MoveIt's messages.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != "moveit_msgs":
            raise
        text = "there is no Python package moveit_msgs; ./openarm up --moveit builds it"
        raise OpenArmError(Code.ENVIRONMENT, text) from error


class MotionNode(BaseNode[MotionConfig]):
    """Plans and executes motions of each arm, and dual-arm motions."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("motion", MotionConfig, **kwargs)
        config = self.config
        self._holds = HoldListener(self)
        self.robot = NodeRobot(self, config, self._holds)
        self._table = load_scene(config.scene).table if config.scene else None
        arms = make_arms(config, self.description, [table_box(self._table)] if self._table else [])
        field = DistanceFieldReader(field_path(config.map.name or str(self.context.get_domain_id())))
        self.service = MotionService(self.robot, config, arms, field, (self.description.base, self.description.root))
        self._scene = self.create_publisher(MarkerArray, "/motion/scene", QOS_LATCHED)
        self._preview = self.create_publisher(MarkerArray, "/motion/preview", QOS_LATCHED)
        self._attached = self.create_publisher(MarkerArray, "/motion/attached_objects", QOS_LATCHED)
        self.service.on_plan, self.service.on_held = self._show_plan, self._show_held
        self.accept_changes(self._take)
        self._show_held()
        self._show_scene()
        self.robot.listener.follow_table(self._take_table)
        self.robot.listener.follow_mounts(self._take_mounts)
        self._servers = [
            self._serve(PlanApproach, "/motion/plan_approach", self._on_plan),
            self._serve(MoveArm, "/motion/move", self._on_move),
            self._serve(MoveArms, "/motion/move_arms", self._on_move_arms),
            self._serve(ExecuteTrajectory, "/motion/execute", self._on_execute),
        ]
        self.create_service(ComputeIK, "/motion/compute_ik", self._on_ik)
        self.create_service(ApplyScene, "/motion/apply_scene", self._on_apply)
        self.create_service(GetScene, "/motion/get_scene", self._on_get)
        self.create_timer(self.REPORT_PERIOD_S, self._report, clock=self.steady_clock)
        if config.move_group.enabled:
            group = _adapter(_MOVE_GROUP).MoveGroupNode(
                self.service,
                config.move_group,
                config.controller,
                self._holds.check,
                self._show_scene,
                context=self.context,
            )
            self.companions = (group,)
        if config.servo.enabled:
            servo = _adapter(_SERVO).ServoNode(
                self.service, config.servo, config.controller, self._holds.check, context=self.context
            )
            self.companions = (*self.companions, servo)
        for arm in arms.values():
            self.get_logger().info(f"{arm.name} arm: {', '.join(arm.names)}; inverse kinematics: {arm.inverse.method}")

    def _take_mounts(self, cameras: Mapping[str, CameraConfig]) -> None:
        self.service.mount(make_arms(self.config, self.description, (), cameras))

    def _take(self, config: MotionConfig) -> None:
        """Inject faults as configured, from the next plan on."""
        self.service.faults = PlanFaults(config.faults)

    async def hold(self) -> None:
        """End all plans and motions; the arms hold where they are."""
        await self.service.hold(_HOLD)

    def close(self) -> None:
        """Stop planning, then as every node."""
        self.service.closing = True
        while self._servers:
            self._servers.pop().destroy()
        super().close()

    # --- actions
    async def _on_plan(self, handle: ServerGoalHandle) -> PlanApproach.Result:
        feedback = PlanApproach.Feedback(stage="checking")

        def report(stage: str, tried: float) -> None:
            feedback.stage, feedback.tried = stage, int(tried)

        timer = self.create_timer(_FEEDBACK, lambda: handle.publish_feedback(feedback), clock=self.steady_clock)
        try:
            answer = await _answered(
                ApproachAnswer, handle, convert.approach_request, self.service.plan_approach, report
            )
        finally:
            self.destroy_timer(timer)
        result = PlanApproach.Result(chosen=-1, start_delay=answer.start_delay)
        if answer.plan is not None:
            result.chosen, result.limit_margins = answer.plan.chosen, list(answer.plan.limit_margins)
            result.transfer, result.approach, result.retreat = map(convert.trajectory_msg, answer.plan.parts)
        result.refusals = [convert.refusal_msg(refused) for refused in answer.refusals]
        return _end(handle, result, answer)

    async def _on_move(self, handle: ServerGoalHandle) -> MoveArm.Result:
        report = _reporter(handle, MoveArm.Feedback())
        answer = await _answered(
            MoveAnswer, handle, self._of_holder(handle, convert.move_request), self.service.move, report
        )
        result = MoveArm.Result(start_delay=answer.start_delay)
        if answer.trajectory is not None:
            result.trajectory = convert.trajectory_msg(answer.trajectory)
        return _end(handle, result, answer)

    async def _on_move_arms(self, handle: ServerGoalHandle) -> MoveArms.Result:
        report = _reporter(handle, MoveArms.Feedback())
        answer = await _answered(
            MoveArmsAnswer, handle, self._of_holder(handle, convert.move_arms_request), self.service.move_arms, report
        )
        result = MoveArms.Result()
        if answer.plan is not None:
            result.start_delays, result.clearance = list(answer.plan.start_delays), answer.plan.clearance
            result.trajectories = [convert.trajectory_msg(part) for part in answer.plan.trajectories]
        return _end(handle, result, answer)

    async def _on_execute(self, handle: ServerGoalHandle) -> ExecuteTrajectory.Result:
        report = _reporter(handle, ExecuteTrajectory.Feedback())
        answer = await _answered(
            MotionAnswer, handle, self._of_holder(handle, convert.execute_request), self.service.execute, report
        )
        return _end(handle, ExecuteTrajectory.Result(start_delay=answer.start_delay), answer)

    def _of_holder(self, handle: ServerGoalHandle, convert_goal: Callable[[Any], MovingT]) -> Callable[[Any], MovingT]:
        """The conversion of a goal, which refuses one that would move an arm that another client holds."""

        def convert_held(message: Any) -> MovingT:
            request = convert_goal(message)
            if not getattr(request, "plan_only", False):
                for arm in request.arms:
                    self._holds.check(arm, bytes(handle.goal_id.uuid))
            return request

        return convert_held

    # --- services
    def _on_ik(self, request: ComputeIK.Request, response: ComputeIK.Response) -> ComputeIK.Response:
        try:
            pose = self.service.in_base(pose_to_matrix(request.pose.pose), request.pose.header.frame_id)
            answer = self.service.compute_ik(request.arm, pose, request.seed, position_only=request.position_only)
            best, response.nearest = answer.nearest, matrix_to_pose(answer.pose)
            response.joint_positions = best.q.tolist()
            response.position_error, response.orientation_error = best.position_error, best.orientation_error
            if answer.error is not None:
                raise answer.error
            response.success, response.code, response.message = True, Code.OK.value, "solved"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        return response

    def _on_apply(self, request: ApplyScene.Request, response: ApplyScene.Response) -> ApplyScene.Response:
        before = self.service.scene.version
        try:
            add = [convert.solid_from_msg(message, self.service.in_base) for message in request.add]
            response.message = self.service.apply_scene(
                clear=request.clear, remove=request.remove, add=add, expected=request.expected_version
            )
            response.success, response.code = True, Code.OK.value
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        response.version = self.service.scene.version
        if response.version != before:
            self._show_scene()
        return response

    def _on_get(self, _: GetScene.Request, response: GetScene.Response) -> GetScene.Response:
        state = self.service.scene_state()
        response.version, response.fixed, response.map = state.version, list(state.fixed), self.config.map.use
        response.objects = [convert.solid_msg(solid, self.description.base) for solid in state.solids]
        response.map_used, response.map_version = state.map.occupied is not None, state.map.version
        response.map_age, response.map_message = state.map.age_s, state.map.why
        return response

    # --- what is published
    def _show_plan(self, plans: Mapping[str, Sequence[Trajectory]]) -> None:
        self._preview.publish(convert.preview_markers(self.service.tool_paths(plans), self.description.base))

    def _show_held(self) -> None:
        self._attached.publish(convert.held_markers(self.service.held_on_links()))

    def _take_table(self, height: float) -> None:
        if self._table is not None and height != self._table.top_z:
            self._table = self._table.at(height)
            self.service.fix([table_box(self._table)])
            self._show_scene()

    def _show_scene(self) -> None:
        self._scene.publish(convert.scene_markers(self.service.scene_state().solids, self.description.base))

    def _report(self) -> None:
        age = self.robot.state_age()
        faults = [] if age <= self.config.execution.stale_after else ["no fresh /joint_states"]
        values: dict[str, object] = {
            "joint_state_age_s": round(age, 2),
            "moving": ", ".join(self.service.moving) or "none",
        }
        try:
            values["map"] = self.service.check_map()
        except OpenArmError as error:
            faults.append(error.message)
        self.diagnose(not faults, "; ".join(faults) or "ready", **values)

    def _serve(self, kind: Any, name: str, execute: Callable[[ServerGoalHandle], Any]) -> ActionServer:
        return ActionServer(self, kind, name, execute, cancel_callback=lambda _: CancelResponse.ACCEPT)


async def _answered(
    kind: type[AnswerT],
    handle: ServerGoalHandle,
    convert_goal: Callable[[Any], RequestT],
    ask: Callable[[RequestT, Callable[[], bool], Report], Awaitable[AnswerT]],
    report: Report,
) -> AnswerT:
    """The service's answer to a goal; what is wrong with the message is one, too."""
    try:
        return await ask(convert_goal(handle.request), lambda: bool(handle.is_cancel_requested), report)
    except OpenArmError as error:
        return kind(error=error, message=error.message)


def _reporter(handle: ServerGoalHandle, feedback: Any) -> Report:
    def report(stage: str, progress: float) -> None:
        if hasattr(feedback, "stage"):
            feedback.stage = stage
        feedback.progress = progress
        handle.publish_feedback(feedback)

    return report


def _end(handle: ServerGoalHandle, result: Any, answer: MotionAnswer) -> Any:
    """Fill in what all results have in common, and set the goal's status."""
    result.success, result.code, result.message = answer.error is None, answer.code.value, answer.message
    if hasattr(result, "scene_version"):
        result.scene_version, result.planning_time = answer.scene_version, answer.planning_time
        if answer.error is not None:
            result.failure = convert.failure_msg(answer.error)
    if answer.error is None:
        handle.succeed()
    elif answer.code is Code.CANCELLED and handle.is_cancel_requested:
        handle.canceled()
    else:
        handle.abort()
    return result


def _timely() -> MotionNode:
    """Make the node; what keeps the pace of servoing is scheduled before what plans, whose threads come later."""
    node = MotionNode()
    if node.config.servo.enabled and (priority := node.config.servo.thread_priority):
        node.get_logger().info(f"scheduled as {use_fifo(priority)}")
    return node


def main() -> None:
    """Run the node."""
    run(_timely)


if __name__ == "__main__":
    main()
