# SPDX-License-Identifier: Apache-2.0
"""The robot of the node graph as the motion service sees it: joint states, controllers, wall clock, worker threads."""

from __future__ import annotations

import math
import time
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import Any, TypeVar

from action_msgs.msg import GoalInfo
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance
from rclpy.duration import Duration
from rclpy.task import Future, Task
from std_msgs.msg import Float64
from unique_identifier_msgs.msg import UUID

from openarm_common.errors import Code, OpenArmError
from openarm_common.lifeline import Lifeline
from openarm_common.robot.lift import LIFT
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.ros.actions import ActionClient, fastest_topic, latest, owner_topic
from openarm_common.ros.convert import ns_to_stamp, stamp_to_ns, trajectory_to_msg
from openarm_common.ros.holds import HoldListener
from openarm_common.ros.node import BaseNode
from openarm_common.ros.tf import RobotStateListener
from openarm_motion.config import ExecutionConfig, MotionConfig
from openarm_motion.service.robot import GoalOutcome
from openarm_motion.timing.trajectory import Motion

T = TypeVar("T")

#: From one wake of the coroutines that wait to the next, s of wall clock.
_PERIOD = 0.05

_RESULT = FollowJointTrajectory.Result
_INVALID = ("INVALID_GOAL", "INVALID_JOINTS", "OLD_HEADER_TIMESTAMP")
_VIOLATED = ("PATH_TOLERANCE_VIOLATED", "GOAL_TOLERANCE_VIOLATED")
#: What the bridge answers after an emergency stop.
_STOPPED = -100
_FAULTS = {getattr(_RESULT, name): name for name in (*_INVALID, *_VIOLATED)} | {_STOPPED: "STOPPED"}


class NodeRobot:
    """Implements `openarm_motion.service.robot.RobotInterface`.

    Args:
        node: Owns clients, timer, executor and threads.
        config: Parameters.
        holds: Client that each arm serves.
    """

    def __init__(self, node: BaseNode[Any], config: MotionConfig, holds: HoldListener) -> None:
        self._node = node
        self.listener = RobotStateListener(node, node.description)
        self._controllers = {
            arm: Controller(node, config.controller.format(arm=arm), config.execution, partial(holds.goal_id, arm))
            for arm in (*(config.arms or node.description.arm_names), *([LIFT] if node.description.lift else []))
        }
        self._waiting, self._wake = 0, Future(executor=node.executor)
        self._timer = node.create_timer(_PERIOD, self._on_timer, clock=node.steady_clock)
        self._timer.cancel()

    @property
    def states(self) -> RobotStateBuffer:
        """Joint states and frames."""
        return self.listener.buffer

    def state_age(self) -> float:
        """Time since the newest joint state arrived, s of wall clock."""
        return self.listener.age_s()

    def now(self) -> float:
        """Monotonic wall clock, s."""
        return time.monotonic()

    def controller(self, arm: str) -> Controller:
        """The controller of an arm."""
        return self._controllers[arm]

    async def pause(self) -> None:
        """Sleep until the next tick of a timer that runs while a coroutine waits."""
        if not self._waiting and self._timer.is_canceled():
            self._wake = Future(executor=self._node.executor)
            self._timer.reset()
        self._waiting += 1
        await self._wake

    async def compute(self, work: Callable[[], T], nominal: float = 0.0) -> T:
        """Run work in a worker thread."""
        result: T = await self._node.in_thread(work)
        return result

    async def together(self, parts: Sequence[Callable[[], Awaitable[None]]]) -> None:
        """Run coroutines as tasks of the node's executor."""
        executor = self._node.executor
        if executor is None:
            raise OpenArmError(Code.INTERNAL, "the node is in no executor")
        tasks: list[Task] = [executor.create_task(part) for part in parts]
        for task in tasks:
            await task

    def _on_timer(self) -> None:
        if not self._waiting:
            self._timer.cancel()
            return
        self._waiting = 0
        wake, self._wake = self._wake, Future(executor=self._node.executor)
        wake.set_result(None)


