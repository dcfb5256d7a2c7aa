# SPDX-License-Identifier: Apache-2.0
"""The robot behind the node graph: joint states, detections, actions and services of the other nodes."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, PlanApproach
from openarm_interfaces.srv import ComputeIK, GetScene
from rclpy.client import Client
from rclpy.task import Future

from openarm_common.camera.cameras import CameraConfig
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.ros.actions import ActionClient, check_alive
from openarm_common.ros.holds import Holder
from openarm_common.ros.node import BaseNode
from openarm_common.types import Array
from openarm_grasp.config import GraspConfig
from openarm_grasp.perception.detections import Frame
from openarm_grasp.planning.candidates import Box
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace, Trajectory, check_deadline, slowed
from openarm_grasp.ros import messages
from openarm_grasp.ros.graph_clients import DETECTIONS, GraphClients


class GraphRobot:
    """Implements `RobotInterface` over the node graph.

    Args:
        node: The node that owns the clients.
        config: Parameters.
        table_z: Height of the table top, base frame, m, until it is published.
    """

    def __init__(self, node: BaseNode[Any], config: GraspConfig, table_z: float) -> None:
        self._node = node
        self._config = config
        self._nodes = GraphClients(node, config, table_z)
        self._holder = Holder(node)
        self._plan = ActionClient(node, PlanApproach, "/motion/plan_approach")
        self._execute = ActionClient(node, ExecuteTrajectory, "/motion/execute")
        self._move = ActionClient(node, MoveArm, "/motion/move")
        self._ik = node.create_client(ComputeIK, "/motion/compute_ik")
        self._scene = node.create_client(GetScene, "/motion/get_scene")
        kind = messages.GRIPPER_ACTIONS[config.gripper_action]
        self._grippers = {
            arm: ActionClient(node, kind, config.gripper.format(arm=arm)) for arm in node.description.arm_names
        }
        self.deadline_ns, self.velocity_scale = 0, config.velocity_scale
        #: Longest start delay of a motion until the other arm leaves clearance, s; 0: the arms never move at once.
        self.max_start_delay = 0.0
        self._cancelled = False

    def next_to_other(self) -> GraphRobot:
        """The same for an arm that moves while the other does: its motions may start later, and it ends by itself."""
        robot = copy(self)
        robot._cancelled = False
        robot.max_start_delay = self._config.limits.beside_wait
        return robot

    # --- begin, end, cancel
    async def begin(self, what: str, arms: Sequence[str]) -> None:
        """Listen to the robot and wait until every node that a grasp needs is there.

        Args:
            what: Description of the work, for other clients of the arms.
            arms: Those that it will move.

        Raises:
            OpenArmError: NOT_READY, naming what is missing; CANCELLED.
        """
        self._cancelled, self._holder.name = False, f"the grasp node ({what})"
        await self._nodes.begin(lambda: self._missing(arms))

    def end(self) -> None:
        """Stop listening, and leave the arms to others."""
        self._holder.release()
        self._nodes.end()

    def follow_table(self, on_height: Callable[[float], None]) -> None:
        """Call a function with the height of the table, base frame, m, whenever it is published."""

        def take(height: float) -> None:
            self._nodes.table_z = height
            on_height(height)

        self._nodes.robot.follow_table(take)

    def follow_mounts(self, on_mounts: Callable[[dict[str, CameraConfig]], None]) -> None:
        """Call a function with the cameras, by name, whenever one with a housing is mounted elsewhere."""
        self._nodes.robot.follow_mounts(on_mounts)

    def close(self) -> None:
        """Leave the arms to others, and take the clients down."""
        self.end()
        for client in (self._plan, self._execute, self._move, *self._grippers.values()):
            client.destroy()

    def cancel(self) -> None:
        """Let what runs end with CANCELLED and the arm hold."""
        self._cancelled = True

    def _missing(self, arms: Sequence[str]) -> list[str]:
        self._check_cancel()
        needed = {
            "action /motion/plan_approach (motion node)": self._plan.server_is_ready(),
            "action /motion/execute (motion node)": self._execute.server_is_ready(),
            "action /motion/move (motion node)": self._move.server_is_ready(),
            "publisher of /detections_3d (detector)": self._nodes.sees(DETECTIONS),
            "/joint_states (bridge or robot driver)": self._nodes.has_joint_states,
        }
        for arm in arms:
            name = f"action {self._config.gripper.format(arm=arm)} (bridge, arm_control or robot driver)"
            needed[name] = self._grippers[arm].server_is_ready()
        return [what for what, there in needed.items() if not there]

    # --- the robot
    @property
    def description(self) -> RobotDescription:
        """The robot."""
        return self._node.description

    @property
    def states(self) -> RobotStateBuffer:
        """Its joint states."""
        return self._nodes.robot.buffer

    @property
    def now_ns(self) -> int:
        """Robot time; 0 before the first joint state."""
        return self._nodes.now_ns

    def effort(self, joint: str) -> float:
        """Newest effort of a joint, N or N m."""
        return self._nodes.robot.efforts.get(joint, 0.0)

    def pads(self, arm: str) -> tuple[float, ...]:
        """Force on each finger pad of a hand, N; empty without a sensor."""
        return self._nodes.pads.of(arm)

    def held_box(self, arm: str) -> Box | None:
        """What /motion/attached_objects says of a hand; none, when it says more than one thing."""
        link = self.description.tcp_link(arm)
        held = [box for box in self._nodes.robot.tracker.held if box.link == link]
        if len(held) != 1:
            return None
        return Box(held[0].name.removeprefix(f"{arm}/"), held[0].T_link_box, np.array(held[0].size))

    def check(self) -> None:
        """Raise when the grasp may not go on."""
        self._nodes.check()
        self._check_cancel()
        check_deadline(self.now_ns, self.deadline_ns)

    def _check_cancel(self) -> None:
        if self._cancelled:
            raise OpenArmError(Code.CANCELLED, "cancelled; the arm holds where it is and the hand keeps what it holds")

    def warn(self, text: str) -> None:
        """Write a warning into the log."""
        self._node.get_logger().warning(text)

    # --- waiting and observing
    async def until(
        self, done: Callable[[], bool], limit: float, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        """Wait for a condition, `limit` s of wall clock."""
        await self._nodes.until(done, limit, what, self._watched(guard))

    def _watched(self, guard: Callable[[], None] | None) -> Callable[[], None]:
        def check() -> None:
            self._check_cancel()
            check_deadline(self.now_ns, self.deadline_ns)
            if guard is not None:
                guard()

        return check

    async def together(self, parts: Sequence[Callable[[], Awaitable[None]]]) -> None:
        """Carry out several coroutines at once."""
        executor = self._node.executor
        if executor is None:
            raise OpenArmError(Code.INTERNAL, "the grasp node is not in an executor")
        faults: list[Exception] = []

        async def carry_out(part: Callable[[], Awaitable[None]]) -> None:
            # An exception that leaves a task would stop the whole executor; it is raised below.
            try:
                await part()
            except Exception as error:
                faults.append(error)

        tasks: list[Future] = [executor.create_task(carry_out, part) for part in parts]
        # All end, also those next to one that failed: they watch the same cancel, robot and deadlines.
        while not all(task.done() for task in tasks):
            await self._nodes.tick()
        if faults:  # an emergency stop ends all, and only an arm's controller can say that it was one
            raise next((f for f in faults if isinstance(f, OpenArmError) and f.code is Code.STOPPED), faults[0])

    async def observe(self, count: int, *, near: str = "") -> tuple[Frame, ...]:
        """Frames of detections that are taken from now on."""
        if not near:
            config, watched = self._config, self._watched(None)
            return await self._nodes.observe(count, DETECTIONS, config.camera, config.detect.frame_timeout, watched)
        topic = self._config.near.topic.format(camera=near)
        if not self._nodes.sees(topic):
            raise OpenArmError(Code.NOT_READY, f"no node publishes {topic}")
        return await self._nodes.observe(count, topic, near, self._config.near.timeout, self._watched(None))

    def expect_near(self, camera: str) -> None:
        """Wake the detector of the camera on the hand."""
        self._nodes.listen(self._config.near.topic.format(camera=camera))

    def stop_observing(self) -> None:
        """Leave all detections."""
        self._nodes.stop_observing()

    # --- planning and moving
    async def plan(self, request: PlanGrasp | PlanPlace) -> Planned:
        """Ask /motion/plan_approach."""
        goal = messages.plan_goal(request, slowed(self.velocity_scale, request.velocity_scale))
        what = f"{request.arm} arm: planning"
        result = await self._nodes.goal(self._plan, goal, self._config.limits.plan_timeout, what, self._watched(None))
        return messages.planned_from_msg(result, len(goal.targets), blend=request.blend)

    async def reach(self, arm: str, T_base_tcp: Array) -> Mapping[str, float]:
        """Ask /motion/compute_ik."""
        if not self._ik.service_is_ready():
            return {}
        answer = await self._answer(
            self._ik, messages.reach_request(arm, self.description.base, T_base_tcp), "/motion/compute_ik"
        )
        return messages.reach_from_msg(arm, answer, T_base_tcp)

    async def scene_version(self) -> int:
        """Ask /motion/get_scene."""
        answer = await self._answer(self._scene, GetScene.Request(), "/motion/get_scene")
        return int(answer.version)

    async def _answer(self, client: Client, request: object, what: str) -> Any:
        """Ask a service of the motion node."""
        answered, died = client.call_async(request), self._plan.watch()
        check = self._watched(lambda: check_alive(died, what, Code.ROBOT_LOST))
        try:
            await self._nodes.until(answered.done, self._config.limits.answer_timeout, what, check)
        finally:
            client.remove_pending_request(answered)
        return answered.result()

    async def follow(
        self, arm: str, trajectory: Trajectory, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        """Ask /motion/execute."""
        goal = ExecuteTrajectory.Goal(arm=arm, trajectory=trajectory, max_start_delay=self.max_start_delay)
        await self._moved(arm, self._execute, goal, what, guard)

    async def move(
        self, arm: str, to: str | Array, what: str, obstacles: Sequence[Box] = (), *, plan_only: bool = False
    ) -> None:
        """Ask /motion/move."""
        goal = messages.move_goal(arm, self.description.base, to, obstacles, self.velocity_scale, self.max_start_delay)
        goal.plan_only = plan_only
        await self._moved(arm, self._move, goal, what)

    async def _moved(
        self, arm: str, client: ActionClient, goal: object, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        self._holder.hold(arm)
        limit = self._config.limits.move_timeout + self.max_start_delay
        result = await self._nodes.goal(client, goal, limit, what, self._watched(guard), self._holder.goal_id())
        if not result.success:
            code = messages.code_from_text(result.code, Code.EXECUTION_FAILED)
            raise OpenArmError(code, f"{what}: {result.message or 'failed'}")

    async def grip(self, arm: str, joint: str, position: float, what: str, effort: float = 0.0) -> bool:
        """Ask the gripper's controller."""
        goal = messages.gripper_goal(self._config.gripper_action, joint, position, effort)
        self._holder.hold(arm)
        limit, goal_id = self._config.limits.gripper_timeout, self._holder.goal_id()
        result = await self._nodes.goal(self._grippers[arm], goal, limit, what, self._watched(None), goal_id)
        return messages.gripped(result)
