# SPDX-License-Identifier: Apache-2.0
"""The examples of docs/extending.md, as they are written there."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from openarm_bringup.supervision.graph import load_graph
from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import models_dir
from openarm_common.robot.description import RobotDescription
from openarm_grasp.config import GraspConfig
from openarm_grasp.sampling.samplers import Sampling, make_sampler
from openarm_grasp.sampling.surface import View, fuse
from openarm_grasp.strategies import registry
from openarm_motion.planning.planner import PlanQuery, make_planner
from openarm_sim_bridge.drafting.edits import Edits, matching
from openarm_sim_bridge.drafting.semantics import SemanticsSource
from tests.openarm_grasp.scripted import Wait, World, standing

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")


def example(section: str, language: str, number: int = 0) -> str:
    """A block of code of a section of the page."""
    text = re.split(r"^## ", PAGE, flags=re.MULTILINE)
    (chosen,) = [part for part in text if part.startswith(f"{section}\n")]
    blocks = re.findall(rf"^( *)```{language}\n(.*?)^ *```$", chosen, re.MULTILINE | re.DOTALL)
    return textwrap.dedent(blocks[number][1])


def module(source: str) -> dict[str, Any]:
    """Names that a module defines."""
    names: dict[str, Any] = {"__name__": "example"}
    exec(compile(source, "docs/extending.md", "exec"), names)
    return names


def test_each_recipe_touches_at_most_three_files_that_there_are() -> None:
    recipes = re.findall(r"^Files: (.*?)\n\n", PAGE, re.MULTILINE | re.DOTALL)
    assert len(recipes) == PAGE.count("\n## ")
    for recipe in recipes:
        files = re.findall(r"`([^`]+)`( \(new\))?", recipe)
        assert len(files) <= 3
        for path, new in files:
            assert (ROOT / path).exists() == (not new), path


def test_the_edits_and_semantics_of_the_robot_are_valid() -> None:
    edits = Edits.model_validate(yaml.safe_load(example("A robot", "yaml")))
    assert [matching(edits.velocity, name, 0.0) for name in ("left_joint4", "left_joint5")] == [5.4, 20.9]
    source = SemanticsSource.model_validate(yaml.safe_load(example("A robot", "yaml", 1)))
    assert len(source.checked(["left", "right"])) == 3
    assert source.allowed(["left"]) == {frozenset(("left_finger", "left_thumb"))}


def test_the_camera_is_read_and_its_graph_is_valid(tmp_path: Path) -> None:
    cameras = tmp_path / "cameras.yaml"
    known = (models_dir() / "robots" / "openarm_v1" / "cameras.yaml").read_text(encoding="utf-8")
    cameras.write_text(known + textwrap.indent(example("A camera", "yaml"), "  "))
    side = load_cameras(cameras)["side"]
    assert side.optical_frame == "side_color_optical_frame"
    graph = tmp_path / "three_cameras.yaml"
    graph.write_text(example("A camera", "yaml", 1))
    loaded = load_graph(str(graph))
    assert loaded.nodes["side_detector"].params["camera"] == side.name


def test_the_detector_finds_what_is_colourful() -> None:
    detector = module(example("A detector", "python"))["SaturatedDetector"]()
    image = np.full((120, 160, 3), 180, np.uint8)
    assert detector.detect(image) == ()
    image[40:60, 50:80] = (200, 20, 20)
    image[0:40, 100:130] = (20, 20, 200)
    cut, whole = detector.detect(image)
    assert (whole.label, whole.centre, whole.size, whole.truncated) == ("colourful", (64.5, 49.5), (30, 20), False)
    assert whole.mask.all()
    assert cut.truncated


def test_the_sampler_is_named_by_a_parameter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_samplers.py").write_text(example("A grasp sampler", "python"))
    monkeypatch.syspath_prepend(str(tmp_path))
    edge = np.linspace(-0.025, 0.025, 30)
    top = np.stack(np.meshgrid(0.27 + edge, -0.2 + edge, [0.45]), axis=-1)
    surface = fuse([View(np.array([0.27, -0.2, 1.0]), top.reshape(-1, 3))], 0.4)
    target = Detection("red", 1.0, se3.make(p=(0.27, -0.2, 0.425)), np.full(3, 0.05))
    hand = RobotDescription.load().hand("right").parts
    asked = Sampling(target, GraspConfig(sampler="my_samplers:CentroidSampler"), hand, surface=surface)
    (only,) = make_sampler(asked.config.sampler).candidates(asked)
    assert only.T_base_tcp[:2, 3] == pytest.approx([0.27, -0.2], abs=0.002)
    assert only.apertures == (0.01, 0.07)


def test_the_planner_is_named_by_a_parameter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_planners.py").write_text(example("A planner", "python"))
    monkeypatch.syspath_prepend(str(tmp_path))
    planner = make_planner("my_planners:StraightPlanner")
    bound = np.ones(2)

    def query(*blocked: int) -> PlanQuery:
        goals = np.array([[0.5, 0.0], [0.0, 0.5]])
        free = {tuple(goal): number not in blocked for number, goal in enumerate(goals.tolist())}
        return PlanQuery(np.zeros(2), goals, -bound, bound, lambda q: False, lambda a, b: free[tuple(b.tolist())])

    path = planner.plan(query(0))
    assert path.goal == 1
    np.testing.assert_array_equal(path.waypoints, [[0.0, 0.0], [0.0, 0.5]])
    with pytest.raises(OpenArmError, match="no straight line to 2 goals is free"):
        planner.plan(query(0, 1))


def test_the_strategy_is_tried_after_the_others_and_its_key_is_the_route(monkeypatch: pytest.MonkeyPatch) -> None:
    strategy = module(example("A grasp strategy", "python"))["patience"]
    entries = re.findall(r'^    "(\w+)": (\w+),$', example("A grasp strategy", "python", 1), re.MULTILINE)
    assert [key for key, _ in entries] == [*registry.STRATEGIES, "patience"]
    world = World(standing("red", 0.46, 0.02))
    world.far, world.hands_come_behind, world.two_sided = 0.44, False, True
    assert world.ask().code == Code.UNREACHABLE

    def comes_nearer(call: object) -> None:
        if call == Wait(5.0):
            world.objects["red"] = standing("red", 0.40, 0.02)

    world.faults.append(comes_nearer)
    monkeypatch.setitem(registry.STRATEGIES, "patience", strategy)
    outcome = world.ask()
    assert (outcome.code, outcome.route) == (Code.OK, "patience"), outcome.message
