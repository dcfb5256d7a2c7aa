# SPDX-License-Identifier: Apache-2.0
"""Reading any URDF, and refusing a faulty one by name."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from tests.refusals import refused

MINI = """<robot name="mini">
  <link name="base"><visual name="v"><geometry><sphere radius="0.1"/></geometry></visual></link>
  <link name="slide"><collision name="c"><geometry><mesh filename="m.stl"/></geometry></collision></link>
  <link name="follow"/>
  <joint name="j1" type="prismatic"><parent link="base"/><child link="slide"/><axis xyz="0 0 2"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <joint name="j2" type="continuous"><parent link="slide"/><child link="follow"/><origin xyz="1 0 0" rpy="0 0 1"/>
    <axis xyz="0 0 1"/><mimic joint="j1" multiplier="-2" offset="0.5"/></joint>
</robot>"""


@pytest.mark.requirement("B-07")
def test_any_robot_can_be_read() -> None:
    robot = RobotDescription.from_urdf(MINI)
    assert (robot.root, robot.name) == ("base", "mini")
    assert robot.links["base"].visual[0].size == (0.1,)
    assert robot.links["slide"].unread == ("c",)
    assert robot.joints["j2"].upper == np.inf
    T = robot.link_pose("follow", {"j1": 0.25})
    np.testing.assert_allclose(T, se3.make(se3.rot_z(1.0 - 2 * 0.25 + 0.5), (1, 0, 0.25)))
    np.testing.assert_allclose(robot.link_poses({"j1": 0.25})["follow"], T)


@pytest.mark.parametrize(
    ("find", "replace", "words"),
    [
        ('<link name="follow"/>', '<link name="follow"/><link name="base"/>', "link name 'base' is used twice"),
        ('name="j2"', 'name="j1"', "joint name 'j1' is used twice"),
        ('name="c"', 'name="v"', "name 'v' is used twice"),
        ('<child link="follow"/>', '<child link="nowhere"/>', "'nowhere', which does not exist"),
        ('<link name="follow"/>', '<link name="follow"/><link name="loose"/>', "one root link, found 2: base, loose"),
        ('<parent link="base"/>', '<parent link="follow"/>', "one root link, found 2|loop"),
        ('type="continuous"', 'type="ball"', "joint 'j2' has type 'ball'; supported: revolute, .*, prismatic, fixed$"),
        ('type="continuous"', 'type="floating"', "joint 'j2' has type 'floating'; .*, fixed; .* write type=\"fixed\""),
        ('type="continuous"', 'type="planar"', "joint 'j2' has type 'planar'; .*, fixed; .* write type=\"fixed\""),
        ('<limit lower="0" upper="1" effort="1" velocity="1"/>', "", "no <limit>"),
        ('lower="0"', 'lower="2"', "lower limit 2.0 above"),
        ('xyz="1 0 0"', 'xyz="1 0 nan"', "3 finite numbers"),
        ('mimic joint="j1"', 'mimic joint="j9"', "mimics 'j9', which does not exist"),
        ("</robot>", "", "not XML"),
        ('axis xyz="0 0 2"', 'axis xyz="0 0 0"', "axis"),
        ("sphere", "cone", "<cone> is none of box, cylinder, sphere, mesh"),
    ],
)
@pytest.mark.requirement("A-11")
def test_faulty_descriptions_are_refused_by_name(find: str, replace: str, words: str) -> None:
    assert MINI.count(find) >= 1
    assert refused(words, RobotDescription.from_urdf, MINI.replace(find, replace, 1)).code is Code.CONFIG_INVALID


@pytest.mark.requirement("A-11")
def test_a_fixed_joint_has_no_axis_and_follows_nothing() -> None:
    """As exporters write them: a zero axis, and a mimic of another fixed joint."""
    text = MINI.replace("</robot>", '<link name="tip"/><link name="tail"/>')
    for name, parent, child in (("f1", "follow", "tip"), ("f2", "tip", "tail")):
        text += (
            f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 0"/>'
            '<origin xyz="0 0 1"/><mimic joint="f1"/></joint>'
        )
    robot = RobotDescription.from_urdf(text + "</robot>")
    assert robot.joints["f2"].mimic is None
    follow, tail = (robot.link_pose(link, {"j1": 0.25}) for link in ("follow", "tail"))
    np.testing.assert_allclose(tail, follow @ se3.make(None, (0, 0, 2)))
