# SPDX-License-Identifier: Apache-2.0
"""The upstream types that the suite generates itself are the upstream types: the graph reports upstream's hashes.

The constants were computed from upstream's message text (tf2 for Jazzy, octomap_msgs 2.0.0, control_msgs 5.8.0,
vision_msgs 4.1.1, moveit_msgs 2.6.0), not from ours. A hash that differs means fields that a peer with the upstream
package misreads.
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
    "control_msgs/msg/JointJog": "ba249455a20f70168a1acb7bf43b776b72ff1f7eb5fc4cfea443f749e963c6e7",
    "moveit_msgs/msg/AttachedCollisionObject": "7fdfe7951a33a857f20fc42c9ed410a38d06dd0c209ac774ecea746dc487dc41",
    "moveit_msgs/msg/CollisionObject": "74b0acd6d56be032bf4f764b2c2633f50588b5fb2bd71e97206c59052747cf7e",
    "moveit_msgs/msg/DisplayTrajectory": "dd351cbd6d9986eb019306910ec09236a136a02dbc0b3465707cb62f2d56e22b",
    "moveit_msgs/msg/MotionPlanRequest": "f82ed20da5f8f93146999c1a3cfe34b56b97fc10333b40cac69782a1210888d7",
    "moveit_msgs/msg/PlanningScene": "0f58540ad5eab4b9ea827d53b763c793d8cabd202b3b301fcee25afa4ce1bd80",
    "moveit_msgs/msg/ServoStatus": "882a75f7648d6f8a9bf528e4787f51c58f2d5d88b702e450443d99f270e6936b",
    "octomap_msgs/msg/OctomapWithPose": "e65f8760aa96a2acef86b6d206175cfc78420082b6159dd3fa6ebf93f5f81979",
    "vision_msgs/msg/Detection2DArray": "214274120007f4a683866481336b70310268cfa107aebe9d594a6acf75bda968",
    "vision_msgs/msg/Detection3DArray": "793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018",
}
_SERVICES = {
    "moveit_msgs/srv/ApplyPlanningScene": "8e6134783db0987c0acedbfd2f16f608a8f7a54e83a7bbb372e851af419f4d72",
    "moveit_msgs/srv/GetCartesianPath": "b19f501df5d378141d918199894c3ad24533e76021a880b15dc5d62fec8d7b1a",
    "moveit_msgs/srv/GetMotionPlan": "0e118e1d8d53d5fea8eea309fc06a58239fa0e617864127e7de8399ab7335b27",
    "moveit_msgs/srv/GetPlanningScene": "7ed7e96238b902174d985b0eb739ea08c95377e8e46a6a9014c22497faf79cd2",
    "moveit_msgs/srv/GetPositionFK": "2f16ec361a135d84b85a29385abeb9eeb025e39c09038bd6b2826645edc7edad",
    "moveit_msgs/srv/GetPositionIK": "054ed6f6f71a09b01b5246c5d80beb4dacc6f444f58df039849c76292933e9e3",
    "moveit_msgs/srv/GetStateValidity": "e9fcd24ae0fd8c2f16d4afe397efaf03427d1f899fe91ecf6cb7f7f1c6ca8720",
    "moveit_msgs/srv/QueryPlannerInterfaces": "c7550fca36d2ac8b3463b25c723baaf7ecd313d659d23d519c021b519e07b431",
    "moveit_msgs/srv/ServoCommandType": "2065f4daf271249330596d344ecd48f5c2d2a52e3b21b1fc56d99c52b8eeae22",
    "octomap_msgs/srv/BoundingBoxQuery": "5115fa060b6e9c8f7b1dba63dc318f4308e60ab936eede0986385768787dbe23",
    "octomap_msgs/srv/GetOctomap": "c43f2ceb835f797f3d2a2c3d9000e4691207d8c7bfb443119b4e90daaabb5d6c",
}
_ACTIONS = {
    "moveit_msgs/action/ExecuteTrajectory": "e1ed3386f275fc8cea91cc78701074f892e78e583be2f8063eea5616dd1065fc",
    "moveit_msgs/action/MoveGroup": "8c41d70908a2d26b564ddac31e9710f697a753bbd2a4d229542f76271daefc0b",
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
