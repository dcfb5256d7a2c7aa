# SPDX-License-Identifier: Apache-2.0
"""From frames to objects."""

from __future__ import annotations

import pytest

from openarm_common.errors import OpenArmError
from openarm_grasp.config import DetectConfig
from openarm_grasp.perception.detections import Frame, Ids, find
from openarm_perception.detection.pipeline import Pipeline


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
    assert [p.label for p in view.perceived(central).located] == ["red", "blue"]
    for words in ("blue", "cylinder", "Blue cylinder"):
        only = view.perceived(Pipeline(pipeline.detector, pipeline.localizer, label=words))
        assert ([p.label for p in only.found], [p.label for p in only.located]) == (["blue"], ["blue"])


@pytest.mark.requirement("B-27")
def test_what_is_partly_hidden_comes_after_what_is_seen_whole(tabletop, pipeline) -> None:
    """Certain in the image, less certain in space: the order is that of the scores that are published."""
    hidden = tabletop.Thing("red", "box", (0.05, 0.05, 0.05), 0.16, 0.10, 0.3)
    before = tabletop.Thing("blue", "cylinder", (0.066, 0.066, 0.115), 0.235, 0.115)
    whole = tabletop.Thing("green", "box", (0.05, 0.05, 0.05), 0.27, -0.2)
    located = tabletop.render([hidden, before, whole]).perceived(pipeline).located
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
    seen = tabletop.render(things).perceived(Pipeline(pipeline.detector, pipeline.localizer, policy))
    assert find([Ids().given(Frame(0, seen.boxes))], "cube", DetectConfig()).target.label == first


def test_what_cannot_be_measured_is_still_in_the_way(tabletop, pipeline) -> None:
    """A block between two others has no outline of its own: its box encloses it and is marked as not measured."""
    things = [
        tabletop.Thing(c, "box", (0.05, 0.05, 0.05), 0.27, y)
        for c, y in (("red", -0.05), ("blue", 0.0), ("green", 0.05))
    ]
    perceived = tabletop.render(things).perceived(pipeline)
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
    perceived = tabletop.render(things).perceived(pipeline)
    assert perceived.unmeasured
    assert sorted(labels) == ["blue", "green", "red"]
