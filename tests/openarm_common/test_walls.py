# SPDX-License-Identifier: Apache-2.0
"""The direction of most walls of a cloud seen from above."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.walls import wall_yaw

pytestmark = pytest.mark.requirement("R-19")


def _filled(x: float, y: float, at: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    grid = np.stack(np.meshgrid(np.arange(-x / 2, x / 2, 0.002), np.arange(-y / 2, y / 2, 0.002)), axis=-1)
    return grid.reshape(-1, 2) + at


@pytest.mark.parametrize("turn_deg", [-40.0, -10.0, 0.0, 25.0])
def test_a_hammer_is_turned_as_its_handle(turn_deg: float):
    hammer = np.concatenate([_filled(0.03, 0.26), _filled(0.12, 0.03, (0.02, 0.14))])
    turned = hammer @ se3.rot_z(np.radians(turn_deg))[:2, :2].T
    off = np.degrees(wall_yaw(turned, 0.0025)) - turn_deg
    assert abs((off + 45.0) % 90.0 - 45.0) < 2.0
