# SPDX-License-Identifier: Apache-2.0
"""Follows trajectories of one arm: sends them to its FollowJointTrajectory controller, watches, and checks the end.

Time of the robot is the stamp of the joint states, so a slow or paused simulation does not count as a stuck arm; time
without any joint state is wall clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionClient
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectory

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import BaseNode
from openarm_common.ros.tf import RobotStateListener
from openarm_motion.config import MotionConfig
from openarm_motion.planning.arm import Arm
from openarm_motion.scene.memory import HeldMemory
from openarm_motion.timing.checks import Motion

#: Between two looks at a running motion, s of wall clock.
_WATCH = 0.05
#: A joint state no older than this shows where the robot is, s of wall clock.
_FRESH = 0.5
#: A controller has this long to accept, to refuse, or to end a cancelled motion, s of wall clock.
_ANSWER = 2.0
#: A controller that has not been in the graph for so long is gone, s: discovery may lose it for a moment.
_GONE = 1.0
#: Joint states and controller have this long to appear before a motion, s of wall clock.
_READY = 1.0

_RESULT = FollowJointTrajectory.Result
_FAULTS = {
    _RESULT.INVALID_GOAL: "INVALID_GOAL",
    _RESULT.INVALID_JOINTS: "INVALID_JOINTS",
    _RESULT.OLD_HEADER_TIMESTAMP: "OLD_HEADER_TIMESTAMP",
    _RESULT.PATH_TOLERANCE_VIOLATED: "PATH_TOLERANCE_VIOLATED",
    _RESULT.GOAL_TOLERANCE_VIOLATED: "GOAL_TOLERANCE_VIOLATED",
}


@dataclass(frozen=True)
class Running:
    """A motion on its way, and the robot time of its beginning."""

    motion: Motion
    since_ns: int

    def rest(self, now_ns: int) -> Motion:
        """What is left of it, beginning now."""
        return self.motion.later((self.since_ns - now_ns) * 1e-9)


@dataclass(frozen=True, eq=False)
class Robot:
    """What all that plans and carries out motions needs of the robot and the node that serves it.

    Attributes:
        node: Owns executor, threads, publishers and parameters.
        states: Joint states.
        arms: By name.
        followers: Of each arm: what is under way.
        held: What the hands hold.
    """

    node: BaseNode[MotionConfig]
    states: RobotStateListener
    arms: Mapping[str, Arm]
    followers: Mapping[str, Follower]
    held: HeldMemory


class Follower:
    """Executes one motion of one arm at a time.

    Args:
        node: The node that owns client and timers.
        arm: The arm.
        states: The robot's joint states.
    """

    def __init__(self, node: BaseNode[Any], arm: Arm, states: RobotStateListener) -> None:
        self._node, self._arm, self._states = node, arm, states
        self._topic = arm.config.controller.format(arm=arm.name)
        self._client = ActionClient(node, FollowJointTrajectory, self._topic)
        self.running: Running | None = None

    def set_out(self, motion: Motion, begin_ns: int = 0) -> None:
        """Count as under way from a moment on, robot time; 0 is now."""
        self.running = Running(motion, begin_ns or self._states.buffer.latest()[0])

    async def follow(
        self,
        message: JointTrajectory,
        motion: Motion,
        cancelled: Callable[[], bool],
        progress: Callable[[float], None],
    ) -> None:
        """Send a trajectory and return when the arm has arrived.

        Args:
            message: The trajectory, as it goes to the controller; it begins at its stamp, or at once when that is 0.
            motion: The same for the checks.
            cancelled: Whether to stop; the controller then holds.
            progress: Called with 0 to 1 while the arm moves.

        Raises:
            OpenArmError: NOT_READY, without controller or joint states; ROBOT_LOST, when either vanishes on the way;
                EXECUTION_FAILED, with the controller's reason or the joint that did not arrive; TIMEOUT; CANCELLED.
        """
        watch = Watch(self._node, self._states)
        self.set_out(motion, stamp_to_ns(message.header.stamp))
        try:
            await self._require_ready(watch)
            await self._send(watch, message, motion, cancelled, progress)
            await self._arrive(watch, motion, cancelled)
        finally:
            self.running = None
            watch.close()
        progress(1.0)

    async def _require_ready(self, watch: Watch) -> None:
        await watch.fresh()
        if not await watch.until(self._client.server_is_ready, lambda: None, _READY):
            raise OpenArmError(Code.NOT_READY, f"no controller offers {self._topic}; is the bridge or driver running?")

    async def _send(
        self,
        watch: Watch,
        message: JointTrajectory,
        motion: Motion,
        cancelled: Callable[[], bool],
        progress: Callable[[float], None],
    ) -> None:
        goal = FollowJointTrajectory.Goal(trajectory=message)
        sent = self._client.send_goal_async(goal)
        try:
            if not await watch.until(sent.done, lambda: self._raise_if_lost(watch), _ANSWER):
                raise OpenArmError(Code.ROBOT_LOST, f"{self._topic} did not answer a goal within {_ANSWER:g} s")
        except OpenArmError:
            # should it be accepted yet, it is withdrawn
            sent.add_done_callback(lambda f: f.result().cancel_goal_async() if f.result().accepted else None)
            raise
        handle: Any = sent.result()
        if not handle.accepted:
            raise OpenArmError(Code.EXECUTION_FAILED, f"{self._topic} rejected the trajectory")
        if not stamp_to_ns(message.header.stamp):
            self.set_out(motion)  # it begins when it is accepted
        result = handle.get_result_async()
        limit_ns = (motion.duration + self._arm.config.execution.overtime) * 1e9
        cancelling: Future | None = None

        def look() -> None:
            nonlocal cancelling
            self._raise_if_lost(watch)
            elapsed = self._elapsed_ns()
            progress(min(1.0, max(0.0, elapsed * 1e-9 / max(motion.duration, 1e-3))))
            if elapsed > limit_ns:
                raise OpenArmError(
                    Code.TIMEOUT,
                    f"{self._topic} has not ended {elapsed * 1e-9:.1f} s after a start of {motion.duration:.1f} s",
                )
            if cancelling is None and cancelled():
                cancelling = handle.cancel_goal_async()
                watch.restart()
            if cancelling is not None and watch.elapsed() > _ANSWER:
                raise OpenArmError(Code.CANCELLED, f"cancelled, but {self._topic} did not confirm that it holds")

        try:
            await watch.until(result.done, look, math.inf)
        except OpenArmError:
            handle.cancel_goal_async()
            raise
        answer = result.result().result
        if cancelling is not None and answer.error_code != _RESULT.SUCCESSFUL:
            raise OpenArmError(Code.CANCELLED, f"cancelled; the {self._arm.name} arm holds where it is")
        if answer.error_code != _RESULT.SUCCESSFUL:
            fault = _FAULTS.get(answer.error_code, str(answer.error_code))
            reason = f": {answer.error_string}" if answer.error_string else ""
            raise OpenArmError(Code.EXECUTION_FAILED, f"controller of the {self._arm.name} arm: {fault}{reason}")
        if cancelling is not None and cancelled():
            raise OpenArmError(Code.CANCELLED, f"cancelled as the {self._arm.name} arm arrived; it holds there")

    async def _arrive(self, watch: Watch, motion: Motion, cancelled: Callable[[], bool]) -> None:
        """Wait until the joints are where the motion ends; what a controller says is not evidence."""
        config = self._arm.config.execution
        arrived_ns = self._states.buffer.latest()[0]

        def ended() -> bool:
            late = self._states.buffer.latest()[0] - arrived_ns > config.settle * 1e9
            return late or cancelled() or not self._missed(motion)

        await watch.until(ended, lambda: self._raise_if_lost(watch), math.inf)
        missed = self._missed(motion)
        if missed:
            if cancelled():
                raise OpenArmError(Code.CANCELLED, f"cancelled; the {self._arm.name} arm holds where it is")
            raise OpenArmError(Code.EXECUTION_FAILED, f"{missed}; blocked?")

    def _missed(self, motion: Motion) -> str:
        """How far from its end the arm is, in a sentence; empty when it is there."""
        config = self._arm.config.execution
        name, error = self._worst(motion)
        if error > config.goal_tolerance:
            return f"{name} ended {error:.3f} rad from its goal, expected within {config.goal_tolerance:g}"
        now = self._states.buffer.latest()[1]
        ends = self._arm.kinematics.fk_many(np.array([motion.q[-1], [now[name] for name in motion.names]]))
        gap = float(np.linalg.norm(ends[0, :3, 3] - ends[1, :3, 3]))
        if gap > config.tool_tolerance:
            return f"the tool ended {gap * 1e3:.1f} mm from its goal, expected within {config.tool_tolerance * 1e3:g}"
        return ""

    def _worst(self, motion: Motion) -> tuple[str, float]:
        now = self._states.buffer.latest()[1]
        errors = {name: abs(now[name] - float(motion.q[-1, i])) for i, name in enumerate(motion.names)}
        name = max(errors, key=lambda key: errors[key])
        return name, errors[name]

    def _elapsed_ns(self) -> int:
        return self._states.buffer.latest()[0] - self.running.since_ns if self.running else 0

    def _raise_if_lost(self, watch: Watch) -> None:
        limit = self._arm.config.execution.stale_after
        if watch.silence > limit:
            age = self._states.age_s()
            raise OpenArmError(Code.ROBOT_LOST, f"no /joint_states for {age:.1f} s, expected one within {limit:g} s")
        watch.missing = 0.0 if self._client.server_is_ready() else watch.missing + _WATCH
        if watch.missing > _GONE:
            raise OpenArmError(Code.ROBOT_LOST, f"controller {self._topic} is gone")


class Watch:
    """Wakes a coroutine at a steady pace until something holds, and counts how long the robot has been silent.

    Args:
        node: The node that owns the timer.
        states: The robot's joint states.
    """

    def __init__(self, node: BaseNode[Any], states: RobotStateListener) -> None:
        self._node, self._states = node, states
        self._next = Future(executor=node.executor)
        self._timer = node.create_timer(_WATCH, self._tick, clock=node.steady_clock)
        self._last_ns = self._start_ns = node.steady_clock.now().nanoseconds
        #: How long the controller has not been in the graph, s.
        self.missing = 0.0
        #: How long this process was awake without a joint state, s: messages wait unread while it is not.
        self.silence = 0.0

    def restart(self) -> None:
        """Count `elapsed` from now."""
        self._start_ns = self._node.steady_clock.now().nanoseconds

    def elapsed(self) -> float:
        """Wall clock since the beginning or the last `restart`, s."""
        return (self._node.steady_clock.now().nanoseconds - self._start_ns) * 1e-9

    async def until(self, done: Callable[[], bool], look: Callable[[], None], limit: float) -> bool:
        """Call `look` at each wake until `done` or for `limit` seconds; returns whether it is done."""
        self.restart()
        while not done():
            if self.elapsed() > limit:
                return False
            await self._next
            if done():
                break
            look()
        return True

    async def fresh(self) -> None:
        """Wait a moment for a fresh joint state.

        Raises:
            OpenArmError: NOT_READY, when none comes.
        """
        if not await self.until(lambda: self._states.age_s() <= _FRESH, lambda: None, _READY):
            raise stale(self._states.age_s())

    def close(self) -> None:
        """Stop waking."""
        self._node.destroy_timer(self._timer)

    def _tick(self) -> None:
        now = self._node.steady_clock.now().nanoseconds
        awake = min((now - self._last_ns) * 1e-9, 2.0 * _WATCH)
        self._last_ns = now
        self.silence = min(self._states.age_s(), self.silence + awake)
        current, self._next = self._next, Future(executor=self._node.executor)
        current.set_result(None)


def stale(age: float) -> OpenArmError:
    """The error for joint states that are `age` seconds old."""
    when = "none yet" if math.isinf(age) else f"the last is {age:.1f} s old"
    return OpenArmError(Code.NOT_READY, f"no fresh /joint_states ({when}); is the bridge or driver running?")
