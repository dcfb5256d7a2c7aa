# SPDX-License-Identifier: Apache-2.0
"""The upstream types that the suite generates itself are the upstream types: the graph reports upstream's hashes.

The constants were computed from upstream's message text (tf2 for Jazzy, octomap_msgs 2.0.0, control_msgs 5.8.0,
vision_msgs 4.1.1), not from ours. A hash that differs means fields that a peer with the upstream package misreads.
"""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
from rclpy.action import ActionServer
from rosbags.rosbag2 import Reader
from type_description_interfaces.srv import GetTypeDescription

from openarm_bringup.bags.bag import BagWriter
from openarm_bringup.bags.ros.listener import from_profile
from openarm_common.ros.node import QOS_SENSOR

_MESSAGES = {
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "octomap_msgs/msg/Octomap": "9891a19a05b70ec20aa8f45db3f8300b9ab80afff32c61c549d25087da9625b0",
    "control_msgs/msg/GripperCommand": "57eb8f326c9889ca8bb34ead82cc94cc09bf6bc5c3b6c09546dca3a00b589890",
    "control_msgs/msg/JointTolerance": "c254f9cece0f3b733017b6990fd46d1326e25242d6b8844398c97d9a88e7d648",
    "control_msgs/msg/JointTrajectoryControllerState": (
        "51d8dd89cc624cbe9daaeeb4d80d6de9b86168ffdc3be41fefc0953e3c26e480"
    ),
    "vision_msgs/msg/Detection2DArray": "214274120007f4a683866481336b70310268cfa107aebe9d594a6acf75bda968",
    "vision_msgs/msg/Detection3DArray": "793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018",
}
_SERVICES = {
    "octomap_msgs/srv/BoundingBoxQuery": "5115fa060b6e9c8f7b1dba63dc318f4308e60ab936eede0986385768787dbe23",
    "octomap_msgs/srv/GetOctomap": "c43f2ceb835f797f3d2a2c3d9000e4691207d8c7bfb443119b4e90daaabb5d6c",
}
_ACTIONS = {
    "control_msgs/action/FollowJointTrajectory": "738ebcb7a2d7cfa42f9f1001cc99ce3a4383d1cfe508015d9be8485e4b1c66f6",
    "control_msgs/action/GripperCommand": "e17c0e644eccf14bea84a0a93e0977182872c2eb7873ca6694900059b46dbc84",
    "control_msgs/action/ParallelGripperCommand": "adfd3c1ebe8abc38ebcc0e454b6423d291d4010dd5697d14eca5b9be4726ae18",
}


def _type(name: str):
    package, kind, type_name = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), type_name)


def _describe(ros, name: str, sha256: str) -> GetTypeDescription.Response:
    """Ask the probe node, over the graph, for the type of this name and hash."""
    client = ros.node.create_client(GetTypeDescription, f"/{ros.node.get_name()}/get_type_description")
    return ros.call(client, GetTypeDescription.Request(type_name=name, type_hash=f"RIHS01_{sha256}"))


@pytest.mark.parametrize(("name", "sha256"), _MESSAGES.items(), ids=_MESSAGES)
def test_the_graph_reports_the_upstream_hash_of_a_message(ros, name: str, sha256: str) -> None:
    ros.node.create_publisher(_type(name), "/contract", 1)
    (endpoint,) = ros.node.get_publishers_info_by_topic("/contract")
    assert (endpoint.topic_type, str(endpoint.topic_type_hash)) == (name, f"RIHS01_{sha256}")


@pytest.mark.parametrize(("name", "sha256"), _MESSAGES.items(), ids=_MESSAGES)
def test_a_bag_declares_the_upstream_hash_of_a_message(tmp_path: Path, name: str, sha256: str) -> None:
    with BagWriter(tmp_path / "bag", {}) as writer:
        writer.add_topic("/contract", name, from_profile(QOS_SENSOR))
    with Reader(tmp_path / "bag") as reader:
        assert [connection.digest for connection in reader.connections] == [f"RIHS01_{sha256}"]


@pytest.mark.parametrize(("name", "sha256"), (_SERVICES | _ACTIONS).items(), ids=_SERVICES | _ACTIONS)
def test_a_node_describes_a_service_or_action_under_the_upstream_hash(ros, name: str, sha256: str) -> None:
    server = None
    if name in _ACTIONS:
        server = ActionServer(ros.node, _type(name), "/contract", execute_callback=lambda _: None)
    else:
        ros.node.create_service(_type(name), "/contract", lambda _, response: response)

    answer = _describe(ros, name, sha256)
    other = _describe(ros, name, sha256[::-1])

    assert answer.successful, f"{name} is not known under the upstream hash: {answer.failure_reason}"
    assert answer.type_description.type_description.type_name == name
    assert not other.successful  # the node compares: another hash is no answer
    if server is not None:
        server.destroy()
