# SPDX-License-Identifier: Apache-2.0
"""docs/interfaces.md against the running graph: what it states exists with that type and QoS, and nothing else."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from rclpy.action.graph import get_action_server_names_and_types_by_node
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from openarm_common.domain import reserve_domain

ROOT = Path(__file__).resolve().parents[2]
INTERFACES = (ROOT / "docs" / "interfaces.md").read_text(encoding="utf-8")
ROW = re.compile(r"^\| `(/[^`]+)` \| `([^`]+/(?:msg|srv|action)/[^`]+)` \|(.*)\|$", re.MULTILINE)
PARAMETER_ROW = re.compile(r"^\| (`[a-z_]+\.[^|]+) \| [^|]+ \| [^|]+ \|$", re.MULTILINE)
QOS = {
    "reliable": (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE),
    "latched": (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),
    "best effort": (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE),
}
#: What rclpy and actions add by themselves, subscriptions of the bridge, and the camera info of the spectator camera.
IMPLICIT = re.compile(
    r"/_action/|^/rosout$|^/parameter_events$|^/joint_commands$|/joint_trajectory$|^/cloud_in$"
    r"|^/spectator/color/camera_info$"
)
#: Services that every node has, or every managed node.
STANDARD = (
    r"/_action/|/(describe|get|list|set)_parameter|get_type_description"
    r"|/get_available_(states|transitions)$|/get_transition_graph$"
)

pytestmark = pytest.mark.graph


@pytest.fixture(scope="module")
def graph() -> Iterator[Node]:
    """A probe in the domain of the running graph `sim`."""
    domain = reserve_domain()
    command = [sys.executable, "-m", "openarm_bringup.cli", "up", "sim", "--domain", str(domain)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        lines: list[str] = []
        for line in process.stdout:
            lines.append(line)
            if "is ready after" in line:
                break
        rclpy.init(domain_id=domain)
        node = rclpy.create_node("contract")
        try:
            if process.poll() is not None:
                pytest.fail("the graph did not start:\n" + "".join(lines))
            yield node
        finally:
            node.destroy_node()
            rclpy.try_shutdown()
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=30.0)


def _settled(node: Node) -> dict[str, list[str]]:
    """Topics and types, once every stated topic has every stated publisher (or 20 s later)."""
    for _ in range(200):
        if all(_publishers(node, name) == stated for name, stated in _stated_publishers().items()):
            break
        rclpy.spin_once(node, timeout_sec=0.1)
    return dict(node.get_topic_names_and_types())


def _stated_publishers() -> dict[str, list[str]]:
    rows = [(name, rest.split("|")[1].strip()) for name, kind, rest in ROW.findall(INTERFACES) if "/msg/" in kind]
    everyone = [
        "calibration_publisher",
        "cloud",
        "detector",
        "flight_recorder",
        "grasp",
        "motion",
        "mujoco_bridge",
        "octomap",
    ]
    everyone.append("wrist_detector")
    return {name: everyone if who == "all" else sorted(w.strip() for w in who.split(",")) for name, who in rows}


def _publishers(node: Node, topic: str) -> list[str]:
    return sorted({info.node_name for info in node.get_publishers_info_by_topic(topic)})


def test_topics_have_the_stated_type_publishers_and_qos(graph: Node) -> None:
    topics = _settled(graph)
    rows = [row for row in ROW.findall(INTERFACES) if "/msg/" in row[1]]
    assert len(rows) >= 25
    assert {name: _publishers(graph, name) for name, _, _ in rows} == _stated_publishers()
    for name, kind, rest in rows:
        assert topics[name] == [kind], name
        for info in graph.get_publishers_info_by_topic(name):
            qos = (info.qos_profile.reliability, info.qos_profile.durability)
            assert qos == QOS[rest.split("|")[0].strip()], name


def test_every_topic_is_stated(graph: Node) -> None:
    stated = {name for name, _, _ in ROW.findall(INTERFACES)}
    missing = [name for name in _settled(graph) if name not in stated and not IMPLICIT.search(name)]
    assert missing == []


def test_services_and_actions_have_the_stated_type_and_node(graph: Node) -> None:
    _settled(graph)
    rows = {
        name: (kind, rest.split("|")[0].strip()) for name, kind, rest in ROW.findall(INTERFACES) if "/msg/" not in kind
    }
    assert len(rows) >= 14
    for _ in range(200):
        found = _services(graph)
        if found == rows:
            break
        rclpy.spin_once(graph, timeout_sec=0.1)
    assert found == rows


def _services(node: Node) -> dict[str, tuple[str, str]]:
    """Services and actions by name: type, and the node that offers it."""
    found: dict[str, tuple[str, str]] = {}
    for offering, namespace in node.get_node_names_and_namespaces():
        if offering == node.get_name() or offering.startswith("openarm_probe"):
            continue
        services = node.get_service_names_and_types_by_node(offering, namespace)
        actions = get_action_server_names_and_types_by_node(node, offering, namespace)
        for name, kinds in services + actions:
            if not re.search(STANDARD, name):
                found[name] = (kinds[0], offering)
    return found


def test_parameters_exist_at_their_nodes(graph: Node) -> None:
    from rcl_interfaces.srv import ListParameters

    stated: dict[str, set[str]] = {}
    for cell in PARAMETER_ROW.findall(INTERFACES):
        node = ""
        for name in re.findall(r"`([^`]+)`", cell):
            node = name.partition(".")[0] or node  # `.seed` is another parameter of the node before it
            stated.setdefault(node, set()).add(name.partition(".")[2])
    assert {"mujoco_bridge", "detector", "octomap", "motion", "grasp"} <= stated.keys()
    for node, names in stated.items():
        client = graph.create_client(ListParameters, f"/{node}/list_parameters")
        assert client.wait_for_service(timeout_sec=20.0), node
        answer = client.call_async(ListParameters.Request())
        rclpy.spin_until_future_complete(graph, answer, timeout_sec=20.0)
        assert answer.done(), f"no answer of {node}"
        assert names <= set(answer.result().result.names), node


@pytest.mark.requirement("P-31")
def test_who_takes_images_unasked_is_a_lifecycle_node(graph: Node) -> None:
    _settled(graph)
    managed = {node for name, (kind, node) in _services(graph).items() if kind == "lifecycle_msgs/srv/ChangeState"}
    assert managed == {"octomap", "flight_recorder"}
    for topic in ("/overhead/color/image_raw", "/overhead/depth/image_raw", "/wrist/depth/image_raw"):
        taking = {info.node_name for info in graph.get_subscriptions_info_by_topic(topic)}
        assert taking <= managed, topic


@pytest.mark.requirement("A-73")
def test_one_publisher_for_each_edge_of_the_frame_tree(graph: Node) -> None:
    from tf2_msgs.msg import TFMessage

    from openarm_common.ros.node import QOS_STATIC_TF, QOS_TF

    parents: dict[str, set[tuple[str, str]]] = {}

    def note(kind: str, message: TFMessage) -> None:
        for edge in message.transforms:
            parents.setdefault(edge.child_frame_id, set()).add((edge.header.frame_id, kind))

    graph.create_subscription(TFMessage, "/tf", lambda m: note("/tf", m), QOS_TF)
    graph.create_subscription(TFMessage, "/tf_static", lambda m: note("/tf_static", m), QOS_STATIC_TF)
    wanted = {"overhead_color_optical_frame", "wrist_link", "openarm_right_hand_tcp", "openarm_left_link7", "table"}
    for _ in range(100):
        rclpy.spin_once(graph, timeout_sec=0.1)
        if wanted <= parents.keys():
            break
    assert wanted <= parents.keys()
    assert {child: edges for child, edges in parents.items() if len(edges) > 1} == {}
    roots = {parent for edges in parents.values() for parent, _ in edges} - parents.keys()
    assert roots == {"world"}
