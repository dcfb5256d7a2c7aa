# SPDX-License-Identifier: Apache-2.0
"""Pictures of detections."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.config import load_config
from openarm_common.resources import config_dir
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
from openarm_perception.detection.draw import annotate
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


@pytest.mark.requirement("B-20")
def test_located_and_refused_objects_look_different_and_the_input_stays(tabletop, pipeline) -> None:
    whole = tabletop.Thing("red", "box", (0.05, 0.05, 0.05), 0.25, -0.2, 0.3)
    cut = tabletop.Thing("blue", "box", (0.06, 0.06, 0.06), 0.25, 0.51)
    view = tabletop.render([whole, cut])
    before = view.rgb.copy()
    perceived = run(pipeline, view)
    assert ([p.label for p in perceived.located], len(perceived.refused)) == (["red"], 1)
    picture = annotate(view.rgb, perceived)
    np.testing.assert_array_equal(view.rgb, before)
    drawn = (picture != view.rgb).any(axis=-1)
    colors = {tuple(color) for color in picture[drawn].tolist()}
    assert {(0, 120, 140), (190, 40, 40)} <= colors
    red = next(d for d in perceived.found if d.label == "red")
    u, v = (round(c) for c in red.centre)
    np.testing.assert_array_equal(picture[v, u], view.rgb[v, u])  # no tag lies on the object
