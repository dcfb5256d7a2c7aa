# SPDX-License-Identifier: Apache-2.0
"""The shape of a hand from its description: pads, pieces, housings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.camera.housings import mounted
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_grasp.sampling.hand_shape import HandShape
from tests.openarm_grasp.clouds import hand


def test_pads_of_a_slide_are_the_same_at_every_aperture_and_as_long_as_the_finger():
    pads = hand("openarm_v1").pads
    assert np.ptp(pads, axis=0).max() < 1e-6
    x_low, x_high, z_low, z_high = pads[0]
    assert (x_low, x_high) == pytest.approx((-0.0148, 0.0148), abs=0.0016)
    assert (z_low, z_high) == pytest.approx((-0.0326, 0.0028), abs=0.0016)


@pytest.mark.long
def test_pads_on_hinges_and_tips_move_with_the_aperture():
    shape = hand("openarm_v2")
    assert (shape.pads[:, 2] <= 0.002).all()
    assert (shape.pads[:, 3] >= -0.002).all()
    deepest = shape.tips[..., 2].max(axis=1)
    assert deepest[-1] < deepest[0] - 0.003  # open fingers are shorter


@pytest.mark.parametrize("robot", ["openarm_v1", "openarm_v2"])
@pytest.mark.parametrize("arm", ["left", "right"])
def test_the_points_of_a_hand_are_on_it_and_nothing_is_between_its_pads(robot, arm):
    shape = hand(robot, arm)
    holds = shape.holds(shape.points[::3])
    assert holds.min() > -0.0015
    assert holds.max() < 0.0031
    y = np.linspace(-0.9, 0.9, 9) * shape.opening
    assert (shape.holds(np.column_stack([np.zeros(9), y, np.zeros(9)])) < 0.0).all()
    assert shape.points[0, 2] == shape.points[:, 2].max()


def test_a_housing_is_where_calibration_says():
    cameras, robot = load_cameras(), RobotDescription.load("openarm_v1")
    wrist = cameras["wrist"]
    mount = wrist.T_parent_link.copy()
    mount[:3, 3] += (0.02, 0.0, 0.0)
    nominal, moved = (HandShape.of(robot, "right", mounted(cameras, to).values()) for to in ({}, {"wrist": mount}))
    q = dict.fromkeys(robot.joints, 0.0)
    T_tcp_parent = se3.inverse(robot.link_pose(robot.tcp_link("right"), q)) @ robot.link_pose(wrist.parent, q)
    middle = (T_tcp_parent @ wrist.T_parent_link @ wrist.T_link_housing)[None, :3, 3]
    moved_middle = (T_tcp_parent @ mount @ wrist.T_link_housing)[None, :3, 3]
    assert nominal.holds(middle)[0] == pytest.approx(0.015, abs=1e-6)
    assert moved.holds(moved_middle)[0] == pytest.approx(0.015, abs=1e-6)
    assert moved.holds(middle)[0] < 0.0
    without = HandShape.of(robot, "left", [wrist])
    assert len(without.starts) == len(nominal.starts) - 1


def test_fingers_without_a_shape_are_refused_by_name():
    robot = RobotDescription.load("openarm_v1")
    fingers = robot.arm("right").fingers
    links = {name: replace(link, collision=()) if name in fingers else link for name, link in robot.links.items()}
    with pytest.raises(OpenArmError, match="fingers of arm 'right' of robot 'openarm_v1' have no collision shapes"):
        HandShape.of(replace(robot, links=links), "right")
