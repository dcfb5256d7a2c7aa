# SPDX-License-Identifier: Apache-2.0
"""The SRDF of each robot is what its semantics.yaml says, and its matrix leaves out nothing that can touch."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest

from openarm_common.collision.self_collision import LinkContacts
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import load_folder, robot_names
from openarm_motion.collision.solids import solid_from
from openarm_sim_bridge.drafting.collisions import adjacent_pairs, mirror_links
from openarm_sim_bridge.drafting.semantics import SOURCE, SemanticsSource, classify, read_source, srdf_text

ROBOTS = [name for name in robot_names() if (load_folder(name)[0] / SOURCE).is_file()]
#: A post on the ground; on it a lever that turns, whose end always reaches into a ring that is fixed to the post.
LEVER = """<robot name="lever">
  <link name="ground"><collision name="g"><geometry><box size="1 1 0.1"/></geometry></collision></link>
  <link name="post"><collision name="p"><origin xyz="0 0 1"/><geometry><box size="0.1 0.1 0.1"/></geometry></collision>
  </link>
  <link name="lever"><collision name="l"><origin xyz="0.3 0 0"/><geometry><box size="0.4 0.02 0.02"/></geometry>
    </collision></link>
  <link name="ring"><collision name="r"><geometry><cylinder radius="0.3" length="0.05"/></geometry></collision></link>
  <link name="hat"><collision name="h"><geometry><sphere radius="0.02"/></geometry></collision></link>
  <joint name="j0" type="prismatic"><parent link="ground"/><child link="post"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>
  <joint name="j1" type="continuous"><parent link="post"/><child link="lever"/><origin xyz="0 0 1.2"/>
    <axis xyz="0 0 1"/></joint>
  <joint name="j2" type="revolute"><parent link="post"/><child link="ring"/><origin xyz="0 0 1.2"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <joint name="j3" type="revolute"><parent link="post"/><child link="hat"/><origin xyz="0.2 0 1.22"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request: pytest.FixtureRequest) -> RobotDescription:
    return RobotDescription.load(request.param)


def reasons(description: RobotDescription) -> dict[frozenset[str], str]:
    found = ET.fromstring(description.srdf).findall("disable_collisions")
    return {frozenset((e.get("link1", ""), e.get("link2", ""))): e.get("reason", "") for e in found}


def test_the_srdf_is_what_semantics_yaml_says(robot):
    source = read_source(load_folder(robot.name)[0])
    assert srdf_text(robot, source, reasons(robot)) == robot.srdf


@pytest.mark.requirement("A-74")
def test_the_matrix_is_symmetric_and_keeps_what_must_be_checked(robot):
    source = read_source(load_folder(robot.name)[0])
    image, why = mirror_links(robot), reasons(robot)
    assert {frozenset(map(image.__getitem__, pair)) for pair in why} == set(why)
    assert len(source.checked(robot.arms)) > (50 if len(robot.arms) == 2 else 10)
    assert not set(why) & source.checked(robot.arms)
    assert {pair for pair, reason in why.items() if reason == "Adjacent"} == adjacent_pairs(robot)
    assert source.allowed(robot.arms) <= set(why)


@pytest.mark.requirement("A-74")
def test_no_pair_that_is_said_never_to_touch_does(robot):
    never = {pair for pair, reason in reasons(robot).items() if reason == "Never"}
    touching = LinkContacts(robot).touching(300, seed=7)
    assert len(never) > (50 if len(robot.arms) == 2 else 20)
    assert len(touching) > (30 if len(robot.arms) == 2 else 15)
    assert not never & touching


