# SPDX-License-Identifier: Apache-2.0
"""Links that a design holds apart: what is found, and what is asked of them."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.collision.held_apart import held_apart
from openarm_common.robot.description import RobotDescription

pytestmark = pytest.mark.requirement("R-05")

#: A flat arm: `tip` turns on `arm` about z, at `gap` next to the post; a second joint turns `post` where it is.
_URDF = """<robot name="flat">
 <link name="base"/>
 <link name="post"><collision name="post"><geometry><sphere radius="0.05"/></geometry></collision></link>
 <link name="arm"/>
 <link name="tip"><collision name="tip"><origin xyz="{x} 0 0"/><geometry><sphere radius="0.02"/></geometry></collision>
 </link>
 <joint name="turn" type="revolute"><parent link="base"/><child link="post"/><axis xyz="0 0 1"/>
  <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
 <joint name="mount" type="fixed"><parent link="post"/><child link="arm"/><origin xyz="0.10 0 0"/></joint>
 <joint name="swing" type="revolute"><parent link="arm"/><child link="tip"/><axis xyz="0 0 1"/>
  <limit lower="{lower}" upper="2.9" effort="1" velocity="1"/></joint>
 <joint name="slide" type="prismatic"><parent link="tip"/><child link="end"/><axis xyz="1 0 0"/>
  <limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>
 <link name="end"><collision name="end"><origin xyz="0 0 0.2"/><geometry><sphere radius="0.02"/></geometry></collision>
 </link>
</robot>"""


def flat(x: float, lower: float) -> RobotDescription:
    return RobotDescription.from_urdf(_URDF.format(x=x, lower=lower), '<robot name="flat"/>')


def test_the_least_distance_over_the_range_of_the_joints_is_found() -> None:
    """The tip comes nearest at the end of its swing: the distance there, to 10 µm."""
    x, end = 0.03, 2.9
    away = np.hypot(0.10 + x * np.cos(end), x * np.sin(end)) - 0.07
    found = held_apart(flat(x, 0.0), 0.02)
    assert 0.0 < away < 0.02
    assert found == {frozenset({"post", "tip"}): pytest.approx(away, abs=1e-5)}


def test_links_that_touch_somewhere_or_stay_far_are_left_out() -> None:
    assert held_apart(flat(0.04, 0.0), 0.02) == {}
    assert held_apart(flat(0.0, 0.0), 0.02) == {}
