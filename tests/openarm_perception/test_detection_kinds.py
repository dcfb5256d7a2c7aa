# SPDX-License-Identifier: Apache-2.0
"""Networks, both detectors and depth alone on rendered tables; the networks are made up, their boxes exact or not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openarm_common.config import load_config
from openarm_common.resources import config_dir
from openarm_perception.detection.clouds import labelled_cloud, smooth_depth
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
from openarm_perception.detection.kinds import DetectorKind
from openarm_perception.detection.localize import Localizer, LocalizerConfig
from openarm_perception.detection.network import NetworkConfig
from openarm_perception.detection.pipeline import Perceived, Pipeline, make_pipeline
from openarm_perception.geometry.depth import DepthLimits, View
from openarm_sim_bridge.cameras.noise import DepthNoiseConfig, add_depth_noise
from tests.openarm_perception.onnx_file import boxes, write_network

LIMITS = DepthLimits(near=0.07)
COLORS = ColorDetector(load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig))
CLASSES = ("box", "cylinder")


@pytest.fixture
def perceive(tabletop, tmp_path):
    """What a kind of detector makes of things, of which the network tells (class, score, shift of its box, px)."""

    def run(kind: DetectorKind, things, answers=None, spoil=None, robot=None, classes=CLASSES) -> Perceived:
        view = tabletop.render(things)
        rows = []
        for i, thing in enumerate(things):
            alone = Pipeline(COLORS, Localizer(LocalizerConfig(), LIMITS, tabletop.table_height))
            colour = replace(thing, label="red") if thing.label == "grey" else thing
            (found,) = alone.detector.detect(tabletop.render([colour]).rgb)
            say = (CLASSES.index(thing.kind), 0.9, 0.0) if answers is None else answers.get(i)
            if say is not None:
                (u, v), (w, h) = found.origin, found.size
                grow = say[3] if len(say) > 3 else 0.0
                low, high = say[2] - grow, say[2] + grow
                rows.append((u + low, v + low, u + w + high, v + h + high, say[0], say[1]))
        model = write_network(tmp_path / "net.onnx", boxes(*rows), (1, 3, 480, 640), str(list(classes)))
        localizer = Localizer(LocalizerConfig(), LIMITS, tabletop.table_height)
        pipeline = make_pipeline(kind, COLORS, NetworkConfig(model=str(model)), localizer)
        rgb = view.rgb if spoil is None else spoil(view.rgb.copy())
        return pipeline.run(rgb, view.depth, view.intrinsics, view.T_base_camera, robot)

    return run


def three(tabletop):
    return [
        tabletop.Thing("red", "box", (0.05, 0.06, 0.05), 0.27, 0.0, 0.4),
        tabletop.Thing("blue", "cylinder", (0.05, 0.05, 0.09), 0.22, 0.25),
        tabletop.Thing("grey", "box", (0.05, 0.05, 0.05), 0.30, -0.25, 0.2),
    ]


@pytest.mark.parametrize("shift", [-3.0, 3.0])
@pytest.mark.requirement("N-15")
def test_boxes_of_a_network_become_objects_in_place(tabletop, perceive, shift: float) -> None:
    """Also with boxes a few pixels off: depth and colour say where an object ends. Labels are colours if possible."""
    things = three(tabletop)
    seen = perceive("network", things, {0: (0, 0.9, shift), 1: (1, 0.8, shift), 2: (0, 0.7, shift)})
    assert not seen.refused
    found = {place.label: place for place in seen.located}
    assert sorted(found) == ["blue", "box", "red"]
    for thing, label in zip(things, ("red", "blue", "box"), strict=True):
        assert np.abs(found[label].p_base - thing.position).max() < 0.003
        assert np.abs(np.array(found[label].size) - [*sorted(thing.size[:2]), thing.size[2]]).max() < 0.004
    assert found["red"].attributes == ("red", "box")
    assert found["blue"].attributes == ("blue", "can", "cylinder")
    assert found["box"].attributes == ("box", "cube")


@pytest.mark.requirement("R-18")
@pytest.mark.parametrize("kind", ["network", "both"])
@pytest.mark.parametrize("name", ["Coca Cola", "orange", "Käse"])
def test_class_colour_and_shape_of_an_object_are_told_apart(tabletop, perceive, kind, name) -> None:
    """Of a network of the user's own: a class that names no shape says what it is; the outline says its shape."""
    seen = perceive(kind, three(tabletop), classes=("other", name))
    found = {place.color: place for place in seen.located}
    assert found["blue"].attributes == (name, "blue", "can", "cylinder")
    assert found["red"].attributes == ("other", "red", "box")
    assert found[""].attributes == ("other", "cube", "box")
    assert found["blue"].label == name


