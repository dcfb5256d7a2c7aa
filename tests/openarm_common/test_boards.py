# SPDX-License-Identifier: Apache-2.0
"""The board of a calibration is where the hand and the table of the robot are."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import uncertain_cameras
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import ROBOT, robot_names, robot_work
from openarm_common.scene.boards import board_of, board_places, board_scenes, board_start
from openarm_common.scene.scene import load_scene


def test_a_hand_holds_it_before_a_fixed_camera():
    (board,) = load_scene("calibration_overhead").fixtures
    assert (board.name, board.link) == ("board", "openarm_right_link7")
    place = se3.make(se3.rotation_from_z_y((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), (0, 0, 0.37))
    np.testing.assert_allclose(board.T_link_fixture, place, atol=1e-12)
    (other,) = load_scene("calibration_overhead_left_arm").fixtures
    assert other.link == "openarm_left_link7"


@pytest.mark.long
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
    places = board_places(uncertain_cameras())
    assert {place.scene for place in places} == board_scenes().keys() - {"calibration"}
    assert {f"calibration_{name}" for name in uncertain_cameras()} <= board_scenes().keys()
    for name in board_scenes():
        assert load_scene(name).objects == ()
        assert len(load_scene(name).fixtures) == 1


@pytest.mark.parametrize("robot", robot_names())
@pytest.mark.requirement("A-33", "R-06")
def test_a_calibration_begins_with_the_board_above_the_table_and_in_no_wall(robot, monkeypatch):
    """Home where that will do; in the Cell home would put the board into its side wall."""
    monkeypatch.setenv(ROBOT, robot)
    description = RobotDescription.load()
    for place in board_places(uncertain_cameras()):
        link, T_link_board = board_of(place.camera, description, place.arm)
        start = board_start(place)
        arms = {joint for arm in description.arm_names for joint in description.arm_joints(arm)}
        assert not (arms & start.keys() and robot in ("openarm_v1", "openarm_v2", "panda"))
        if not link:
            continue
        whole = dict.fromkeys(description.joints, 0.0)
        for arm in description.arm_names:
            whole |= description.group_state(f"{arm}_arm", "home")
        corners = np.array([(x, y, 0.0) for x in (-0.09, 0.09) for y in (-0.12, 0.12)])
        placed = se3.apply(description.link_pose(link, whole | start) @ T_link_board, corners)
        work = robot_work()
        above = placed[placed[:, 0] > work.table.x[0]]
        assert (above[:, 2] > work.table.top_z + 0.01).all()
        if description.lift is not None:
            assert np.abs(placed[:, 1]).max() < work.table.y[1] - 0.01
