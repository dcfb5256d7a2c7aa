# SPDX-License-Identifier: Apache-2.0
"""A client of the running motion node with a robot that stands still: it publishes joint states and asks for plans."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rclpy
from openarm_interfaces.action import MoveArm
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState

from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import matrix_to_pose
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
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown()

    def measure(self, arms: Sequence[Arm], count: int) -> list[float]:
        """Seconds from sending a pose to having its trajectory, of `count` poses over the table."""
        self._until(self._client.server_is_ready)
        rng = np.random.default_rng(4)
        times: list[float] = []
        while len(times) < count + 2:
            arm = arms[len(times) % len(arms)]
            side = 1.0 if arm.name == "left" else -1.0
            p = rng.uniform((0.25, 0.02, 0.45), (0.45, 0.35, 0.65)) * (1.0, side, 1.0)
            yaw, tilt = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 0.7)
            pose = se3.make(se3.rot_z(yaw) @ se3.rot_x(np.pi - tilt), p)
            goal = MoveArm.Goal(arm=arm.name, kind=MoveArm.Goal.POSE, plan_only=True)
            goal.pose.header.frame_id = BASE_FRAME
            goal.pose.pose = matrix_to_pose(pose)
            begin = time.perf_counter()
            result = self._ask(goal)
            if result.success:
                times.append(time.perf_counter() - begin)
        return times[2:]  # the first of each arm sets things up

    def _ask(self, goal: MoveArm.Goal) -> Any:
        sent: Any = self._client.send_goal_async(goal)
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
