# SPDX-License-Identifier: Apache-2.0
"""The action and topics of an arm controller: FollowJointTrajectory, joint_trajectory, controller_state.

An invalid trajectory (unknown joints, NaN, out of limits, …) is accepted as a goal and aborted at once, because only a
result can carry the reason to the client: `error_code` INVALID_GOAL or INVALID_JOINTS and `error_string`.

A client of this machine with a lifeline by the id of its goal has the arm hold when it ends or hangs. One of another
machine publishes the id on `owner`: the arm holds when discovery has forgotten it. For other clients goals run to their
end, as with ros2_control.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalInfo
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTrajectoryControllerState
from rclpy.action.server import ServerGoalHandle
from rclpy.duration import Duration as RclDuration
from std_msgs.msg import Float64
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from openarm_common import lifeline
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.actions import fastest_topic, latest, owner_topic
from openarm_common.ros.convert import ns_to_stamp, stamp_to_ns, trajectory_from_msg
from openarm_common.ros.node import QOS_COMMAND, BaseNode
from openarm_common.types import Array
from openarm_control.arm import End, FollowerState, TrajectoryFollower, TrajectoryOutcome
from openarm_control.loop import ControlLoop
from openarm_control.ros.controller_server import ControllerServer
from openarm_control.trajectory import Trajectory, TrajectoryError, TrajectoryResult

FEEDBACK_PERIOD_S = 0.05
#: A client of this machine that shows no sign of life for so long while its goal runs is stopped, or hangs, s.
_SILENT_S = 2.0


class TrajectoryServer(ControllerServer[TrajectoryOutcome]):
    """/{side}_joint_trajectory_controller: follow_joint_trajectory, joint_trajectory, controller_state, fastest.

    Args:
        node: Owner.
        prefix: Prefix of its names.
        side: left or right.
        arm: Its controller.
        loop: Loop whose thread runs the controller.
        check: Refuses a goal, by its id, while another client holds the arm.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        prefix: str,
        side: str,
        arm: TrajectoryFollower,
        loop: ControlLoop,
        check: Callable[[bytes], None],
    ) -> None:
        self._arm = arm
        self._running: ServerGoalHandle | None = None
        self._replacing = False
        controller = f"{prefix}/{side}_joint_trajectory_controller"
        self._feedback_timer = node.create_timer(
            FEEDBACK_PERIOD_S, self._publish_feedback, clock=node.steady_clock, autostart=False
        )
        super().__init__(
            node,
            loop,
            check,
            f"{side} arm",
            FollowJointTrajectory,
            f"{controller}/follow_joint_trajectory",
            arm.cancel,
        )
        self._states = node.create_publisher(JointTrajectoryControllerState, f"{controller}/controller_state", 10)
        on_trajectory: Any = self._on_trajectory  # rclpy awaits coroutines; its type hints do not allow them
        node.create_subscription(JointTrajectory, f"{controller}/joint_trajectory", on_trajectory, QOS_COMMAND)
        action = f"{controller}/follow_joint_trajectory"
        self._limit, self._fastest = node.create_publisher(Float64, fastest_topic(action), latest()), math.inf
        self._owner_topic = owner_topic(action)
        #: Of the client of the goal that runs, if it is of this machine.
        self._lifeline: lifeline.Watched | None = None
        #: The newest goal of an owner, and how many publish there.
        self._owned, self._owners = b"", 0
        node.create_subscription(GoalInfo, self._owner_topic, self._on_owner, latest())

    def _on_owner(self, info: GoalInfo) -> None:
        """Take note of a goal that may run only while its owner lives."""
        self._owned, self._owners = bytes(info.goal_id.uuid), self._node.count_publishers(self._owner_topic)

    def _check_owner(self, goal: bytes) -> None:
        """Hold when the client of the goal that runs hangs, or is of another machine and gone."""
        if self._lifeline is not None:
            if self._lifeline.silence >= _SILENT_S:
                self._lose(goal, f"the client of the goal has shown no sign of life for {_SILENT_S:g} s")
        elif goal == self._owned and self._node.count_publishers(self._owner_topic) < self._owners:
            self._lose(goal, "the client of the goal is gone")

    def _lose(self, goal: bytes, why: str) -> None:
        """Hold: nothing watches the motion any more."""
        running = self._running
        if running is not None and bytes(running.goal_id.uuid) == goal:
            self._loop.call(lambda: self._arm.hold(f"{why}; the arm holds where it is"))

    async def _on_trajectory(self, message: JointTrajectory) -> None:
        """Follow a trajectory that comes as a message; a refusal goes to the log."""
        try:
            self._check(b"")
            trajectory = self._arm.check(trajectory_of(FollowJointTrajectory.Goal(trajectory=message)))
            await self._node.awaitable(self._loop.call(lambda: self._replace(trajectory)))
        except OpenArmError as error:
            text = f"{self._label}: joint_trajectory refused: {error}"
            self._node.get_logger().error(text, throttle_duration_sec=1.0)

    def _replace(self, trajectory: Trajectory) -> None:
        """Follow a trajectory of a message in place of that of the last one, which is no failure of it."""
        self._replacing = True
        try:
            self._start(trajectory, self._on_end)
        finally:
            self._replacing = False

    def _on_end(self, outcome: TrajectoryOutcome) -> None:
        if outcome.end is not End.SUCCEEDED and not self._replacing:
            self._node.get_logger().warning(f"{self._label}: {outcome.text}")

    async def _execute(self, handle: ServerGoalHandle) -> FollowJointTrajectory.Result:
        try:
            trajectory = self._arm.check(trajectory_of(handle.request))
            self._running, goal = handle, bytes(handle.goal_id.uuid)
            self._lifeline = lifeline.watch(goal.hex(), lambda: self._lose(goal, "the client of the goal has ended"))
            self._feedback_timer.reset()
            outcome = await self._follow(handle, lambda done: self._start(trajectory, done))
        except OpenArmError as error:
            stopped = error.code is Code.STOPPED
            refused = TrajectoryResult.STOPPED if stopped else TrajectoryResult.INVALID_GOAL
            result = error.result if isinstance(error, TrajectoryError) else refused
            outcome = TrajectoryOutcome(End.ABORTED, result, f"{error.code}: {error.message}")
        if self._running is handle:
            self._running = None
            self._feedback_timer.cancel()
        self._end(handle, outcome.end, outcome.text)
        return FollowJointTrajectory.Result(error_code=int(outcome.result), error_string=outcome.text)

    def _start(self, trajectory: Trajectory, done: Callable[[TrajectoryOutcome], None]) -> None:
        self._loop.check_able()
        state = self._loop.read_joints(self._arm.group)
        self._arm.start(trajectory, state.t_ns, state.position, done)

    def publish_state(self) -> None:
        """Publish controller_state to its subscribers, and a new speed limit, at the end of a tick of the loop."""
        if self._arm.fastest != self._fastest:
            self._fastest = self._arm.fastest
            self._limit.publish(Float64(data=self._fastest))
        state = self._arm.state
        if state is None or not self._states.get_subscription_count():
            return
        part = _feedback(self._arm.group.names, state)
        message = JointTrajectoryControllerState(joint_names=part.joint_names, header=part.header)
        message.reference, message.feedback, message.error = part.desired, part.actual, part.error
        message.output = JointTrajectoryPoint(positions=state.target.tolist())
        self._states.publish(message)

    def _publish_feedback(self) -> None:
        state = self._arm.state
        if self._running is not None and state is not None:
            self._running.publish_feedback(_feedback(self._arm.group.names, state))
            self._check_owner(bytes(self._running.goal_id.uuid))


