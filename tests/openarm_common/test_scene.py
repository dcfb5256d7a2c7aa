# SPDX-License-Identifier: Apache-2.0
"""Scenes: what is read, what is drawn, and every way to be refused."""

from __future__ import annotations

import colorsys
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from openarm_common.config import load_yaml
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import config_dir, models_dir
from openarm_common.robot.folder import robot_work
from openarm_common.robot.work import Table
from openarm_common.scene.scene import PALETTE, Scene, SceneObject, load_scene, parse_object, parse_scene, random_scene
from tests.refusals import refuses


def cube(name: str = "red_cube", **changes: Any) -> dict[str, Any]:
    return {"name": name, "shape": "box", "size": [0.05] * 3, "color": "red", "position": [0.3, -0.2]} | changes


def refused(data: dict[str, Any]) -> str:
    with refuses(Code.SCENE_INVALID) as caught:
        parse_scene(data, "here.yaml")
    assert caught.value.message.startswith("here.yaml")
    return caught.value.message


def test_every_scene_of_the_suite_is_valid() -> None:
    files = sorted([*(models_dir() / "scenes").glob("*.yaml"), *models_dir().glob("robots/openarm_v1/scenes/*.yaml")])
    assert {"demo", "empty"} <= {file.stem for file in files}
    for file in files:
        assert load_scene(file.stem).name == file.stem
        assert load_scene(file) == load_scene(file.stem)


def test_demo_has_a_red_cube_for_the_right_arm_and_a_blue_can_for_the_left() -> None:
    demo, region = load_scene("demo"), robot_work().region
    assert demo.table == Table(top_z=0.40, x=(0.11, 0.81), y=(-0.60, 0.60), thickness=0.04)
    red, blue = demo.object("red_cube"), demo.object("blue_can")
    assert (red.label, red.shape, red.size) == ("red", "box", (0.05, 0.05, 0.05))
    assert (blue.label, blue.shape, blue.size) == ("blue", "cylinder", (0.066, 0.066, 0.115))
    assert red.position[1] < 0.0 < blue.position[1]
    for item in demo.objects:
        assert region.x[0] <= item.position[0] <= region.x[1]
        assert region.abs_y[0] <= abs(item.position[1]) <= region.abs_y[1]


def test_an_object_stands_on_the_table_unless_the_scene_says_otherwise() -> None:
    table = robot_work().table.at(0.30)
    assert SceneObject(**cube()).centre(table) == pytest.approx((0.3, -0.2, 0.325))
    assert SceneObject(**cube(position=[0.3, -0.2, 0.5])).centre(table)[2] == 0.5
    turned = SceneObject(**cube(yaw=np.pi / 4)).outline()
    np.testing.assert_allclose(np.abs(turned - [0.3, -0.2]).max(axis=0), [0.05 / np.sqrt(2)] * 2)


