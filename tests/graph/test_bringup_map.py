# SPDX-License-Identifier: Apache-2.0
"""The bring-up's step between eyes and hands: the map, recorded without a loss."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState, PointCloud2

from openarm_bringup.bags.bag import open_bag
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import points_from_cloud
from openarm_common.scene.scene import load_scene

pytestmark = [pytest.mark.graph, pytest.mark.long, pytest.mark.alone]


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
    recording = json.loads(done.stdout)
    assert recording["lost"] == 0
    assert set(recording["topics"]) == set(topics.split("|"))
    with open_bag(bag) as recorded:
        newest = {record.topic: record.data for record in recorded.records()}
    cells = points_from_cloud(deserialize_message(newest["/octomap_point_cloud_centers"], PointCloud2))
    for item in load_scene("demo").objects:
        x, y = item.position[:2]
        near = np.hypot(cells[:, 0] - x, cells[:, 1] - y) < 0.04
        assert cells[near, 2].max() > load_scene("demo").table.top_z + 0.03, item.name
    state = deserialize_message(newest["/joint_states"], JointState)
    joints = dict(zip(state.name, state.position, strict=True))
    for side in ("left", "right"):
        hand = RobotDescription.load().link_pose(f"openarm_{side}_hand", joints)[:3, 3]
        assert np.linalg.norm(cells - hand, axis=1).min() > 0.05
