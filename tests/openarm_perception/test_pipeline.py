# SPDX-License-Identifier: Apache-2.0
"""From frames to objects."""

from __future__ import annotations

import pytest

from openarm_common.config import load_config
from openarm_common.errors import OpenArmError
from openarm_common.resources import config_dir
from openarm_grasp.config import DetectConfig
from openarm_grasp.perception.detections import Frame, find
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
from openarm_perception.detection.localize import Localizer, LocalizerConfig
from openarm_perception.detection.pipeline import Pipeline
from openarm_perception.geometry.depth import DepthLimits


@pytest.fixture(scope="module")
def pipeline(tabletop) -> Pipeline:
    """Detector and localiser with their defaults."""
    colors = load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig)
    return Pipeline(ColorDetector(colors), Localizer(LocalizerConfig(), DepthLimits(near=0.07), tabletop.table_height))


def run(pipeline: Pipeline, view):
    """What a view shows."""
    return pipeline.run(view.rgb, view.depth, view.intrinsics, view.T_base_camera)


@pytest.mark.requirement("B-30")
def test_colour_of_another_size_is_refused(tabletop, pipeline) -> None:
    view = tabletop.render([])
    with pytest.raises(OpenArmError, match="colour image is 320x240"):
        pipeline.run(view.rgb[::2, ::2], view.depth, view.intrinsics, view.T_base_camera)


@pytest.mark.requirement("B-27")
def test_the_pipeline_ranks_and_filters(tabletop, pipeline) -> None:
    """By policy, and by label."""
    near = tabletop.Thing("red", "box", (0.05, 0.05, 0.05), 0.27, 0.0)
    far = tabletop.Thing("blue", "cylinder", (0.05, 0.05, 0.06), 0.2, 0.3)
    view = tabletop.render([near, far])
    central = Pipeline(pipeline.detector, pipeline.localizer, "centre")
    assert [p.label for p in run(central, view).located] == ["red", "blue"]
    for words in ("blue", "cylinder", "Blue cylinder"):
        only = run(Pipeline(pipeline.detector, pipeline.localizer, label=words), view)
        assert ([p.label for p in only.found], [p.label for p in only.located]) == (["blue"], ["blue"])


@pytest.mark.requirement("B-27")
def test_what_is_partly_hidden_comes_after_what_is_seen_whole(tabletop, pipeline) -> None:
    """Certain in the image, less certain in space: the order is that of the scores that are published."""
    hidden = tabletop.Thing("red", "box", (0.05, 0.05, 0.05), 0.16, 0.10, 0.3)
    before = tabletop.Thing("blue", "cylinder", (0.066, 0.066, 0.115), 0.235, 0.115)
    whole = tabletop.Thing("green", "box", (0.05, 0.05, 0.05), 0.27, -0.2)
    located = run(pipeline, tabletop.render([hidden, before, whole])).located
    assert [p.score for p in located] == sorted((p.score for p in located), reverse=True)
    assert located[-1].label == "red"


@pytest.mark.parametrize(("policy", "first"), [("score", "green"), ("centre", "red")])
@pytest.mark.requirement("B-27")
def test_what_is_grasped_of_several_that_fit_follows_from_the_policy(tabletop, pipeline, policy, first) -> None:
    """The cube in the middle is partly hidden and so less certain than the other; the can is asked for by neither."""
    things = [
        tabletop.Thing("red", "box", (0.05, 0.05, 0.05), 0.23, 0.0, 0.3),
        tabletop.Thing("green", "box", (0.05, 0.05, 0.05), 0.27, -0.3),
        tabletop.Thing("blue", "cylinder", (0.066, 0.066, 0.115), 0.305, 0.035),
    ]
    seen = run(Pipeline(pipeline.detector, pipeline.localizer, policy), tabletop.render(things))
    assert find([Frame(0, seen.boxes)], "cube", DetectConfig()).target.label == first


def test_what_cannot_be_measured_is_still_in_the_way(tabletop, pipeline) -> None:
    """A block between two others has no outline of its own: its box encloses it and is marked as not measured."""
    things = [
        tabletop.Thing(c, "box", (0.05, 0.05, 0.05), 0.27, y)
        for c, y in (("red", -0.05), ("blue", 0.0), ("green", 0.05))
    ]
    perceived = run(pipeline, tabletop.render(things))
    boxes = {box.label: box for box in perceived.boxes}
    assert set(boxes) == {"red", "blue", "green"}
    built_in = boxes["blue"]
    assert built_in not in perceived.located
    assert not built_in.measured
    assert built_in.p_base[:2] == pytest.approx((0.27, 0.0), abs=0.006)
    assert built_in.size == pytest.approx((0.05, 0.05, 0.05), abs=0.008)


def test_each_detection_is_cut_out_of_the_depth_image_once(tabletop, pipeline, monkeypatch) -> None:
    """Also one that cannot be measured, of which the box around it is taken instead."""
    things = [
        tabletop.Thing(c, "box", (0.05, 0.05, 0.05), 0.27, y)
        for c, y in (("red", -0.05), ("blue", 0.0), ("green", 0.05))
    ]
    cut, labels = pipeline.localizer.cut, []

    def counted(found, *args):
        labels.append(found.label)
        return cut(found, *args)

    monkeypatch.setattr(pipeline.localizer, "cut", counted)
    perceived = run(pipeline, tabletop.render(things))
    assert perceived.unmeasured
    assert sorted(labels) == ["blue", "green", "red"]
