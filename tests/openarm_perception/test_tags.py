# SPDX-License-Identifier: Apache-2.0
"""Objects that a tag names: where they stand and how large they are is measured, not written on the tag."""

from __future__ import annotations

import re

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.config import load_config
from openarm_common.resources import config_dir
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
from openarm_perception.detection.localize import Localizer, LocalizerConfig
from openarm_perception.detection.network import NetworkConfig
from openarm_perception.detection.pipeline import Perceived, make_pipeline
from openarm_perception.detection.tags import TagConfig
from openarm_perception.geometry.depth import DepthLimits
from tests.tag_paint import paint

COLORS = ColorDetector(load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig))


@pytest.fixture
def perceive(tabletop):
    """What is seen of things with tags: (thing, number or None, edge, turn); those without a thing lie on the table."""

    def run(*tagged, noise: float = 0.0, **config) -> Perceived:
        view = tabletop.render([thing for thing, *_ in tagged if thing is not None])
        rgb, depth = view.rgb.copy(), view.depth
        T_camera_base = se3.inverse(view.T_base_camera)
        for thing, number, edge, turn in tagged:
            if number is None:
                continue
            top = (
                (0.27, 0.0, tabletop.table_height)
                if thing is None
                else (*thing.position[:2], thing.position[2] * 2 - 0.4)
            )
            T = T_camera_base @ se3.make(se3.rot_z(turn), top)
            paint(
                rgb, depth, view.intrinsics, T, number, edge, **{k: v for k, v in config.items() if k == "dictionary"}
            )
        if noise:
            depth = (depth + np.random.default_rng(3).normal(0.0, noise, depth.shape)).astype(np.float32)
        localizer = Localizer(LocalizerConfig(), DepthLimits(near=0.07), tabletop.table_height)
        pipeline = make_pipeline("tag", COLORS, NetworkConfig(), localizer, tags=TagConfig(**config))
        return pipeline.run(rgb, depth, view.intrinsics, view.T_base_camera)

    return run


@pytest.mark.parametrize(
    ("number", "edge", "turn", "dictionary"),
    [(7, 0.04, 0.0, "DICT_APRILTAG_36H11"), (0, 0.035, 0.7, "DICT_4X4_50"), (42, 0.045, -2.5, "DICT_5X5_100")],
)
@pytest.mark.requirement("P-17")
def test_a_tag_names_the_object_under_it_and_depth_measures_it(
    tabletop, perceive, number, edge, turn, dictionary
) -> None:
    grey = tabletop.Thing("grey", "box", (0.06, 0.07, 0.05), 0.27, 0.05, 0.3)
    plain = tabletop.Thing("red", "box", (0.05, 0.05, 0.05), 0.22, -0.25)
    (found,) = perceive((grey, number, edge, turn), (plain, None, 0, 0), dictionary=dictionary, noise=0.001).located
    assert (found.name, found.color, found.kind) == (f"tag_{number}", "", "box")
    assert np.abs(found.p_base - grey.position).max() < 0.003
    assert np.abs(np.array(found.size) - [0.06, 0.07, 0.05]).max() < 0.004


@pytest.mark.requirement("P-17")
def test_colour_and_shape_of_a_tagged_object_are_known_too(tabletop, perceive) -> None:
    can = tabletop.Thing("blue", "cylinder", (0.066, 0.066, 0.11), 0.25, 0.15)
    (found,) = perceive((can, 3, 0.03, 0.4), dictionary="DICT_4X4_50").located
    assert found.attributes == ("tag_3", "blue", "can", "cylinder")


@pytest.mark.requirement("P-17")
def test_a_tag_that_lies_on_the_table_is_no_object(perceive) -> None:
    seen = perceive((None, 7, 0.05, 0.2))
    assert (seen.found, seen.boxes, seen.refused) == ((), (), ())


@pytest.mark.requirement("P-17")
def test_what_the_tag_leaves_open_is_an_obstacle_but_no_target(tabletop, perceive) -> None:
    """Two objects that touch are one cluster of depth; a tag of another size may be a picture of one."""
    touching = [tabletop.Thing("grey", "box", (0.05, 0.05, 0.05), 0.27, y) for y in (-0.025, 0.025)]
    seen = perceive((touching[0], 1, 0.035, 0.0), (touching[1], 2, 0.035, 0.0))
    assert (seen.located, len(seen.unmeasured)) == ((), 1)
    assert "tag_1 and tag_2 at pixel" in seen.refused[0]
    alone = (tabletop.Thing("grey", "box", (0.06, 0.06, 0.05), 0.27, 0.0), 5, 0.04, 0.0)
    assert [place.name for place in perceive(alone, size=0.042).located] == ["tag_5"]
    seen = perceive(alone, size=0.03)
    assert (seen.located, len(seen.unmeasured)) == ((), 1)
    assert re.search(r"its edge is (39|40|41) mm, expected 30 mm \(tag.size\)", seen.refused[0])


def test_an_unknown_dictionary_is_refused_with_those_that_exist() -> None:
    with pytest.raises(ValueError, match=r"unknown dictionary 'DICT_9X9'; dictionaries: .*DICT_APRILTAG_36H11"):
        TagConfig(dictionary="DICT_9X9")
