# SPDX-License-Identifier: Apache-2.0
"""Errors of objects in images of a moving wrist camera, measured as `benchmarks.moving_camera` does."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.localization import Studio
from benchmarks.moving_camera import measure


@pytest.mark.long
@pytest.mark.requirement("B-61", "A-72")
def test_the_error_does_not_grow_with_the_speed_of_the_camera() -> None:
    """By the latest joint state, in the same images, it would be centimetres."""
    studio = Studio()
    rest, fast = (measure(studio, speed, 6, first_seed=700) for speed in (0.0, 0.4))
    studio.close()
    assert len(fast.suite) == len(rest.suite) >= 4
    assert max(fast.suite) <= max(rest.suite) + 0.5
    assert np.median(fast.latest) > 10.0
