# SPDX-License-Identifier: Apache-2.0
"""Boxes around the robot's shapes: what is hidden."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_calibration.sampling.occluders import Occluders
from openarm_common.robot.description import RobotDescription

POLE = """<robot name="pole"><link name="base"/>
<link name="arm"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<link name="tip"><collision><geometry><cylinder radius="0.05" length="0.2"/></geometry></collision>
  <collision><origin xyz="0 0.8 0"/><geometry><sphere radius="0.1"/></geometry></collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
  <origin xyz="0.5 0 0"/><limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
<joint name="slide" type="prismatic"><parent link="base"/><child link="tip"/><axis xyz="1 0 0"/>
  <limit lower="0" upper="1" velocity="1" effort="1"/></joint></robot>"""


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
    occluders = Occluders(description)
    shapes = occluders.place(description.link_poses({"slide": 0.0, "turn": 0.0}))
    far = (3.0, 3.0, 3.0)
    assert occluders.hidden(shapes, np.array(eye), np.array([far, point])) is hidden