@pytest.mark.requirement("R-18")
def test_a_class_that_names_a_shape_is_the_shape(tabletop, perceive) -> None:
    """Also one that would follow from the extents: the network knows better."""
    seen = perceive("network", three(tabletop)[1:2], {0: (1, 0.9, 0.0)}, classes=("cube", "cylinder"))
    assert seen.located[0].attributes == ("blue", "can", "cylinder")
    seen = perceive("network", three(tabletop)[:1], {0: (0, 0.9, 0.0)}, classes=("cube", "can"))
    assert seen.located[0].attributes == ("red", "cube", "box")
    seen = perceive("network", three(tabletop)[2:], {0: (1, 0.9, 0.0)}, classes=("cube", "can"))
    assert seen.located[0].attributes == ("cylinder", "can")


def test_a_round_outline_in_depth_is_no_box_whatever_the_network_says(tabletop, perceive) -> None:
    seen = perceive("network", three(tabletop), {0: (1, 0.9, 0.0), 1: (0, 0.9, 0.0)})
    found = {place.label: place.attributes for place in seen.located}
    assert found["blue"] == ("blue", "can", "cylinder")
    assert found["red"] == ("red", "cylinder")  # it may lie


@pytest.mark.requirement("N-16")
def test_what_both_see_is_found_and_named_by_both(tabletop, perceive) -> None:
    seen = perceive("both", three(tabletop))
    assert {(d.label, d.kind) for d in seen.found} == {("red", "box"), ("blue", "cylinder"), ("box", "box")}
    assert len(seen.located) == 3
    assert not seen.refused


@pytest.mark.requirement("N-16")
def test_what_the_network_does_not_see_is_looked_at_again(tabletop, perceive) -> None:
    """A network that has gone blind: nothing coloured is grasped, all of it stands in the way, and each is reported."""
    seen = perceive("both", three(tabletop), {2: (0, 0.9, 0.0)})
    assert [place.label for place in seen.located] == ["box"]
    assert sorted(place.label for place in seen.unmeasured) == ["blue", "red"]
    assert not any(place.measured for place in seen.unmeasured)
    assert any(
        "red at pixel" in why and "the network detects nothing there; it is observed again" in why
        for why in seen.refused
    )


@pytest.mark.requirement("N-16")
def test_a_colour_that_only_paint_has_is_no_object(tabletop, perceive) -> None:
    """A red sheet on the table: by colour it is found in the image; the network knows better."""

    def sheet(rgb):
        rgb[100:140, 300:360] = (205, 20, 20)
        return rgb

    things = three(tabletop)[1:]
    assert "red" in [d.label for d in perceive("color", things, spoil=sheet).found]
    seen = perceive("both", things, spoil=sheet)
    assert sorted(place.label for place in seen.boxes) == ["blue", "box"]
    assert any("red at pixel (330, 120): the network detects nothing there" in why for why in seen.refused)


@pytest.mark.requirement("N-16")
def test_what_has_lost_its_colour_to_one_of_them_is_looked_at_again(tabletop, perceive) -> None:
    """Specks hide the red of a box from the colour detector, whose kernel takes it out; most of it is still red."""

    def specks(rgb):
        hidden = np.zeros(rgb.shape[:2], np.bool_)
        hidden[::3, ::3] = True
        red = (rgb[..., 0] > 100) & (rgb[..., 1] < 80)
        rgb[hidden & red] = (120, 120, 120)
        return rgb

    things = three(tabletop)[:2]
    assert [d.label for d in perceive("color", things, spoil=specks).found] == ["blue"]
    seen = perceive("both", things, spoil=specks)
    assert [place.label for place in seen.located] == ["blue"]
    assert any("box at pixel" in why and "by colour nothing red is there" in why for why in seen.refused)


def test_a_large_neighbour_in_the_box_is_no_part_of_the_object(tabletop, perceive) -> None:
    """The box of the small one reaches 30 pixels too far on all sides, over most of the other."""
    things = [
        tabletop.Thing("red", "box", (0.04, 0.04, 0.04), 0.27, 0.0),
        tabletop.Thing("blue", "box", (0.06, 0.07, 0.10), 0.27, 0.08),
    ]
    seen = perceive("network", things, {0: (0, 0.9, 0.0, 30.0)})
    (found,) = seen.located
    assert found.label == "red"
    assert np.abs(found.p_base - things[0].position).max() < 0.003


