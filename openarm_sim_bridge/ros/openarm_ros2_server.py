# SPDX-License-Identifier: Apache-2.0
"""The actions and topics of the controllers of openarm_ros2: of a gripper as of an arm."""

from __future__ import annotations

from concurrent.futures import Future as ThreadFuture
from typing import Any

from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTrajectoryControllerState
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from openarm_common.pacing import RateDivider
from openarm_common.ros.convert import ns_to_stamp
from openarm_common.ros.node import QOS_COMMAND, BaseNode
from openarm_control.follower import End
from openarm_control.ros.trajectory_server import trajectory_of
from openarm_control.trajectory import Trajectory, TrajectoryError, TrajectoryResult, checked
from openarm_sim_bridge.openarm_ros2 import PositionController
from openarm_sim_bridge.simulation import Simulation

#: Of controller_state, Hz.
STATE_RATE = 50.0


class PositionControllerServer:
    """follow_joint_trajectory, joint_trajectory and controller_state of one controller.

    Args:
        node: Owner.
        name: Name of the controller.
        controller: The controller.
        simulation: Simulation whose thread runs it.
    """

    def __init__(self, node: BaseNode[Any], name: str, controller: PositionController, simulation: Simulation) -> None:
        self._node, self._name, self._controller, self._simulation = node, name, controller, simulation
        self._server = ActionServer(
            node,
            FollowJointTrajectory,
            f"/{name}/follow_joint_trajectory",
            self._execute,
            cancel_callback=self._on_cancel,
        )
        self._states = node.create_publisher(JointTrajectoryControllerState, f"/{name}/controller_state", 10)
        node.create_subscription(JointTrajectory, f"/{name}/joint_trajectory", self._on_trajectory, QOS_COMMAND)
        self._ticks = RateDivider(STATE_RATE)

    def destroy(self) -> None:
        """Take the action away."""
        self._server.destroy()

    def publish_state(self, t_ns: int) -> None:
        """Publish controller_state when it is due, in the thread of the simulation."""
        if not self._ticks.due(t_ns):
            return
        controller = self._controller
        message = JointTrajectoryControllerState(joint_names=list(controller.group.names))
        message.header.stamp = ns_to_stamp(t_ns)
        message.reference = JointTrajectoryPoint(positions=controller.command.tolist())
        message.feedback = JointTrajectoryPoint(
            positions=controller.measured.tolist(), velocities=controller.velocity.tolist()
        )
        message.error = JointTrajectoryPoint(positions=(controller.command - controller.measured).tolist())
        message.output = message.reference
        self._states.publish(message)

    def _on_cancel(self, _: ServerGoalHandle) -> CancelResponse:
        self._simulation.call(self._controller.cancel)
        return CancelResponse.ACCEPT

    def _on_trajectory(self, message: JointTrajectory) -> None:
        goal = FollowJointTrajectory.Goal(trajectory=message)
        self._start(checked(trajectory_of(goal), self._controller.group), ThreadFuture())

    async def _execute(self, handle: ServerGoalHandle) -> FollowJointTrajectory.Result:
        ended: ThreadFuture[tuple[End, str]] = ThreadFuture()
        try:
            trajectory = checked(trajectory_of(handle.request), self._controller.group)
            await self._node.awaitable(self._start(trajectory, ended))
            end, text = await self._node.awaitable(ended)
            result = TrajectoryResult.SUCCESSFUL
        except TrajectoryError as error:
            end, text, result = End.ABORTED, error.message, error.result
        if end is End.SUCCEEDED:
            handle.succeed()
        elif end is End.CANCELLED and handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()
        return FollowJointTrajectory.Result(error_code=int(result), error_string=text)

    def _start(self, trajectory: Trajectory, ended: ThreadFuture[tuple[End, str]]) -> ThreadFuture[None]:
        def start() -> None:
            world = self._simulation.world
            self._controller.start(trajectory, world.t_ns, lambda end, text: ended.set_result((end, text)))

        return self._simulation.call(start)