class Controller:
    """A FollowJointTrajectory controller; implements `openarm_motion.service.robot.ArmController`.

    Args:
        node: Owns the client.
        name: Name of the action.
        execution: Parameters.
        goal_id: Makes the id of a goal.
    """

    def __init__(self, node: BaseNode[Any], name: str, execution: ExecutionConfig, goal_id: Callable[[], UUID]) -> None:
        self.name = name
        self._execution, self._goal_id = execution, goal_id
        self._client = ActionClient(node, FollowJointTrajectory, name)
        self._owner = node.create_publisher(GoalInfo, owner_topic(name), latest())
        #: See `ArmController.fastest`.
        self.fastest = math.inf
        node.create_subscription(Float64, fastest_topic(name), self._on_fastest, latest())

    def _on_fastest(self, message: Float64) -> None:
        self.fastest = message.data if message.data > 0.0 else math.inf

    def ready(self) -> bool:
        """Whether its action is in the graph."""
        return self._client.server_is_ready()

    def start(self, motion: Motion, begin_ns: int, *, touches: bool) -> _SentGoal:
        """Send a trajectory; its stamp is where it begins. The arm holds when this process dies or hangs."""
        message = trajectory_to_msg(motion.names, motion.t, motion.q, motion.v, motion.a)
        message.header.stamp = ns_to_stamp(begin_ns)
        info = GoalInfo(goal_id=self._goal_id())
        lifeline = Lifeline(bytes(info.goal_id.uuid).hex())
        self._owner.publish(info)
        goal = FollowJointTrajectory.Goal(trajectory=message)
        if not touches:
            near = self._execution.goal_tolerance
            goal.goal_tolerance = [JointTolerance(name=name, position=near) for name in motion.names]
            goal.goal_time_tolerance = Duration(seconds=self._execution.settle).to_msg()
        sent = _SentGoal(lifeline)
        answer = self._client.send_goal_async(goal, feedback_callback=sent.on_feedback, goal_uuid=info.goal_id)
        answer.add_done_callback(sent.on_answer)
        return sent


class _SentGoal:
    """A goal that was sent; one that is withdrawn before it is accepted is cancelled when it is."""

    def __init__(self, lifeline: Lifeline) -> None:
        self._lifeline = lifeline
        self._handle: Any = None
        self._ended: Future | None = None
        self._withdrawn = False
        self._since_ns = 0

    @property
    def accepted(self) -> bool | None:
        return None if self._handle is None else bool(self._handle.accepted)

    @property
    def since_ns(self) -> int:
        return self._since_ns

    @property
    def outcome(self) -> GoalOutcome | None:
        if self._ended is None or not self._ended.done():
            return None
        answer: Any = self._ended.result()
        result = answer.result
        fault = _FAULTS.get(result.error_code, str(result.error_code))
        reason = f": {result.error_string}" if result.error_string else ""
        code = Code.STOPPED if result.error_code == _STOPPED else Code.EXECUTION_FAILED
        return GoalOutcome(result.error_code == _RESULT.SUCCESSFUL, fault + reason, code)

    def cancel(self) -> None:
        self._withdrawn = True
        if self.accepted:
            self._handle.cancel_goal_async()

    def on_feedback(self, message: Any) -> None:
        """Show that this process works, and take note of the beginning where a controller says how far along it is."""
        self._lifeline.beat()
        elapsed_ns = stamp_to_ns(message.feedback.desired.time_from_start)
        if not self._since_ns and elapsed_ns > 0:
            self._since_ns = stamp_to_ns(message.feedback.header.stamp) - elapsed_ns

    def on_answer(self, sent: Future) -> None:
        """Await the result of an accepted goal."""
        self._handle = sent.result()
        if self.accepted:
            self._ended = ended = self._handle.get_result_async()
            ended.add_done_callback(lambda _: self._lifeline.close())
            if self._withdrawn:
                self._handle.cancel_goal_async()
        else:
            self._lifeline.close()
