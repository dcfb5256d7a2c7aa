# SPDX-License-Identifier: Apache-2.0
"""The node `move_group` of the motion node's process: MoveIt's names, the same service, the same planning scene.

Actions /move_action and /execute_trajectory; services /plan_kinematic_path, /compute_cartesian_path, /compute_ik,
/compute_fk, /check_state_validity, /query_planner_interface, /clear_octomap, and those of the scene; topics
/display_planned_path, /robot_description_semantic, /trajectory_execution_event. What a message asks and is not
supported is refused by name (`fields`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from geometry_msgs.msg import Point, PoseStamped
from moveit_msgs.action import ExecuteTrajectory, MoveGroup
from moveit_msgs.msg import (
    ConstraintEvalResult,
    ContactInformation,
    DisplayTrajectory,
    MotionPlanRequest,
    MotionPlanResponse,
    MoveItErrorCodes,
    PlannerInterfaceDescription,
    RobotState,
    RobotTrajectory,
)
from moveit_msgs.srv import (
    GetCartesianPath,
    GetMotionPlan,
    GetPositionFK,
    GetPositionIK,
    GetStateValidity,
    QueryPlannerInterfaces,
)
from rclpy.action import CancelResponse
from rclpy.action.server import ServerGoalHandle
from std_msgs.msg import String
from std_srvs.srv import Empty

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.actions import ActionServer
from openarm_common.ros.convert import matrix_to_pose, stamp_to_ns, trajectory_from_msg
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, BaseNode
from openarm_motion.collision.exact import Contact, body_of
from openarm_motion.config import MoveGroupConfig, NoParameters
from openarm_motion.constraints.cartesian import CartesianPath
from openarm_motion.constraints.names import RobotNames
from openarm_motion.constraints.queries import at_pose, judge, link_poses, solve
from openarm_motion.ros.move_group.codes import error_code
from openarm_motion.ros.move_group.convert import Converter, as_moveit, state_msg, trajectory_msg
from openarm_motion.ros.move_group.fields import EXECUTE, FK, IK, MOVE, VALIDITY, check_fields
from openarm_motion.ros.move_group.hands import Hands
from openarm_motion.ros.move_group.octomap import SceneOctomap
from openarm_motion.ros.move_group.planning import PIPELINE, Requests
from openarm_motion.ros.move_group.preemption import Preemption
from openarm_motion.ros.move_group.scene import SceneServer
from openarm_motion.service.requests import MoveRequest
from openarm_motion.timing.trajectory import Motion

if TYPE_CHECKING:
    from openarm_motion.service.motion_service import MotionService

ResponseT = TypeVar("ResponseT")


class MoveGroupNode(BaseNode[NoParameters]):
    """Answers MoveIt's clients.

    Args:
        service: Service of the motion node.
        config: Parameters.
        controller: Name of the trajectory action of an arm.
        check_hold: Refuses a goal, by arm and id, that would move an arm that another client holds.
        on_scene: Called when a client of MoveIt has changed the scene.
    """

    def __init__(
        self,
        service: MotionService,
        config: MoveGroupConfig,
        controller: str,
        check_hold: Callable[[str, bytes], None],
        on_scene: Callable[[], None],
        **kwargs: Any,
    ) -> None:
        # a remapping of the process's node name is for the motion node
        super().__init__("move_group", NoParameters, use_global_arguments=False, **kwargs)
        self._service, self._controller, self._check_hold = service, controller, check_hold
        robot = self.description
        self.declare_parameter("robot_description", robot.urdf)
        self.declare_parameter("robot_description_semantic", robot.srdf)
        self.declare_parameter("default_planning_pipeline", PIPELINE)
        names = RobotNames(robot, service.arms)
        self._convert = Converter(robot, names, service.in_base)
        self._requests = Requests(service, names, self._convert)
        self._hands = Hands(self, config, service, robot, names)
        self._refused = ("", "")
        self._stops, self._preemption = 0, Preemption(service.robot)
        octomap = SceneOctomap(self, service, self._convert, config.map)
        self.scene = SceneServer(
            self, service, robot, names, self._convert, self._requests, octomap, on_scene, self._refuse
        )
        self._display = self.create_publisher(DisplayTrajectory, "/display_planned_path", QOS_LATCHED)
        semantic = self.create_publisher(String, "/robot_description_semantic", QOS_LATCHED)
        semantic.publish(String(data=robot.srdf))
        self._servers = [
            self._serve(MoveGroup, "/move_action", self._on_move),
            self._serve(ExecuteTrajectory, "/execute_trajectory", self._on_execute),
        ]
        self.create_service(GetMotionPlan, "/plan_kinematic_path", self._on_plan)
        self.create_service(GetCartesianPath, "/compute_cartesian_path", self._on_cartesian)
        self.create_service(GetPositionIK, "/compute_ik", self._on_ik)
        self.create_service(GetPositionFK, "/compute_fk", self._on_fk)
        self.create_service(GetStateValidity, "/check_state_validity", self._on_validity)
        self.create_service(QueryPlannerInterfaces, "/query_planner_interface", self._on_query)
        self._map = self.create_client(Empty, config.clear_map)
        self.create_service(Empty, "/clear_octomap", self._on_clear)
        self.create_subscription(String, "/trajectory_execution_event", self._on_event, QOS_COMMAND)
        self.create_timer(self.REPORT_PERIOD_S, self._report, clock=self.steady_clock)

    def close(self) -> None:
        """Take servers and clients down, then as every node."""
        while self._servers:
            self._servers.pop().destroy()
        self._hands.close()
        super().close()

    # --- actions
    async def _on_move(self, handle: ServerGoalHandle) -> MoveGroup.Result:
        goal: MoveGroup.Goal = handle.request
        handle.publish_feedback(MoveGroup.Feedback(state="PLANNING"))
        answer = MotionPlanResponse()
        try:
            check_fields(goal, MOVE, "goal of /move_action")
            await self._move(goal.request, answer, handle, execute=not goal.planning_options.plan_only)
        except OpenArmError as error:
            self._refuse("/move_action", error, answer)
        self._end(handle, answer.error_code.val == answer.error_code.SUCCESS)
        return MoveGroup.Result(
            error_code=answer.error_code,
            trajectory_start=answer.trajectory_start,
            planned_trajectory=answer.trajectory,
            planning_time=answer.planning_time,
        )

    async def _on_execute(self, handle: ServerGoalHandle) -> ExecuteTrajectory.Result:
        handle.publish_feedback(ExecuteTrajectory.Feedback(state="MONITOR"))
        result = ExecuteTrajectory.Result()
        try:
            names = list(handle.request.trajectory.joint_trajectory.joint_names)
            if hand := self._hands.of_joints(names):
                check_fields(handle.request, EXECUTE, "trajectory")
                names, t, q, _, _ = trajectory_from_msg(handle.request.trajectory.joint_trajectory)
                async with self._alone(handle, {hand: names}) as stopped:
                    await self._hands.execute(hand, Motion(tuple(names), t, q), stopped)
            else:
                motions = self._requests.execute(handle.request, lambda arm: self._controller.format(arm=arm))
                async with self._alone(handle, {arm: motion.names for arm, motion in motions.items()}) as stopped:
                    (await self._service.execute_arms(motions, stopped)).require()
            result.error_code = error_code(None, "arrived")
        except OpenArmError as error:
            self._refuse("/execute_trajectory", error, result)
        self._end(handle, result.error_code.val == result.error_code.SUCCESS)
        return result

    def _alone(
        self, handle: ServerGoalHandle | None, moved: Mapping[str, Sequence[str]]
    ) -> AbstractAsyncContextManager[Callable[[], bool]]:
        """Let a goal, or a service, move joints of some arms alone."""
        stops = self._stops
        if handle is not None:
            for arm in moved:
                self._check_hold(arm, bytes(handle.goal_id.uuid))
        joints = [name for names in moved.values() for name in names]
        ended = lambda: handle is not None and (bool(handle.is_cancel_requested) or self._stops != stops)  # noqa: E731
        return self._preemption.take(joints, ended)

    def _end(self, handle: ServerGoalHandle, success: bool) -> None:
        if success:
            handle.succeed()
        elif handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()

    def _on_event(self, message: String) -> None:
        if message.data != "stop":
            text = f"trajectory_execution_event {message.data!r}; valid: stop"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        self._stops += 1

    # --- plans
    async def _on_plan(self, request: GetMotionPlan.Request, response: GetMotionPlan.Response) -> object:
        return await self._answer(
            "/plan_kinematic_path", response.motion_plan_response, response, self._plan(request, response)
        )

    async def _plan(self, request: GetMotionPlan.Request, response: GetMotionPlan.Response) -> None:
        await self._move(request.motion_plan_request, response.motion_plan_response)

    async def _move(
        self,
        request: MotionPlanRequest,
        answer: MotionPlanResponse,
        handle: ServerGoalHandle | None = None,
        *,
        execute: bool = False,
    ) -> None:
        """Plan, and execute; the answer is filled in as far as that goes."""
        answer.group_name = request.group_name
        self._requests.check(request)
        hand, note = self._hands.groups.get(request.group_name, ""), self._requests.note(request, execute=execute)
        asked = None if hand else self._requests.plan(request, execute=execute)
        moved = {arm: self._service.arms[arm].names for arm in asked.arms} if asked else self._hands.joints(hand)
        async with self._alone(handle, moved if execute else {}) as stopped:
            answer.trajectory_start = self._state(RobotState() if execute else request.start_state)
            if asked is None:
                motion: Motion = self._hands.plan(request)
                answer.trajectory = trajectory_msg(motion)
                if execute:
                    await self._hands.execute(hand, motion, stopped)
                answer.error_code = error_code(None, f"{'arrived' if execute else 'planned'}{note}")
            else:
                report = self._reporter(handle)
                if isinstance(asked, MoveRequest):
                    reply = await self._service.move(asked, stopped, report)
                else:
                    reply = await self._service.move_arms(asked, stopped, report)
                answer.trajectory, answer.planning_time = trajectory_msg(reply.trajectory), reply.planning_time
                reply.require()
                answer.error_code = error_code(None, reply.message + note)
        self.show(answer.trajectory_start, answer.trajectory)

    def _reporter(self, handle: ServerGoalHandle | None) -> Callable[[str, float], None]:
        said = {"PLANNING"}

        def report(stage: str, _: float) -> None:
            state = "MONITOR" if stage == "executing" else "PLANNING"
            if handle is not None and state not in said:
                said.add(state)
                handle.publish_feedback(MoveGroup.Feedback(state=state))

        return report

    async def _on_cartesian(self, request: GetCartesianPath.Request, response: GetCartesianPath.Response) -> object:
        return await self._answer("/compute_cartesian_path", response, response, self._cartesian(request, response))

    async def _cartesian(self, request: GetCartesianPath.Request, response: GetCartesianPath.Response) -> None:
        response.start_state = self._state(request.start_state)
        reply = (await self._service.move(self._requests.cartesian(request))).require()
        path = reply.trajectory
        if not isinstance(path, CartesianPath):
            raise OpenArmError(Code.INTERNAL, "the plan is no Cartesian path")
        response.solution, response.fraction = trajectory_msg(path), path.fraction
        response.error_code = error_code(None, path.ended and f"ends after {path.fraction:.0%}: {path.ended}")
        self.show(response.start_state, response.solution)

    def show(self, start: RobotState, trajectory: RobotTrajectory) -> None:
        """Publish a plan on /display_planned_path."""
        name = self.description.name
        self._display.publish(DisplayTrajectory(model_id=name, trajectory_start=start, trajectory=[trajectory]))

    def _state(self, given: RobotState) -> RobotState:
        """The state that a plan starts from."""
        state: dict[str, float] = {}
        if self._service.robot.state_age() < float("inf"):
            present = self._service.robot.states.latest()[1]
            state = {name: x for name, x in present.items() if name in self.description.joints}
        return state_msg({**state, **dict(zip(given.joint_state.name, given.joint_state.position, strict=False))})

    # --- questions
    async def _on_ik(self, request: GetPositionIK.Request, response: GetPositionIK.Response) -> object:
        return await self._answer("/compute_ik", response, response, self._ik(request, response))

    async def _ik(self, request: GetPositionIK.Request, response: GetPositionIK.Response) -> None:
        check_fields(request, IK, "request of /compute_ik")
        asked = request.ik_request
        arm_name = self._requests.arm(asked.group_name)
        pose = self._convert.pose(asked.pose_stamped.pose, asked.pose_stamped.header.frame_id)
        pose = pose @ se3.inverse(self._convert.on_tool(arm_name, asked.ik_link_name))
        region = at_pose(pose, self._convert.region(asked.constraints, arm_name))
        arm, now, around = await self._service.surroundings(arm_name, self._convert.state(asked.robot_state))
        limit = 1e-9 * stamp_to_ns(asked.timeout) or arm.config.planning.time_limit
        if limit < 0.0:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"timeout is {limit:g} s, expected >= 0 (0: the default)")
        end = time.monotonic() + limit
        q = await self._service.robot.compute(
            lambda: solve(arm, now, around, region, avoid_collisions=asked.avoid_collisions, end=end)
        )
        known = {name: x for name, x in now.state.items() if name in self.description.joints}
        response.solution = state_msg({**known, **dict(zip(arm.names, q.tolist(), strict=True))})
        response.error_code = error_code(None, "solved")

    async def _on_fk(self, request: GetPositionFK.Request, response: GetPositionFK.Response) -> object:
        return await self._answer("/compute_fk", response, response, self._fk(request, response))

    async def _fk(self, request: GetPositionFK.Request, response: GetPositionFK.Response) -> None:
        check_fields(request, FK, "request of /compute_fk")
        state = dict(zip(*_names_and_positions(self._state(request.robot_state)), strict=True))
        self._convert.state(request.robot_state)
        frame = request.header.frame_id or self.description.base
        T_base_frame = self._service.in_base(np.eye(4), frame)
        with as_moveit(MoveItErrorCodes.INVALID_LINK_NAME):
            poses = link_poses(self.description, request.fk_link_names, state, T_base_frame)
        for link, T in zip(request.fk_link_names, poses, strict=True):
            stamped = PoseStamped(pose=matrix_to_pose(T))
            stamped.header.frame_id = frame
            response.pose_stamped.append(stamped)
            response.fk_link_names.append(link)
        response.error_code = error_code(None, "computed")

    async def _on_validity(self, request: GetStateValidity.Request, response: GetStateValidity.Response) -> object:
        try:
            check_fields(request, VALIDITY, "request of /check_state_validity")
            names = self._requests.arms(request.group_name) if request.group_name else tuple(self._service.arms)
            regions = self._convert.regions(request.constraints, names)
            state = self._convert.state(request.robot_state)
            response.valid = True
            for name, region in zip(names, regions, strict=True):
                arm, now, around = await self._service.surroundings(name, state)
                verdict = await self._service.robot.compute(lambda a=(arm, now, around, region): judge(*a))
                response.valid = response.valid and verdict.valid
                response.contacts += [self._contact(contact) for contact in verdict.contacts]
                response.constraint_result += [
                    ConstraintEvalResult(result=beyond == 0.0, distance=beyond) for _, beyond in verdict.constraints
                ]
        except OpenArmError as error:
            response.valid = False
            self._refuse("/check_state_validity", error)
        return response

    def _contact(self, contact: Contact) -> ContactInformation:
        """Names and depth of a contact; where it is, is not known: not a number."""
        message = ContactInformation(
            contact_body_1=body_of(contact.first), contact_body_2=body_of(contact.second), depth=-contact.distance
        )
        message.header.frame_id = self.description.base
        message.position = Point(x=math.nan, y=math.nan, z=math.nan)
        message.body_type_1, message.body_type_2 = (self._body_type(n) for n in (contact.first, contact.second))
        return message

    def _body_type(self, name: str) -> int:
        if name in self.description.links:
            return ContactInformation.ROBOT_LINK
        return ContactInformation.WORLD_OBJECT if body_of(name) == name else ContactInformation.ROBOT_ATTACHED

    def _on_query(self, _: object, response: QueryPlannerInterfaces.Response) -> object:
        planner = self._service.config.planning.planner
        response.planner_interfaces = [
            PlannerInterfaceDescription(name="OpenArm", pipeline_id=PIPELINE, planner_ids=[planner])
        ]
        return response

    async def _on_clear(self, _: Empty.Request, response: Empty.Response) -> Empty.Response:
        await self.scene.clear_octomap()
        if self._map.service_is_ready():
            await self._map.call_async(Empty.Request())
        else:
            error = OpenArmError(Code.NOT_READY, f"no service {self._map.srv_name}; is the octomap node running?")
            self._refuse("/clear_octomap", error)
        return response

    async def _answer(self, name: str, coded: Any, response: ResponseT, work: Awaitable[None]) -> ResponseT:
        """Await the work of a service; what goes wrong is in the answer's error code."""
        try:
            await work
        except OpenArmError as error:
            self._refuse(name, error, coded)
        return response

    def _refuse(self, name: str, error: OpenArmError, coded: Any = None) -> None:
        code = error_code(error)
        if coded is not None:
            coded.error_code = code
        self._refused = (name, error.message)
        self.get_logger().error(f"{name}: {error} (MoveIt's error code {code.val})")
        self._report()

    def _report(self) -> None:
        name, text = self._refused
        self.diagnose(True, "ready", last_refusal=f"{name}: {text}" if name else "none")

    def _serve(self, kind: Any, name: str, execute: Callable[[ServerGoalHandle], Any]) -> ActionServer:
        return ActionServer(self, kind, name, execute, cancel_callback=lambda _: CancelResponse.ACCEPT)


def _names_and_positions(state: RobotState) -> tuple[list[str], list[float]]:
    return list(state.joint_state.name), list(state.joint_state.position)
