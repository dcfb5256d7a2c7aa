# SPDX-License-Identifier: Apache-2.0
"""B-66: the bring-up in steps, each a graph of its own; the map is test_bringup_map.py, the last is test_graph.py."""

from __future__ import annotations

import resource
import signal
from typing import Any

import psutil
import pytest
import rclpy
from control_msgs.action import ParallelGripperCommand
from openarm_interfaces.action import MoveArm
from rclpy.node import Node
from sensor_msgs.msg import JointState
from vision_msgs.msg import Detection3DArray
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common.ros.actions import ActionClient
from openarm_common.scene.scene import load_scene
from tests.conftest import DEADLINE_S
from tests.graph.asking import until, user

pytestmark = [pytest.mark.graph, pytest.mark.long]


def newest(node: Node, kind: Any, topic: str, good: Any) -> Any:
    """Spin until a message of the topic is good; return it."""
    found: list[Any] = []
    subscription = node.create_subscription(kind, topic, lambda m: found.append(m) if good(m) else None, 10)
    assert until(node, lambda: found, bool), f"nothing good on {topic}"
    node.destroy_subscription(subscription)
    return found[0]


def texts(markers: MarkerArray) -> list[Marker]:
    return [marker for marker in markers.markers if marker.type == Marker.TEXT_VIEW_FACING]


def act(node: Node, kind: Any, name: str, goal: Any) -> Any:
    """Send a goal and return its result."""
    client = ActionClient(node, kind, name)
    assert client.wait_for_server(timeout_sec=DEADLINE_S)
    sent = client.send_goal_async(goal)
    rclpy.spin_until_future_complete(node, sent, timeout_sec=DEADLINE_S)
    assert sent.result().accepted
    result = sent.result().get_result_async()
    rclpy.spin_until_future_complete(node, result, timeout_sec=DEADLINE_S)
    assert result.done()
    return result.result().result


@pytest.fixture(scope="module")
def robot(start_graph: Any) -> Any:
    """The graph of the robot without anything else, ready."""
    up = start_graph("sim_only")
    up.wait_ready()
    return up


@pytest.mark.requirement("B-66")
def test_step_1_robot_alone_publishes_its_joints_and_moves_a_gripper(robot: Any) -> None:
    with user(robot.domain) as node:
        state = newest(node, JointState, "/joint_states", lambda m: len(m.name) == 16)
        assert "openarm_left_joint1" in state.name
        goal = ParallelGripperCommand.Goal()
        goal.command.name = ["openarm_left_finger_joint1"]
        goal.command.position = [0.04]
        result = act(node, ParallelGripperCommand, "/left_gripper_controller/gripper_cmd", goal)
        assert result.reached_goal
        assert result.state.position[0] == pytest.approx(0.04, abs=0.002)


@pytest.mark.requirement("R-26")
def test_commands_cost_little_next_to_the_graph_and_work_when_their_daemon_has_died(robot: Any) -> None:
    def daemons() -> list[psutil.Process]:
        children = psutil.Process(robot.process.pid).children()
        return [child for child in children if "openarm_bringup.daemon" in child.cmdline()]

    def cpu_s(*words: str) -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = robot.openarm(*words)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert done.returncode == 0, done.stderr
        assert done.stdout
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    looks = ("topic list", "topic echo /joint_states -n 1", "param get mujoco_bridge scene", "tf echo world wrist_link")
    # CPU time, not the clock: tests run next to other work. One that joins the graph takes 2 s.
    answered = [min(cpu_s(*look.split()) for _ in range(3)) for look in looks]
    assert max(answered) < 0.6
    (daemon,) = daemons()
    daemon.kill()
    for look in looks:
        assert cpu_s(*look.split()) > 0.0
    assert robot.record()["ready"]
    assert daemon.pid not in [other.pid for other in daemons()]


@pytest.mark.requirement("P-34")
def test_a_second_start_in_the_same_domain_works(start_graph: Any, robot: Any) -> None:
    assert robot.stop(signal.SIGTERM) == 0
    second = start_graph("sim_only", joining=robot)
    assert second.domain == robot.domain
    second.wait_ready()
    assert second.stop() == 0


@pytest.mark.requirement("B-66")
def test_step_2_every_object_is_seen_and_marked_where_it_stands(start_graph: Any) -> None:
    up = start_graph("perception")
    up.wait_ready()
    scene = {item.label: item for item in load_scene("demo").objects}
    with user(up.domain) as node:
        seen = newest(node, Detection3DArray, "/detections_3d", lambda m: len(m.detections) == len(scene))
        drawn = newest(node, MarkerArray, "/detection_markers", lambda m: len(texts(m)) == len(scene))
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
    with user(up.domain) as node:
        state = newest(node, JointState, "/joint_states", lambda m: len(m.name) == 16)
        names = [f"openarm_right_joint{i}" for i in range(1, 8)]
        now = dict(zip(state.name, state.position, strict=True))
        goal = MoveArm.Goal(arm="right", kind=MoveArm.Goal.JOINTS)
        goal.joint_positions = [now[name] for name in names]
        goal.joint_positions[6] += 0.3
        result = act(node, MoveArm, "/motion/move", goal)
        assert result.success, f"{result.code}: {result.message}"
        newest(
            node,
            JointState,
            "/joint_states",
            lambda m: abs(m.position[m.name.index(names[6])] - goal.joint_positions[6]) < 0.01,
        )
        home = act(node, MoveArm, "/motion/move", MoveArm.Goal(arm="right", kind=MoveArm.Goal.NAMED, named="home"))
        assert home.success, f"{home.code}: {home.message}"
    assert up.stop() == 0