def test_one_object_named_twice_is_one_object(tabletop, perceive) -> None:
    """Two classes for one thing, not overlapping enough for the boxes alone: the more certain one stays."""
    thing = three(tabletop)[0]
    seen = perceive("network", [thing, thing], {0: (0, 0.7, -9.0), 1: (1, 0.8, 0.0)})
    assert [(d.label, d.kind) for d in seen.found] == [("red", "cylinder")]


def test_a_box_around_nothing_is_nothing(tabletop, perceive) -> None:
    assert perceive("network", three(tabletop)[:1], {0: (0, 0.9, 150.0)}).found == ()


def test_anything_finds_what_no_detector_knows_by_depth_alone(tabletop, perceive) -> None:
    things = three(tabletop)
    seen = perceive("anything", things, {})
    assert [place.label for place in seen.located] == ["anything"] * 3
    for thing in things:
        assert min(np.abs(place.p_base - thing.position).max() for place in seen.located) < 0.003


def test_anything_parts_what_stands_behind_another_and_leaves_the_robot_out(tabletop, perceive) -> None:
    tall = tabletop.Thing("grey", "box", (0.05, 0.05, 0.12), 0.25, 0.0)
    low = tabletop.Thing("grey", "box", (0.05, 0.05, 0.04), 0.19, 0.0)
    assert len(perceive("anything", [tall, low], {}).found) == 2
    robot = np.zeros((480, 640), np.bool_)
    robot[:, :320] = True
    left = perceive("anything", three(tabletop), {}, robot=robot)
    assert len(left.found) == 2
    assert all(d.origin[0] >= 320 for d in left.found)


def test_what_is_no_prism_is_located_not_called_hidden(tabletop, perceive) -> None:
    """A hammer of two boxes: no rectangle fits, nothing hides it, and it lies still."""
    hammer = [
        tabletop.Thing("red", "box", (0.15, 0.03, 0.03), 0.30, 0.0),
        tabletop.Thing("red", "box", (0.03, 0.10, 0.03), 0.39, 0.0),
    ]
    seen = perceive("anything", hammer, {})
    assert seen.refused == ()
    (place,) = seen.located
    assert place.method == "bound"
    assert place.size == pytest.approx((0.10, 0.18, 0.03), abs=0.006)
    assert place.p_base[:2] == pytest.approx((0.315, 0.0), abs=0.004)


@pytest.mark.parametrize("x", [0.27, -0.09], ids=["on the table", "over its edge"])
def test_what_is_seen_through_a_hole_is_none_of_a_things_points(tabletop, x) -> None:
    """A frame of four bars, also where it sticks out over the edge of the table: the hole shows table and floor."""
    bar, edge = 0.012, 0.07
    bars = [
        (x, edge / 2, edge, bar),
        (x, -edge / 2, edge, bar),
        (x - edge / 2, 0.0, bar, edge),
        (x + edge / 2, 0.0, bar, edge),
    ]
    view = tabletop.render([tabletop.Thing("red", "box", (a, b, bar), px, py) for px, py, a, b in bars])
    depth = add_depth_noise(
        view.depth.copy(), view.intrinsics.fy, DepthNoiseConfig(enabled=True), np.random.default_rng(0)
    )
    seen = View(view.rgb, depth, view.intrinsics, view.T_base_camera)
    localizer = Localizer(LocalizerConfig(), LIMITS, tabletop.table_height)
    perceived = make_pipeline("anything", COLORS, NetworkConfig(), localizer).run(
        seen.rgb, seen.depth, seen.intrinsics, seen.T_base_camera, None
    )
    assert len(perceived.boxes) == 1
    cloud = labelled_cloud(seen, smooth_depth(seen, LIMITS), perceived.boxes, LIMITS).moved(view.T_base_camera)
    points = cloud.points[cloud.labels == 1]
    assert len(points) > 200
    in_hole = np.abs(points[:, :2] - (x, 0.0)).max(axis=1) < (edge - bar) / 2 - 0.006
    assert np.mean(in_hole) < 0.02
    assert points[:, 2].min() > tabletop.table_height - 0.01
