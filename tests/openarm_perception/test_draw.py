# SPDX-License-Identifier: Apache-2.0
"""Pictures of detections."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_perception.detection.draw import annotate


@pytest.mark.requirement("B-20")
def test_located_and_refused_objects_look_different_and_the_input_stays(tabletop, pipeline) -> None:
    whole = tabletop.Thing("red", "box", (0.05, 0.05, 0.05), 0.25, -0.2, 0.3)
    cut = tabletop.Thing("blue", "box", (0.06, 0.06, 0.06), 0.25, 0.51)
    view = tabletop.render([whole, cut])
    before = view.rgb.copy()
    perceived = view.perceived(pipeline)
    assert ([p.label for p in perceived.located], len(perceived.refused)) == (["red"], 1)
    picture = annotate(view.rgb, perceived)
    np.testing.assert_array_equal(view.rgb, before)
    drawn = (picture != view.rgb).any(axis=-1)
    colors = {tuple(color) for color in picture[drawn].tolist()}
    assert {(0, 120, 140), (190, 40, 40)} <= colors
    red = next(d for d in perceived.found if d.label == "red")
    u, v = (round(c) for c in red.centre)
    np.testing.assert_array_equal(picture[v, u], view.rgb[v, u])  # no tag lies on the object