def test_mass_follows_from_the_volume_where_none_is_given() -> None:
    assert SceneObject(**cube(mass=0.2)).mass_kg == 0.2
    assert SceneObject(**cube()).mass_kg == pytest.approx(0.05**3 * 700)
    can = SceneObject(**cube(shape="cylinder", size=[0.066, 0.066, 0.115]))
    assert can.volume == pytest.approx(np.pi * 0.033**2 * 0.115)
    ball = SceneObject(**cube(shape="sphere"))
    assert ball.volume == pytest.approx(4.0 / 3.0 * np.pi * 0.025**3)
    assert np.hypot(*(ball.outline() - ball.position[:2]).T) == pytest.approx(0.025)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shape": "ball"}, "objects.0.shape: Input should be 'box', 'cylinder', 'sphere' or 'mesh', got 'ball'"),
        ({"shape": "sphere", "size": [0.05, 0.05, 0.06]}, "objects.0: .*a sphere has one diameter"),
        ({"color": "pink"}, "objects.0.color: .*colours: red, orange, yellow, green, blue, purple, grey, got 'pink'"),
        ({"size": [0.05, 0.05, 0.31]}, "objects.0.size.2: .*less than or equal to 0.3, got 0.31"),
        ({"size": [0.05, 0.05, 0.001]}, "objects.0.size.2: .*greater than or equal to 0.01"),
        ({"size": [0.05, 0.05]}, r"objects.0.size"),
        ({"mass": -1}, "objects.0.mass"),
        ({"name": "Red Cube"}, "objects.0.name"),
        ({"name": "table"}, "objects.0.name: .*reserved"),
        ({"name": "openarm_right_hand"}, "objects.0.name: .*reserved"),
        ({"yaw": float("nan")}, "objects.0.yaw: .*finite"),
        ({"position": [0.3, float("inf")]}, "objects.0.position"),
        ({"radius": 0.1}, "objects.0.radius: unknown key"),
        ({"position": [0.12, -0.2]}, r"'red_cube' at \(0.120, -0.200\) is outside the table: x spans 0.095 .. 0.145 m"),
        ({"position": [0.3, 0.59]}, "outside the table: y spans 0.565 .. 0.615 m, the table -0.600 .. 0.600"),
        ({"position": [0.3, -0.2, 0.41]}, "'red_cube' .* is in the table: its bottom is at z 0.385, the top at 0.400"),
    ],
)
def test_an_object_that_does_not_fit_is_refused_with_where(changes: dict[str, Any], words: str) -> None:
    with refuses(Code.SCENE_INVALID, words):
        parse_scene({"objects": [cube(**changes)]}, "here.yaml")


def test_an_object_at_the_very_edge_of_the_table_is_accepted() -> None:
    scene = parse_scene({"objects": [cube(position=[0.135, -0.575])]}, "here.yaml")
    assert scene.objects[0].position == (0.135, -0.575)


@pytest.mark.parametrize(
    ("position", "yaw", "shape", "overlaps"),
    [
        ((0.33, -0.20), 0.0, "box", True),
        ((0.34995, -0.20), 0.0, "box", False),  # touching
        ((0.351, -0.20), 0.0, "box", False),
        ((0.355, -0.20), np.pi / 4, "box", True),  # the corner reaches in
        ((0.338, -0.162), 0.0, "box", True),
        ((0.3440, -0.1560), 0.0, "cylinder", False),  # the bounding boxes overlap, the shapes do not
        ((0.30, -0.20, 0.4751), 0.0, "box", False),  # stacked
        ((0.30, -0.20, 0.46), 0.0, "box", True),
    ],
)
def test_overlapping_objects_are_refused(position: tuple[float, ...], yaw: float, shape: str, overlaps: bool) -> None:
    other = cube("blue_thing", color="blue", position=list(position), yaw=yaw, shape=shape)
    data = {"objects": [cube(), other]}
    if overlaps:
        assert "object 'red_cube' at (0.300, -0.200) and object 'blue_thing'" in refused(data)
    else:
        assert len(parse_scene(data, "here.yaml").objects) == 2


def test_names_and_labels_are_unique() -> None:
    text = refused({"objects": [cube(), cube(position=[0.5, 0.0])]})
    assert "name 'red_cube' is used twice" in text
    assert "label 'red' is used twice" in text
    parse_scene({"objects": [cube(), cube("other", position=[0.5, 0.0], label="second")]}, "here.yaml")


def test_all_faults_are_named_at_once() -> None:
    objects = [cube(position=[0.9, 0.0]), cube("second", color="blue", position=[0.3, 0.7])]
    text = refused({"objects": objects})
    assert "'red_cube' at (0.900, 0.000)" in text
    assert "'second' at (0.300, 0.700)" in text


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"x": [0.5, 0.2]}, "table.x: .*low < high"),
        ({"x": [0.0, 0.6]}, "table: .*stand in the robot"),
        ({"top_z": 3.0}, "table.top_z"),
        ({"legs": 3}, "table.legs: unknown key"),
    ],
)
def test_an_impossible_table_is_refused(table: dict[str, Any], words: str) -> None:
    with pytest.raises(OpenArmError, match=words):
        parse_scene({"table": table}, "here.yaml")


