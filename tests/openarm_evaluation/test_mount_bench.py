# SPDX-License-Identifier: Apache-2.0
"""The board of a campaign's calibrations is where the hand and the table of the robot are."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.robot.folder import ROBOT
from openarm_evaluation.campaign.mounts import Bench


def board(camera: str, folder) -> tuple[str, str, np.ndarray]:
    bench = Bench(load_cameras()[camera], 1, folder)
    return bench.samples.head.setup, bench.samples.head.carrier, bench._T_carrier_board


def test_a_hand_holds_it_before_a_fixed_camera(tmp_path):
    setup, carrier, T = board("overhead", tmp_path)
    assert (setup, carrier) == ("to_hand", "openarm_right_link7")
    np.testing.assert_array_equal(T, se3.make(se3.rotation_from_z_y((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), (0, 0, 0.37)))


@pytest.mark.parametrize(("robot", "place"), [("openarm_v1", (0.33, -0.2, 0.405)), ("nearer", (0.32, -0.2, 0.455))])
def test_it_lies_on_the_table_before_the_camera_of_a_hand(tmp_path, nearer, monkeypatch, robot, place):
    monkeypatch.setenv(ROBOT, robot)
    setup, carrier, T = board("wrist", tmp_path)
    assert (setup, carrier) == ("in_hand", "openarm_right_link7")
    np.testing.assert_array_equal(T, se3.make(se3.rotation_from_z_y((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0)), place))
