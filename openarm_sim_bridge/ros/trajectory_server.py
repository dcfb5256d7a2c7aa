# SPDX-License-Identifier: Apache-2.0
"""The controller of an arm on the graph: FollowJointTrajectory and the topics beside it.

A trajectory that is refused (unknown joints, NaN, out of limits, …) is accepted as a goal and aborted at once, because
only a result can carry the reason to the caller: `error_code` INVALID_GOAL or INVALID_JOINTS and `error_string`.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future as ThreadFuture
from typing import Any, Generic, TypeVar

from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTrajectoryControllerState
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from openarm_common.errors import OpenArmError
from openarm_common.ros.convert import ns_to_stamp, stamp_to_ns, trajectory_from_msg
from openarm_common.ros.node import QOS_COMMAND, BaseNode
from openarm_sim_bridge.control.actuation import End, FollowerState, TrajectoryFollower, TrajectoryOutcome
from openarm_sim_bridge.control.trajectory import JointTolerance, Trajectory, TrajectoryError, TrajectoryResult
from openarm_sim_bridge.simulation import Simulation

OutcomeT = TypeVar("OutcomeT")

FEEDBACK_PERIOD_S = 0.05
STATE_PERIOD_S = 0.05


class Waiting(Generic[OutcomeT]):
    """Waits in the executor for an outcome that comes from the thread of the simulation."""

    def __init__(self, node: BaseNode[Any]) -> None:
        self._node = node
        self.future = Future(executor=node.executor)

    def done(self, outcome: OutcomeT) -> None:
        """Take the outcome; from any thread."""
        self.future.set_result(outcome)
        self._wake()

    def started(self, start: ThreadFuture[None]) -> None:
        """Pass on why a goal was not started; from any thread."""
        if start.cancelled():
            self.future.cancel()
        elif (error := start.exception()) is not None:
            self.future.set_exception(error)
        self._wake()

    def _wake(self) -> None:
        # A future completed from another thread does not wake a waiting executor.
        if self._node.executor is not None:
            self._node.executor.wake()


class ArmActionServer:
    """/{side}_joint_trajectory_controller: follow_joint_trajectory, and the topics joint_trajectory, controller_state.

    Args:
        node: Owner.
        side: left or right.
        follower: Of the arm.
        simulation: Whose thread works the follower.
    """

    def __init__(self, node: BaseNode[Any], side: str, follower: TrajectoryFollower, simulation: Simulation) -> None:
        self._node = node
        self._side = side
        self._follower = follower
        self._simulation = simulation
        self._running: ServerGoalHandle | None = None
        self._columns = [simulation.world.joint_names.index(name) for name in follower.group.names]
        self._feedback_timer = node.create_timer(
            FEEDBACK_PERIOD_S, self._publish_feedback, clock=node.steady_clock, autostart=False
        )
        self._server = ActionServer(
            node,
            FollowJointTrajectory,
            f"/{side}_joint_trajectory_controller/follow_joint_trajectory",
            self._execute,
            cancel_callback=self._cancel,
        )
        controller = f"/{side}_joint_trajectory_controller"
        self._states = node.create_publisher(JointTrajectoryControllerState, f"{controller}/controller_state", 10)
        node.create_timer(STATE_PERIOD_S, self._publish_state, clock=node.steady_clock)
        node.create_subscription(JointTrajectory, f"{controller}/joint_trajectory", self._on_trajectory, QOS_COMMAND)

    def destroy(self) -> None:
        """Take the action away."""
        self._server.destroy()

    def _on_trajectory(self, message: JointTrajectory) -> None:
        """Follow a trajectory that nobody waits for; one that is refused is told in the log."""
        try:
            goal = FollowJointTrajectory.Goal(trajectory=message)
            trajectory = self._follower.check(_trajectory_of(goal))
        except OpenArmError as error:
            self._node.get_logger().error(f"{self._side} arm: joint_trajectory refused: {error}")
            return
        self._simulation.call(lambda: self._start(trajectory, self._on_end)).add_done_callback(self._on_started)

    def _on_started(self, start: ThreadFuture[None]) -> None:
        if not start.cancelled() and (error := start.exception()) is not None:
            self._node.get_logger().error(f"{self._side} arm: joint_trajectory refused: {error}")

    def _on_end(self, outcome: TrajectoryOutcome) -> None:
        if outcome.end is not End.SUCCEEDED:
            self._node.get_logger().warning(f"{self._side} arm: {outcome.text}")

    def _publish_state(self) -> None:
        state = self._follower.state
        if state is None or not self._states.get_subscription_count():
            return
        told = _feedback(self._follower.group.names, state)
        message = JointTrajectoryControllerState(joint_names=told.joint_names, header=told.header)
        message.reference, message.feedback, message.error = told.desired, told.actual, told.error
        message.output = told.desired
        self._states.publish(message)

    def _cancel(self, _handle: ServerGoalHandle) -> CancelResponse:
        self._simulation.call(self._follower.cancel)
        return CancelResponse.ACCEPT

    async def _execute(self, handle: ServerGoalHandle) -> FollowJointTrajectory.Result:
        waiting: Waiting[TrajectoryOutcome] = Waiting(self._node)
        try:
            trajectory = self._follower.check(_trajectory_of(handle.request))
            self._simulation.call(lambda: self._start(trajectory, waiting.done)).add_done_callback(waiting.started)
            if handle.is_cancel_requested:
                self._simulation.call(self._follower.cancel)
            self._running = handle
            self._feedback_timer.reset()
            outcome: Any = await waiting.future
        except OpenArmError as error:
            result = error.result if isinstance(error, TrajectoryError) else TrajectoryResult.INVALID_GOAL
            outcome = TrajectoryOutcome(End.ABORTED, result, f"{error.code}: {error.message}")
        if self._running is handle:
            self._running = None
            self._feedback_timer.cancel()
        return self._finish(handle, outcome)

    def _start(self, trajectory: Trajectory, done: Callable[[TrajectoryOutcome], None]) -> None:
        self._simulation.check_able()
        state = self._simulation.world.read_joints()
        self._follower.start(trajectory, state.t_ns, state.position[self._columns], done)

    def _finish(self, handle: ServerGoalHandle, outcome: TrajectoryOutcome | None) -> FollowJointTrajectory.Result:
        if outcome is None:
            outcome = TrajectoryOutcome(End.ABORTED, TrajectoryResult.INVALID_GOAL, "the simulation is shutting down")
        result = FollowJointTrajectory.Result(error_code=int(outcome.result), error_string=outcome.text)
        logger, text = self._node.get_logger(), f"{self._side} arm: {outcome.text}"
        if outcome.end is End.SUCCEEDED:
            handle.succeed()
        elif outcome.end is End.CANCELLED:
            handle.canceled()
            logger.info(text)
        else:
            handle.abort()
            logger.warning(text)
        return result

    def _publish_feedback(self) -> None:
        state = self._follower.state
        if self._running is not None and state is not None:
            self._running.publish_feedback(_feedback(self._follower.group.names, state))


def _trajectory_of(goal: FollowJointTrajectory.Goal) -> Trajectory:
    names, t, q, v, a = trajectory_from_msg(goal.trajectory)

    def tolerances(items: list[Any]) -> tuple[JointTolerance, ...]:
        return tuple(JointTolerance(item.name, item.position) for item in items)

    return Trajectory(
        names=tuple(names),
        t=t,
        q=q,
        v=v,
        a=a,
        start_ns=stamp_to_ns(goal.trajectory.header.stamp),
        path_tolerance=tolerances(goal.path_tolerance),
        goal_tolerance=tolerances(goal.goal_tolerance),
        goal_time_s=stamp_to_ns(goal.goal_time_tolerance) * 1e-9,
    )


def _feedback(names: tuple[str, ...], state: FollowerState) -> FollowJointTrajectory.Feedback:
    feedback = FollowJointTrajectory.Feedback(joint_names=list(names))
    feedback.header.stamp = ns_to_stamp(state.t_ns)
    feedback.desired = JointTrajectoryPoint(
        positions=state.desired.tolist(), velocities=state.desired_velocity.tolist()
    )
    feedback.actual = JointTrajectoryPoint(positions=state.actual.tolist(), velocities=state.actual_velocity.tolist())
    feedback.error = JointTrajectoryPoint(
        positions=(state.desired - state.actual).tolist(),
        velocities=(state.desired_velocity - state.actual_velocity).tolist(),
    )
    return feedback