def test_links_that_touch_are_those_that_the_exact_layer_finds(robot):
    contacts, rng, margin = LinkContacts(robot, 0.01), np.random.default_rng(3), 0.01
    model, geometry, owners = pin.buildModelFromXML(robot.urdf), pin.GeometryModel(), []
    for link in robot.links.values():
        frame = model.frames[model.getFrameId(link.name, pin.FrameType.BODY)]
        for shape in link.collision:
            placement = frame.placement * pin.SE3(shape.T_link_primitive)
            coal_shape = solid_from(shape.name, np.eye(4), shape).geometry
            geometry.addGeometryObject(pin.GeometryObject(f"{len(owners)}", frame.parentJoint, placement, coal_shape))
            owners.append(link.name)
    geometry.addAllCollisionPairs()
    data, placed = model.createData(), geometry.createData()
    joints = [joint for joint in robot.joints.values() if joint.type != "fixed"]
    for _ in range(5):
        state = {j.name: rng.uniform(max(j.lower, -np.pi), min(j.upper, np.pi)) for j in joints if j.mimic is None}
        state |= {j.name: j.multiplier * state[j.mimic] + j.offset for j in joints if j.mimic is not None}
        q = np.array(pin.neutral(model))
        for name, value in state.items():
            at = model.joints[model.getJointId(name)]
            q[at.idx_q : at.idx_q + at.nq] = value if at.nq == 1 else (np.cos(value), np.sin(value))
        pin.computeDistances(model, data, geometry, placed, q)
        near, nearer = set(), set()
        for pair, result in zip(geometry.collisionPairs, placed.distanceResults, strict=True):
            links = frozenset((owners[pair.first], owners[pair.second]))
            near |= {links} if result.min_distance < margin + 1e-4 else set()
            nearer |= {links} if result.min_distance < margin - 1e-4 else set()
        assert nearer <= contacts.at(state) <= near


@pytest.fixture
def mirrored(robot: RobotDescription) -> RobotDescription:
    if not robot.mirror:
        pytest.skip("its arms are no mirror images")
    return robot


def test_each_link_of_an_arm_has_one_image_on_the_other(mirrored):
    robot, image = mirrored, mirror_links(mirrored)
    assert {image[image[link]] == link for link in robot.links} == {True}
    for arm in robot.arms:
        assert {robot.arm_of(image[link]) for link in robot.links_of(arm)} == set(robot.arms) - {arm}
        other = robot.arm(robot.arm_of(image[robot.arm(arm).flange]))
        assert {image[finger] for finger in robot.arm(arm).fingers} == set(other.fingers)


@pytest.mark.parametrize("touching", [True, False])
def test_reasons_of_a_lever_in_a_ring(touching):
    text = (
        LEVER
        if touching
        else LEVER.replace('child link="ring"/><origin xyz="0 0 1.2"', 'child link="ring"/><origin xyz="0 0 1.4"')
    )
    found = classify(RobotDescription.from_urdf(text), SemanticsSource(postures={}, samples=300))
    assert found[frozenset(("lever", "ring"))] == ("Always" if touching else "Never")
    assert found[frozenset(("ground", "post"))] == "Adjacent"
    assert found[frozenset(("ground", "lever"))] == "Never"
    assert frozenset(("lever", "hat")) not in found  # now and then


def test_links_that_must_be_checked_stay_so_though_they_never_touch():
    source = SemanticsSource(postures={}, samples=50, always_checked=((("ground",), ("lever", "hat")),))
    found = classify(RobotDescription.from_urdf(LEVER), source)
    assert not {frozenset(("ground", "lever")), frozenset(("ground", "hat"))} & set(found)
    with pytest.raises(OpenArmError, match="no link roof"):
        classify(RobotDescription.from_urdf(LEVER), SemanticsSource(postures={}, may_touch=(("roof", "lever"),)))


def test_mirrored_postures_are_mirror_images(mirrored):
    robot = mirrored
    zero = dict.fromkeys(robot.joints, 0.0)
    (first, second), image = robot.arm_names, mirror_links(robot)
    for group, name in robot.semantics.states:
        if group == "both_arms":
            poses = robot.link_poses({**zero, **robot.group_state(group, name)})
            for link in (robot.tcp_link(first), robot.arm(first).flange):
                p = poses[link][:3, 3] * (1.0, -1.0, 1.0)
                np.testing.assert_allclose(p, poses[image[link]][:3, 3], atol=1e-4)
    assert robot.arm(second).tcp == image[robot.tcp_link(first)]