def trajectory_of(goal: FollowJointTrajectory.Goal) -> Trajectory:
    """Return the trajectory of a goal."""
    names, t, q, v, a = trajectory_from_msg(goal.trajectory)
    return Trajectory(
        names=tuple(names),
        t=t,
        q=q,
        v=v,
        a=a,
        start_ns=stamp_to_ns(goal.trajectory.header.stamp),
        path_tolerance={item.name: item.position for item in goal.path_tolerance},
        goal_tolerance={item.name: item.position for item in goal.goal_tolerance},
        goal_time_s=stamp_to_ns(goal.goal_time_tolerance) * 1e-9,
    )


def _feedback(names: tuple[str, ...], state: FollowerState) -> FollowJointTrajectory.Feedback:
    feedback = FollowJointTrajectory.Feedback(joint_names=list(names))
    feedback.header.stamp = ns_to_stamp(state.t_ns)
    feedback.desired = _point(state.desired, state.desired_velocity)
    feedback.desired.time_from_start = RclDuration(seconds=state.time_from_start).to_msg()
    feedback.actual = _point(state.actual, state.actual_velocity)
    feedback.error = _point(state.desired - state.actual, state.desired_velocity - state.actual_velocity)
    return feedback


def _point(position: Array, velocity: Array) -> JointTrajectoryPoint:
    return JointTrajectoryPoint(positions=position.tolist(), velocities=velocity.tolist())