def test_one_object_can_be_checked_for_a_table() -> None:
    assert parse_object(cube(), robot_work().table, "spawn").name == "red_cube"
    with pytest.raises(OpenArmError, match=r"spawn: object 'red_cube' at .* is outside the table"):
        parse_object(cube(position=[2.0, 0.0]), robot_work().table, "spawn")
    with pytest.raises(OpenArmError, match="spawn:shape"):
        parse_object(cube(shape="ball"), robot_work().table, "spawn")


def test_unknown_scenes_and_objects_list_what_there_is(tmp_path: Path) -> None:
    with refuses(Code.SCENE_INVALID, r"no scene 'nowhere'; scenes: .*demo, empty.*random"):
        load_scene("nowhere")
    broken = tmp_path / "broken.yaml"
    broken.write_text("objects: [", encoding="utf-8")
    with refuses(Code.SCENE_INVALID, r"broken.yaml is not valid YAML"):
        load_scene(broken)
    with refuses(Code.INVALID_ARGUMENT, r"no object 'cup'.*red_cube, green_cylinder, blue_can"):
        load_scene("demo").object("cup")


def test_scenes_are_frozen() -> None:
    with pytest.raises(ValidationError):
        load_scene("demo").name = "other"  # type: ignore[misc]


@pytest.mark.requirement("B-17")
def test_random_scenes_are_graspable_and_repeatable() -> None:
    counts, shapes, sides, region = set(), set(), set(), robot_work().region
    for seed in range(80):
        scene = random_scene(seed)
        assert scene == load_scene("random", seed)
        counts.add(len(scene.objects))
        assert len({item.color for item in scene.objects}) == len(scene.objects)
        for item in scene.objects:
            x, y, z = item.size
            shapes.add(item.name.split("_")[1])
            sides.add(np.sign(item.position[1]))
            assert 0.04 <= x <= 0.07
            assert 0.04 <= y <= 0.07
            assert 0.04 <= z <= 0.115
            assert 0.06 <= item.mass_kg <= 0.35
            assert region.x[0] <= item.position[0] <= region.x[1]
            assert region.abs_y[0] <= abs(item.position[1]) <= region.abs_y[1]
        for a, b in itertools.combinations(scene.objects, 2):
            assert np.hypot(a.position[0] - b.position[0], a.position[1] - b.position[1]) >= 0.10
    assert counts == {1, 2, 3, 4}
    assert shapes == {"cube", "box", "cylinder", "can"}
    assert sides == {-1.0, 1.0}
    assert random_scene(1) != random_scene(2)
    assert len(random_scene(5, count=6).objects) == 6


def test_the_palette_lies_inside_the_hue_ranges_of_the_detector() -> None:
    classes = load_yaml(config_dir() / "params" / "detector.yaml")["classes"]
    ranges = {row["label"]: row["hue_deg"] for row in classes}
    assert set(ranges) == set(PALETTE)
    for name, (r, g, b, _) in PALETTE.items():
        hue, saturation, value = colorsys.rgb_to_hsv(r, g, b)
        low, high = ranges[name]
        width = (high - low) % 360
        inside = (hue * 360 - low) % 360
        assert 5 <= inside <= width - 5, f"{name}: hue {hue * 360:.0f} in {low} .. {high}"
        assert saturation > 0.75
        assert value > 0.5


def test_the_table_defaults_are_a_scene_of_their_own() -> None:
    assert Scene().objects == ()
    assert robot_work().table.centre == pytest.approx((0.46, 0.0))
    assert robot_work().table.extents == pytest.approx((0.70, 1.20, 0.04))
