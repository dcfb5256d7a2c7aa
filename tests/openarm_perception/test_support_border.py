# SPDX-License-Identifier: Apache-2.0
"""What the border of the image cuts stands on the plane, where the plane is seen at that border."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.camera.cameras import Intrinsics
from openarm_perception.segmentation.support import Support

LENS = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
#: The camera looks down by 30 degrees from 0.8 m over the plane.
NORMAL = np.array([0.0, -np.cos(np.pi / 6.0), -np.sin(np.pi / 6.0)])
OFFSET = 0.8


def on_plane(u: float, v: float) -> np.ndarray:
    ray = np.array([(u - LENS.cx) / LENS.fx, (v - LENS.cy) / LENS.fy, 1.0])
    return -OFFSET / float(ray @ NORMAL) * ray


def support(left: float, right: float) -> Support:
    """A table that is seen between two columns, from row 200 to the lower border."""
    axes = np.linalg.svd(NORMAL[None])[2][1:].T
    corners = [on_plane(u, v) for u, v in ((left, 200.0), (right, 200.0), (right, 479.0), (left, 479.0))]
    return Support(NORMAL, OFFSET, 0.002, np.array(corners) @ axes, axes, 0.6)


def over(u: float, v: float, height: float, table: Support) -> float:
    """Share over the table of a pillar whose foot is at a pixel, from a height on."""
    pillar = on_plane(u, v) + np.linspace(height, height + 0.03, 5)[:, None] * NORMAL
    return table.share_over(pillar, LENS)


@pytest.mark.requirement("R-19")
def test_a_thing_whose_foot_is_below_the_image_stands_on_the_table_that_is_seen_there():
    assert over(320.0, 520.0, 0.10, support(0.0, 639.0)) == 1.0
    assert over(320.0, 400.0, 0.10, support(0.0, 639.0)) == 1.0


@pytest.mark.requirement("R-19")
def test_a_thing_at_the_border_beyond_the_end_of_the_table_does_not():
    assert over(500.0, 520.0, 0.10, support(0.0, 300.0)) == 0.0
    assert over(500.0, 400.0, 0.10, support(0.0, 300.0)) == 0.0


def test_what_is_higher_than_things_are_does_not_either():
    assert over(320.0, 600.0, 0.30, support(0.0, 639.0)) == 0.0


def test_no_points_are_over_nothing():
    assert support(0.0, 639.0).share_over(np.empty((0, 3)), LENS) == 0.0
