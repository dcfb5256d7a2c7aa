# SPDX-License-Identifier: Apache-2.0
"""What docs/interfaces.md states of the graph `sim`, and what a running graph shows of the same."""

from __future__ import annotations

import re
from pathlib import Path

from rclpy.action.graph import get_action_server_names_and_types_by_node
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from openarm_bringup.supervision.graph import load_graph
from tests.graph.asking import until

ROOT = Path(__file__).resolve().parents[2]
INTERFACES = (ROOT / "docs" / "interfaces.md").read_text(encoding="utf-8")
ROW = re.compile(r"^\| `(/[^`]+)` \| `([^`]+/(?:msg|srv|action)/[^`]+)` \|(.*)\|$", re.MULTILINE)
PARAMETER_ROW = re.compile(r"^\| (`[a-z_]+\.[^|]+) \| [^|]+ \| [^|]+ \|$", re.MULTILINE)
QOS = {
    "reliable": (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE),
    "latched": (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),
    "best effort": (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE),
}
#: What rclpy and actions add by themselves, subscriptions of the bridge and of move_group, and the camera info of the
#: spectator camera.
IMPLICIT = re.compile(
    r"/_action/|^/rosout$|^/parameter_events$|^/joint_commands$|/joint_trajectory$|^/cloud_in$"
    r"|^/spectator/color/camera_info$"
    # what clients of MoveIt publish
    r"|/servo_node/delta_(twist|joint)_cmds$"
    r"|^/collision_object$|^/attached_collision_object$|^/planning_scene$|^/trajectory_execution_event$"
)
#: Services that every node has, or every managed node.
STANDARD = (
    r"/_action/|/(describe|get|list|set)_parameter|get_type_description"
    r"|/get_available_(states|transitions)$|/get_transition_graph$"
)


def settled(node: Node) -> dict[str, list[str]]:
    """Return topics and types, once every stated topic has every stated publisher."""
    stated = stated_publishers()
    until(node, lambda: {name: publishers(node, name) for name in stated}, lambda seen: seen == stated)
    return dict(node.get_topic_names_and_types())


def stated_publishers() -> dict[str, list[str]]:
    """Return the nodes that publish each topic."""
    rows = [(name, rest.split("|")[1].strip()) for name, kind, rest in ROW.findall(INTERFACES) if "/msg/" in kind]
    everyone = sorted([*load_graph("sim").nodes, "move_group", "servo_node"])  # these of the process of motion
    return {name: everyone if who == "all" else sorted(w.strip() for w in who.split(",")) for name, who in rows}


def publishers(node: Node, topic: str) -> list[str]:
    """Return the nodes that publish a topic."""
    return sorted({info.node_name for info in node.get_publishers_info_by_topic(topic)})


def services(node: Node) -> dict[str, tuple[str, str]]:
    """Return services and actions by name: type, and the node that offers it."""
    found: dict[str, tuple[str, str]] = {}
    for offering, namespace in node.get_node_names_and_namespaces():
        if offering == node.get_name() or offering.startswith("openarm_probe"):
            continue
        offered = node.get_service_names_and_types_by_node(offering, namespace)
        actions = get_action_server_names_and_types_by_node(node, offering, namespace)
        for name, kinds in offered + actions:
            if not re.search(STANDARD, name):
                found[name] = (kinds[0], offering)
    return found


def stated_parameters() -> dict[str, set[str]]:
    """Return names of parameters by node."""
    stated: dict[str, set[str]] = {}
    for cell in PARAMETER_ROW.findall(INTERFACES):
        node = ""
        for name in re.findall(r"`([^`]+)`", cell):
            node = name.partition(".")[0] or node  # `.seed` is another parameter of the node before it
            stated.setdefault(node, set()).add(name.partition(".")[2])
    return stated
