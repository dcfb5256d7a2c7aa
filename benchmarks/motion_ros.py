# SPDX-License-Identifier: Apache-2.0
"""A client of the running motion node with a robot that stands still: it publishes joint states and asks for plans."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import Pose
from moveit_msgs.action import MoveGroup
from moveit_msgs.msg import Constraints, MoveItErrorCodes, OrientationConstraint, PositionConstraint
from openarm_interfaces.action import MoveArm
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState
from shape_msgs.msg import SolidPrimitive

from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import matrix_to_pose
from openarm_common.types import Array
from openarm_motion.planning.arm import Arm

BASE_FRAME = RobotDescription.load().base

_LIMIT = 30.0


class Client:
    """Use as a context.

    Args:
        state: The robot's joints, for ever.
    """

    def __init__(self, state: Mapping[str, float]) -> None:
        self._state = state

    def __enter__(self) -> Client:
        rclpy.init()
        self._node = rclpy.create_node("bench_motion")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._publisher = self._node.create_publisher(JointState, "/joint_states", 10)
        self._node.create_timer(0.01, self._publish)
        self._client = ActionClient(self._node, MoveArm, "/motion/move")
        self._moveit = ActionClient(self._node, MoveGroup, "/move_action")
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown()

    def measure(self, arms: Sequence[Arm], count: int, *, moveit: bool = False) -> tuple[list[float], list[float]]:
        """Seconds from sending a pose to having its trajectory, of `count` poses over the table.

        Args:
            arms: Asked in turns.
            count: Poses that are planned.
            moveit: Ask /move_action for the same poses, too.

        Returns:
            Of /motion/move, and of /move_action.
        """
        self._until(self._client.server_is_ready)
        self._until(self._moveit.server_is_ready)
        rng = np.random.default_rng(4)
        own: list[float] = []
        other: list[float] = []
        while len(own) < count + 2:
            arm = arms[len(own) % len(arms)]
            side = 1.0 if arm.name == "left" else -1.0
            p = rng.uniform((0.25, 0.02, 0.45), (0.45, 0.35, 0.65)) * (1.0, side, 1.0)
            yaw, tilt = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 0.7)
            pose = se3.make(se3.rot_z(yaw) @ se3.rot_x(np.pi - tilt), p)
            goal = MoveArm.Goal(arm=arm.name, kind=MoveArm.Goal.POSE, plan_only=True)
            goal.pose.header.frame_id = BASE_FRAME
            goal.pose.pose = matrix_to_pose(pose)
            seconds, result = self._timed(self._client, goal)
            if not result.success:
                continue
            if moveit:
                more, answer = self._timed(self._moveit, _move_group_goal(arm, pose))
                if answer.error_code.val != MoveItErrorCodes.SUCCESS:
                    raise RuntimeError(f"/move_action refused what /motion/move planned: {answer.error_code.message}")
                other.append(more)
            own.append(seconds)
        return own[2:], other[2:]  # the first of each arm sets things up

    def _timed(self, client: ActionClient, goal: Any) -> tuple[float, Any]:
        begin = time.perf_counter()
        result = self._ask(client, goal)
        return time.perf_counter() - begin, result

    def _ask(self, client: ActionClient, goal: Any) -> Any:
        sent: Any = client.send_goal_async(goal)
        self._until(sent.done)
        answer: Any = sent.result().get_result_async()
        self._until(answer.done)
        return answer.result().result

    def _until(self, done: Any) -> None:
        end = time.monotonic() + _LIMIT
        while not done():
            self._executor.spin_once(timeout_sec=0.1)
            if time.monotonic() > end:
                raise TimeoutError("the motion node does not answer")

    def _publish(self) -> None:
        message = JointState(name=list(self._state), position=list(self._state.values()))
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


def _move_group_goal(arm: Arm, pose: Array) -> MoveGroup.Goal:
    """The same pose as constraints, as MoveIt's clients write them."""
    there, tolerance = matrix_to_pose(pose), 1e-3
    place = PositionConstraint(link_name=arm.kinematics.tool_link)
    place.constraint_region.primitives = [SolidPrimitive(type=SolidPrimitive.SPHERE, dimensions=[tolerance])]
    place.constraint_region.primitive_poses = [Pose(position=there.position)]
    turn = OrientationConstraint(link_name=arm.kinematics.tool_link, orientation=there.orientation)
    turn.absolute_x_axis_tolerance = turn.absolute_y_axis_tolerance = turn.absolute_z_axis_tolerance = tolerance
    goal = MoveGroup.Goal()
    goal.request.group_name = f"{arm.name}_arm"
    goal.request.goal_constraints = [Constraints(position_constraints=[place], orientation_constraints=[turn])]
    goal.planning_options.plan_only = True
    return goal
