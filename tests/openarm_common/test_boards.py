# SPDX-License-Identifier: Apache-2.0
"""The board of a calibration is where the hand and the table of the robot are."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import uncertain_cameras
from openarm_common.robot.folder import ROBOT, robot_names
from openarm_common.scene.boards import board_scenes
from openarm_common.scene.scene import load_scene


def test_a_hand_holds_it_before_a_fixed_camera():
    (board,) = load_scene("calibration_overhead").fixtures
    assert (board.name, board.link) == ("board", "openarm_right_link7")
    place = se3.make(se3.rotation_from_z_y((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), (0, 0, 0.37))
    np.testing.assert_allclose(board.T_link_fixture, place, atol=1e-12)


@pytest.mark.parametrize(("robot", "place"), [("openarm_v1", (0.33, -0.2, 0.405)), ("nearer", (0.32, -0.2, 0.455))])
def test_it_lies_on_the_table_before_the_camera_of_a_hand(nearer, monkeypatch, robot, place):
    monkeypatch.setenv(ROBOT, robot)
    (board,) = load_scene("calibration_wrist").fixtures
    assert board.link == ""
    lies = se3.make(se3.rotation_from_z_y((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0)), place)
    np.testing.assert_allclose(board.T_link_fixture, lies, atol=1e-12)
    assert load_scene("calibration").fixtures == (board,)


@pytest.mark.parametrize("robot", robot_names())
def test_each_camera_whose_mount_is_not_known_has_a_scene(robot, monkeypatch):
    monkeypatch.setenv(ROBOT, robot)
    assert {f"calibration_{name}" for name in uncertain_cameras()} == board_scenes().keys() - {"calibration"}
    for name in board_scenes():
        assert load_scene(name).objects == ()
        assert len(load_scene(name).fixtures) == 1
