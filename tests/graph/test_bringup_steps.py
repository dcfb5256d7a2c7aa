# SPDX-License-Identifier: Apache-2.0
"""B-66: the bring-up in four steps, each a graph of its own; the fourth is test_graph.py."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from control_msgs.action import ParallelGripperCommand
from openarm_interfaces.action import MoveArm
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState, PointCloud2
from vision_msgs.msg import Detection3DArray
from visualization_msgs.msg import Marker, MarkerArray

from openarm_bringup.bags.bag import open_bag
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import points_from_cloud
from openarm_common.scene.scene import load_scene

pytestmark = [pytest.mark.graph, pytest.mark.slow, pytest.mark.alone]


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


def newest(node: Node, executor: SingleThreadedExecutor, kind: Any, topic: str, good: Any) -> Any:
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


def texts(markers: MarkerArray) -> list[Marker]:
    return [marker for marker in markers.markers if marker.type == Marker.TEXT_VIEW_FACING]


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


@pytest.mark.requirement("B-66")
def test_step_1_robot_alone_tells_its_joints_and_moves_a_gripper(start_graph: Any) -> None:
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


@pytest.mark.requirement("B-66")
def test_step_2_every_object_is_seen_and_marked_where_it_stands(start_graph: Any) -> None:
    up = start_graph("perception")
    up.wait_ready()
    scene = {item.label: item for item in load_scene("demo").objects}
    with user(up.domain) as (node, executor):
        seen = newest(node, executor, Detection3DArray, "/detections_3d", lambda m: len(m.detections) == len(scene))
        drawn = newest(node, executor, MarkerArray, "/detection_markers", lambda m: len(texts(m)) == len(scene))
    places = {d.results[0].hypothesis.class_id: d.bbox.center.position for d in seen.detections}
    for found in (places, {text.text.split()[0]: text.pose.position for text in texts(drawn)}):
        assert found.keys() == scene.keys()
        for label, place in found.items():
            assert place.x == pytest.approx(scene[label].position[0], abs=0.01)
            assert place.y == pytest.approx(scene[label].position[1], abs=0.01)
    assert up.stop() == 0


@pytest.mark.requirement("B-66")
def test_step_3_an_arm_moves_to_a_posture_without_eyes(start_graph: Any) -> None:
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


@pytest.mark.requirement("A-77", "B-66")
def test_the_map_shows_the_objects_and_not_the_arms_and_the_step_is_recorded(start_graph: Any, tmp_path: Path) -> None:
    """The step between eyes and hands, and what a recording of it holds."""
    up = start_graph("map")
    up.wait_ready()
    bag = tmp_path / "step"
    topics = "/joint_states|/robot_description|/tf_static|/octomap_point_cloud_centers"
    done = up.openarm("record", str(bag), "--topics", topics, "--duration", "6", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    # P-31: at rest the map lets the cameras rest too
    topics_of_octomap = json.loads(up.openarm("node", "info", "octomap", "--json").stdout)["subscribes to"]
    assert "/overhead/depth/image_raw" in topics_of_octomap
    rests = up.openarm("service", "call", "/octomap/change_state", "{transition: {label: deactivate}}")
    assert rests.returncode == 0, rests.stdout + rests.stderr
    topics_of_octomap = json.loads(up.openarm("node", "info", "octomap", "--json").stdout)["subscribes to"]
    assert not {"/overhead/depth/image_raw", "/wrist/depth/image_raw", "/joint_states"} & set(topics_of_octomap)
    assert up.stop() == 0
    told = json.loads(done.stdout)
    assert told["lost"] == 0
    assert set(told["topics"]) == set(topics.split("|"))
    with open_bag(bag) as recorded:
        newest = {record.topic: record.data for record in recorded.records()}
    cells = points_from_cloud(deserialize_message(newest["/octomap_point_cloud_centers"], PointCloud2))
    for item in load_scene("demo").objects:
        x, y = item.position[:2]
        beside = np.hypot(cells[:, 0] - x, cells[:, 1] - y) < 0.04
        assert cells[beside, 2].max() > load_scene("demo").table.top_z + 0.03, item.name
    state = deserialize_message(newest["/joint_states"], JointState)
    joints = dict(zip(state.name, state.position, strict=True))
    for side in ("left", "right"):
        hand = RobotDescription.load().link_pose(f"openarm_{side}_hand", joints)[:3, 3]
        assert np.linalg.norm(cells - hand, axis=1).min() > 0.05
