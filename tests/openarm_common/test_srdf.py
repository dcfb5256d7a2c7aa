# SPDX-License-Identifier: Apache-2.0
"""Groups and postures of openarm.srdf, and an SRDF that does not fit its URDF."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription

mirror = RobotDescription.load().mirrored

MINI = """<robot name="mini"><link name="base"/><link name="slide"/>
  <joint name="j1" type="prismatic"><parent link="base"/><child link="slide"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""


@pytest.mark.parametrize("group", ["left_arm", "right_arm", "both_arms", "left_gripper", "right_gripper"])
def test_srdf_states_cover_their_group_within_limits(description: RobotDescription, group: str) -> None:
    side, part = group.split("_")
    sides = ("left", "right") if side == "both" else (side,)
    joints = (
        RobotDescription.load().arm_joints if part.startswith("arm") else lambda side: (description.finger_joint(side),)
    )
    names = tuple(name for side in sides for name in joints(side))
    lower, upper = description.limits(names)
    states = [name for g, name in description.semantics.states if g == group]
    assert {"open", "closed"} <= set(states) or {"home", "official_home", "hands_up", "zero"} <= set(states)
    for state in states:
        q = description.group_state(group, state)
        assert tuple(q) == names
        values = np.array(list(q.values()))
        assert (values >= lower).all()
        assert (values <= upper).all()


def test_srdf_home_is_the_observing_posture_and_mirrored(description: RobotDescription) -> None:
    right = list(description.group_state("right_arm", "home").values())
    assert right == [-0.2, 2.2, 0, 1.2, 0, 0, 0.4]
    np.testing.assert_allclose(list(description.group_state("left_arm", "home").values()), mirror(right))
    tcp = description.link_pose("openarm_right_hand_tcp", description.group_state("right_arm", "home"))[:3, 3]
    np.testing.assert_allclose(tcp, [0.41, -0.39, 0.79], atol=0.006)
    assert description.group_state("right_arm", "official_home")["openarm_right_joint4"] == 1.570796


@pytest.mark.parametrize(
    ("srdf", "words"),
    [
        ('<disable_collisions link1="base" link2="x"/>', "link 'x'"),
        ('<group name="g"/><group_state name="s" group="g"><joint name="j7" value="0"/></group_state>', "joint 'j7'"),
        ('<group_state name="s" group="g"><joint name="j1" value="0"/></group_state>', "group 'g'"),
    ],
)
def test_srdf_that_does_not_fit_the_urdf_is_refused(srdf: str, words: str) -> None:
    with pytest.raises(OpenArmError, match=words):
        RobotDescription.from_urdf(MINI, f"<robot>{srdf}</robot>")
