# SPDX-License-Identifier: Apache-2.0
"""B-66: the bring-up in four steps, each a graph of its own; the fourth is test_graph.py."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import rclpy
from control_msgs.action import ParallelGripperCommand
from openarm_interfaces.action import MoveArm
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from vision_msgs.msg import Detection3DArray

from openarm_common.scene import load_scene

pytestmark = [pytest.mark.graph, pytest.mark.slow]


@contextmanager
def user(domain: int) -> Iterator[tuple[Node, SingleThreadedExecutor]]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node("plain_user", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


def newest(
    node: Node, executor: SingleThreadedExecutor, kind: Any, topic: str, good: Any, seconds: float = 20.0
) -> Any:
    """Spin until a message of the topic is good; return it."""
    found: list[Any] = []
    subscription = node.create_subscription(kind, topic, lambda m: found.append(m) if good(m) else None, 10)
    clock = node.get_clock()
    deadline = clock.now().nanoseconds + 20 * 10**9
    while not found:
        executor.spin_once(timeout_sec=0.1)
        assert clock.now().nanoseconds < deadline, f"nothing good on {topic}"
    node.destroy_subscription(subscription)
    return found[0]


def act(node: Node, executor: SingleThreadedExecutor, kind: Any, name: str, goal: Any) -> Any:
    """Send a goal and return its result."""
    client = ActionClient(node, kind, name)
    assert client.wait_for_server(timeout_sec=10.0)
    sent = client.send_goal_async(goal)
    executor.spin_until_future_complete(sent, timeout_sec=10.0)
    assert sent.result().accepted
    result = sent.result().get_result_async()
    executor.spin_until_future_complete(result, timeout_sec=60.0)
    assert result.done()
    return result.result().result


def test_b66_step_1_robot_alone_tells_its_joints_and_moves_a_gripper(start_graph: Any) -> None:
    up = start_graph("sim_only")
    up.wait_ready()
    with user(up.domain) as (node, executor):
        state = newest(node, executor, JointState, "/joint_states", lambda m: len(m.name) == 16)
        assert "openarm_left_joint1" in state.name
        goal = ParallelGripperCommand.Goal()
        goal.command.name = ["openarm_left_finger_joint1"]
        goal.command.position = [0.04]
        result = act(node, executor, ParallelGripperCommand, "/left_gripper_controller/gripper_cmd", goal)
        assert result.reached_goal
        assert result.state.position[0] == pytest.approx(0.04, abs=0.002)
    assert up.stop() == 0


def test_b66_step_2_every_object_is_seen_where_it_stands(start_graph: Any) -> None:
    up = start_graph("perception")
    up.wait_ready()
    scene = {item.label: item for item in load_scene("demo").objects}
    with user(up.domain) as (node, executor):
        seen = newest(node, executor, Detection3DArray, "/detections_3d", lambda m: len(m.detections) == len(scene))
    for detection in seen.detections:
        item = scene[detection.results[0].hypothesis.class_id]
        assert detection.bbox.center.position.x == pytest.approx(item.position[0], abs=0.01)
        assert detection.bbox.center.position.y == pytest.approx(item.position[1], abs=0.01)
    assert up.stop() == 0


def test_b66_step_3_an_arm_moves_to_a_posture_without_eyes(start_graph: Any) -> None:
    up = start_graph("motion")
    up.wait_ready()
    with user(up.domain) as (node, executor):
        state = newest(node, executor, JointState, "/joint_states", lambda m: len(m.name) == 16)
        names = [f"openarm_right_joint{i}" for i in range(1, 8)]
        now = dict(zip(state.name, state.position, strict=True))
        goal = MoveArm.Goal(arm="right", kind=MoveArm.Goal.JOINTS)
        goal.joint_positions = [now[name] for name in names]
        goal.joint_positions[6] += 0.3
        result = act(node, executor, MoveArm, "/motion/move", goal)
        assert result.success, f"{result.code}: {result.message}"
        newest(
            node,
            executor,
            JointState,
            "/joint_states",
            lambda m: abs(m.position[m.name.index(names[6])] - goal.joint_positions[6]) < 0.01,
        )
        home = act(
            node, executor, MoveArm, "/motion/move", MoveArm.Goal(arm="right", kind=MoveArm.Goal.NAMED, named="home")
        )
        assert home.success, f"{home.code}: {home.message}"
    assert up.stop() == 0
