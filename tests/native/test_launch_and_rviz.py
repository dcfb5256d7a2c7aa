# SPDX-License-Identifier: Apache-2.0
"""The launch file starts what `openarm up` starts, and the RViz views show topics that exist as they are offered.

There is no wheel of the `launch` package: a stand-in takes what the launch file hands over to it.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import yaml

from openarm_bringup.supervision.environment import node_arguments
from openarm_bringup.supervision.graph import graph_names, load_graph
from openarm_common.resources import config_dir
from openarm_common.robot.description import RobotDescription

ROOT = Path(__file__).parents[2]
LAUNCH = ROOT / "openarm_bringup" / "launch" / "openarm.launch.py"
ROW = re.compile(r"^\| `(/[^`]+)` \| `[^`]+/msg/[^`]+` \| ([a-z ]+) \|", re.MULTILINE)
STAGES = ("sim_only", "calibrate", "map", "sim")


class Configuration:
    """As launch.substitutions.LaunchConfiguration: a name that a context knows the value of."""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The launch file as a module."""
    modules = {name: ModuleType(name) for name in ("launch", "launch.actions", "launch.substitutions")}
    modules["launch"].LaunchContext = dict
    modules["launch"].LaunchDescription = list
    modules["launch.actions"].DeclareLaunchArgument = lambda name, **rest: SimpleNamespace(name=name, **rest)
    modules["launch.actions"].OpaqueFunction = lambda function: SimpleNamespace(function=function)
    modules["launch.actions"].ExecuteProcess = lambda **rest: SimpleNamespace(**rest)
    modules["launch.substitutions"].LaunchConfiguration = Configuration
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setenv("OPENARM_RUNS", str(tmp_path))
    spec = importlib.util.spec_from_file_location("openarm_launch", LAUNCH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def start(launch_file: Any, **given: str) -> list[Any]:
    *arguments, function = launch_file.generate_launch_description()
    context = {argument.name: argument.default_value for argument in arguments}
    assert given.keys() <= context.keys()
    return function.function(context | given)


@pytest.mark.parametrize("graph", STAGES)
@pytest.mark.requirement("A-77")
def test_each_stage_starts_the_processes_of_its_graph_and_its_view(
    launch_file: Any, graph: str, tmp_path: Path
) -> None:
    *nodes, rviz = start(launch_file, graph=graph, rviz="true", domain="7")
    expected = load_graph(graph, overrides={"domain": 7})
    assert [node.name for node in nodes] == list(expected.nodes)
    run_dir = next(path for path in tmp_path.iterdir() if not path.is_symlink())
    for node in nodes:
        assert node.cmd == node_arguments(expected, node.name, run_dir)
        assert node.env["ROS_DOMAIN_ID"] == "7"
        assert node.respawn == (expected.nodes[node.name].restart.policy != "never")
    assert rviz.cmd[:2] == ["rviz2", "-d"]
    assert Path(rviz.cmd[2]).name == f"{graph}.rviz"


def test_arguments_reach_the_parameters(launch_file: Any, tmp_path: Path) -> None:
    nodes = start(launch_file, graph="sim_only", scene="random", seed="7", set="mujoco_bridge.images=false")
    assert len(nodes) == 2
    file = tmp_path / "latest" / "params" / "mujoco_bridge.yaml"
    written = yaml.safe_load(file.read_text())["mujoco_bridge"]["ros__parameters"]
    assert (written["scene"], written["seed"], written["images"]) == ("random", 7, False)


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.requirement("A-77")
def test_views_show_topics_that_are_offered_as_they_are_offered(stage: str) -> None:
    offered = dict(ROW.findall((ROOT / "docs" / "interfaces.md").read_text(encoding="utf-8")))
    view = yaml.safe_load((config_dir() / "rviz" / f"{stage}.rviz").read_text(encoding="utf-8"))
    manager = view["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] in RobotDescription.load().links
    topics = [entry[key] for entry in manager["Displays"] for key in ("Topic", "Description Topic") if key in entry]
    assert len(topics) >= 3
    for topic in topics:
        quality = offered[topic["Value"]].strip()
        assert (topic["Reliability Policy"] == "Best Effort") == (quality == "best effort"), topic["Value"]
        assert (topic["Durability Policy"] == "Transient Local") == (quality == "latched"), topic["Value"]


def test_every_node_of_the_graphs_is_an_executable_of_its_package() -> None:
    """What `ros2 run` and a launch file start is what the graph starts."""
    modules = {spec.module for name in graph_names() for spec in load_graph(name).nodes.values() if spec.module}
    for module in modules - {"openarm_bringup.ros.script_node"}:
        package = module.partition(".")[0]
        assert f"{module}:main" in (ROOT / package / "setup.py").read_text(encoding="utf-8"), module
