# SPDX-License-Identifier: Apache-2.0
"""Boxes around the robot's shapes: forward kinematics of many postures, and what is hidden."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_calibration.sampling.bodies import Bodies, chain_poses
from openarm_common.robot.description import RobotDescription

POLE = """<robot name="pole"><link name="base"/>
<link name="arm"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<link name="tip"><collision><geometry><cylinder radius="0.05" length="0.2"/></geometry></collision>
  <collision><origin xyz="0 0.8 0"/><geometry><sphere radius="0.1"/></geometry></collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
  <origin xyz="0.5 0 0"/><limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
<joint name="slide" type="prismatic"><parent link="base"/><child link="tip"/><axis xyz="1 0 0"/>
  <limit lower="0" upper="1" velocity="1" effort="1"/></joint></robot>"""


@pytest.fixture(scope="module")
def openarm() -> RobotDescription:
    return RobotDescription.load()


def test_many_postures_at_once_are_those_one_by_one(openarm: RobotDescription) -> None:
    link = "openarm_right_hand_tcp"
    names = [joint.name for joint in openarm.chain(link) if joint.type != "fixed"]
    q = np.random.default_rng(0).uniform(-0.5, 0.5, (5, len(names)))
    for k, T in enumerate(chain_poses(openarm, link, q)):
        expected = openarm.link_pose(link, dict(zip(names, q[k].tolist(), strict=True)))
        np.testing.assert_allclose(T, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("eye", "point", "hidden"),
    [
        ((0.5, 0.0, 1.0), (0.5, 0.0, -1.0), True),  # through the cube
        ((0.5, 0.0, 1.0), (0.5, 0.0, 0.1), False),  # ends before it
        ((0.5, 0.1, 1.0), (0.5, 0.1, -1.0), False),  # passes it
        ((-0.3, 0.0, 0.0), (-1.0, 0.0, 0.0), False),  # everything is behind the eye
        ((0.0, 0.8, 1.0), (0.0, 0.8, -1.0), True),  # through the ball
        ((0.0, 0.95, 1.0), (0.0, 0.95, -1.0), False),  # passes it
    ],
)
def test_hidden_is_what_has_a_shape_before_it(eye: tuple, point: tuple, hidden: bool) -> None:
    description = RobotDescription.from_urdf(POLE)
    bodies = Bodies(description)
    shapes = bodies.place(description.link_poses({"slide": 0.0, "turn": 0.0}))
    far = (3.0, 3.0, 3.0)
    assert bodies.hidden(shapes, np.array(eye), np.array([far, point])) is hidden
