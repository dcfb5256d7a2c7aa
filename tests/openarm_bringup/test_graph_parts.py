# SPDX-License-Identifier: Apache-2.0
"""Graphs have the nodes and conditions that the arms and cameras of the robot need."""

from __future__ import annotations

import json

import pytest
import yaml

from openarm_bringup.bags.ros.listener import flight_on_demand, profiles
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.parts import for_each_part
from openarm_calibration.config import CalibrationConfig
from openarm_common.camera.cameras import (
    depth_cameras,
    detector_nodes,
    hand_cameras,
    near_camera,
    spectator_camera,
    table_camera,
    uncertain_cameras,
)
from openarm_common.errors import OpenArmError
from openarm_common.resources import config_dir
from openarm_common.robot import folder
from openarm_common.robot.folder import load_folder
from openarm_grasp.config import GraspConfig
from openarm_octomap.config import OctomapNodeConfig
from openarm_perception.config import CloudNodeConfig, DetectNodeConfig


def change(name: str, cameras: list[str], arms: list[str]) -> None:
    """Let a robot have these cameras, those of hands named by their arm, and these arms."""
    path, _ = load_folder(name)
    data = yaml.safe_load((path / "robot.yaml").read_text())
    data["arms"] = {arm: data["arms"][arm] for arm in arms}
    (path / "robot.yaml").write_text(yaml.safe_dump(data))
    known = {one["name"]: one for one in yaml.safe_load((path / "cameras.yaml").read_text())["cameras"]}
    rows = [
        known["wrist"] | {"name": one, "parent": f"openarm_{one.removesuffix('_wrist')}_hand"}
        if one.endswith("_wrist")
        else known[one]
        for one in cameras
    ]
    (path / "cameras.yaml").write_text(json.dumps({"cameras": rows}))


@pytest.fixture
def two_eyes(nearer) -> str:
    """A robot with a camera on each hand."""
    change(nearer, ["spectator", "left_wrist", "overhead", "right_wrist"], ["left", "right"])
    return nearer


@pytest.fixture
def one_arm(nearer) -> str:
    """A robot with one arm, and no camera on it."""
    change(nearer, ["overhead"], ["right"])
    return nearer


def test_a_line_is_there_once_for_each_part_and_keeps_its_place():
    said = {"ready": [{"topic": "/a"}, {"action": "/${arm}/go"}], "uses": ["/${hand_camera}/x", "${scene}"]}
    assert for_each_part(said) == {
        "ready": [{"topic": "/a"}, {"action": "/left/go"}, {"action": "/right/go"}],
        "uses": ["/wrist/x", "${scene}"],
    }
    assert for_each_part(["${arm} ${camera}"]) == ["left overhead", "left wrist", "right overhead", "right wrist"]
    assert for_each_part({"n": {"params": {"topic": "{arm}", "rate": 3}}}) == {
        "n": {"params": {"topic": "{arm}", "rate": 3}}
    }


def test_a_part_that_is_no_line_of_a_list_is_refused_with_what_there_is(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("nodes: {eye: {module: openarm_x, params: {camera: '${camera}'}}}")
    with pytest.raises(OpenArmError, match=r"unknown variable \$\{camera\}"):
        load_graph(str(path))


def test_each_hand_with_a_camera_has_a_detector(two_eyes):
    assert list(depth_cameras()) == ["left_wrist", "overhead", "right_wrist"]
    assert hand_cameras() == ("left_wrist", "right_wrist")
    assert (table_camera(), near_camera(), spectator_camera()) == ("overhead", "left_wrist", "spectator")
    assert uncertain_cameras() == ("left_wrist", "overhead", "right_wrist")
    assert detector_nodes() == {
        "overhead": "detector",
        "left_wrist": "left_wrist_detector",
        "right_wrist": "right_wrist_detector",
    }
    graph = load_graph("sim")
    for name in hand_cameras():
        node = graph.nodes[f"{name}_detector"]
        assert node.params["camera"] == name
        assert node.remaps["/detections_3d"] == f"/{name}/detections_3d"
        assert [str(one) for one in node.ready] == [f"topic /{name}/detections_3d"]
    assert "wrist_detector" not in graph.nodes
    assert len(graph.nodes["cloud"].ready) == 3


def test_parameters_name_the_cameras_of_the_robot(two_eyes):
    assert DetectNodeConfig().camera == GraspConfig().camera == "overhead"
    assert CloudNodeConfig().cameras == OctomapNodeConfig().cameras == ("left_wrist", "overhead", "right_wrist")
    assert CalibrationConfig().camera == "left_wrist"
    assert "left_wrist|overhead|right_wrist" in profiles()["camera"][0]
    assert flight_on_demand()[1] == "(/(left_wrist|right_wrist))?/detections_[23]d"


@pytest.mark.parametrize("name", sorted(path.stem for path in (config_dir() / "graphs").glob("*.yaml")))
def test_a_robot_with_one_arm_has_graphs_that_wait_for_it_alone(one_arm, name):
    graph = load_graph(name)
    assert spectator_camera() == "overhead"  # there is none for people
    conditions = [str(one) for node in graph.nodes.values() for one in node.ready]
    assert not [one for one in conditions if "left" in one or "wrist" in one or "$" in one]
    if name == "sim":
        assert "action /right_gripper_controller/gripper_cmd" in conditions
        assert [node for node in graph.nodes if node.endswith("detector")] == ["detector"]


def test_a_robot_without_cameras_is_said_to_have_none(nearer):
    change(nearer, [], ["left", "right"])
    assert (table_camera(), near_camera(), detector_nodes()) == ("", "", {})
    assert folder.robot_name() == nearer
