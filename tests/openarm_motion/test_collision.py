# SPDX-License-Identifier: Apache-2.0
"""Exact collision checks."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_motion.collision.exact import Clearance, CollisionContext, CollisionScene
from openarm_motion.collision.robot import CollisionRobot
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.kinematics.chain import ArmKinematics, ArmLinks
from openarm_motion.planning.arm import Arm
from tests.refusals import refused

mirror = RobotDescription.load().mirrored

BARE = Clearance(own=0.0, world=0.0, arms=0.0, hand=0.0, touch=0.0, rest=0.0)


def q_of(arm: Arm, state: dict[str, float]) -> np.ndarray:
    return np.array([state[name] for name in arm.names])


def pair(scene: CollisionScene, q: np.ndarray) -> set[str]:
    contact = scene.contacts(q)[0]
    return {contact.first, contact.second}


def test_links_are_sorted_by_the_tree_alone(right: Arm, six: RobotDescription) -> None:
    links = right.robot.arm
    assert links.gripper == {"openarm_right_left_finger", "openarm_right_right_finger"}
    assert links.hand == links.gripper | {"openarm_right_hand", "openarm_right_hand_tcp"}
    assert "openarm_body_link0" in links.fixed
    assert "openarm_right_link0" in links.fixed
    assert "openarm_right_link1" in links.moving
    assert not any("left_link" in link for link in links.moving)
    other = ArmLinks.of(six, ArmKinematics(six, "tool"))
    assert other.gripper == frozenset()
    assert other.hand == {"flange_link", "tool"}


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.requirement("A-74")
def test_known_postures_are_free(
    arms: dict[str, Arm], home: dict[str, float], description: RobotDescription, side: str
) -> None:
    arm = arms[side]
    scene = arm.scene(home)
    assert scene.contacts(q_of(arm, home)) == []
    for posture in ("official_home", "hands_up"):
        state = description.group_state(f"{side}_arm", posture)
        assert scene.contacts(q_of(arm, state)) == [], posture
    assert arm.scene(dict.fromkeys(home, 0.0)).contacts(np.zeros(7)) == []


def test_the_wrist_camera_is_part_of_the_arm(arms: dict[str, Arm], home: dict[str, float]) -> None:
    """In this posture the camera on the right hand meets the right shoulder; without the camera it is free."""
    q = np.array([-0.402, 2.745, 0.843, 2.151, -0.56, 0.217, 1.045])
    contacts = arms["right"].scene(home).contacts(q)
    assert {name for c in contacts for name in (c.first, c.second)} >= {"openarm_right_link7", "openarm_right_link1"}
    assert arms["left"].scene(home).contacts(mirror(q)) == []


@pytest.mark.requirement("A-74")
def test_crossed_arms_are_caught_and_the_pair_is_named(arms: dict[str, Arm], home: dict[str, float]) -> None:
    # both hands on the centre line, reached from either side: fine alone, a collision together
    crossed = {}
    for side, arm in arms.items():
        pose = se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.28, 0.0, 0.60))
        solutions = arm.inverse.solutions(pose, 0.05)
        assert solutions, side
        alone = arm.scene(home)
        free = [s.q for s in solutions if not alone.collides(s.q)]
        assert free, side
        crossed[side] = free[0]
    state = {**home, **dict(zip(arms["left"].names, crossed["left"].tolist(), strict=True))}
    contacts = arms["right"].scene(state).contacts(crossed["right"])
    assert contacts
    assert all("right" in c.first and "left" in c.second for c in contacts)


@pytest.mark.requirement("A-74")
def test_verdicts_mirror_from_arm_to_arm(arms: dict[str, Arm], home: dict[str, float]) -> None:
    left, right = arms["left"].scene(home), arms["right"].scene(home)
    arm = arms["right"].kinematics
    rng = np.random.default_rng(11)
    same = [right.collides(q) == left.collides(mirror(q)) for q in rng.uniform(arm.lower, arm.upper, (400, 7))]
    # hand and link4 are not mirrored parts, so a graze may differ
    assert np.mean(same) > 0.98


def test_shapes_in_a_block_collide_by_an_independent_count(right: Arm, home: dict[str, float]) -> None:
    # corners of the collision shapes, moved by the description's own kinematics, inside a block
    low, high = np.array([0.11, -0.6, 0.10]), np.array([0.81, 0.6, 0.60])
    block = box_from("block", 0.5 * (low + high), high - low)
    scene = CollisionScene(right.robot, CollisionContext(home, [block], clearance=BARE, own=False))
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    arm, description = right.kinematics, right.description
    rng = np.random.default_rng(12)
    hits = 0
    for q in rng.uniform(arm.lower, arm.upper, (300, 7)):
        poses = description.link_poses({**home, **dict(zip(arm.names, q, strict=True))})
        inside = False
        for link in right.robot.arm.moving:
            for shape in description.links[link].collision:
                if shape.kind != "box":
                    continue
                points = se3.apply(poses[link] @ shape.T_link_primitive, corners * np.array(shape.size))
                inside |= bool(np.any(np.all((points > low) & (points < high), axis=1)))
        if inside:
            hits += 1
            assert scene.collides(q)
    assert hits > 20


def test_clearance_is_kept_and_stated(right: Arm, home: dict[str, float]) -> None:
    q = q_of(right, home)
    tip = right.kinematics.fk(q)
    # a box a little beyond the fingers, along the tool's z (the tips reach 3 mm beyond the tool centre point)
    for gap, expected in ((0.030, False), (0.008, True)):
        box = Box("post", tip @ se3.make(None, (0, 0, 0.003 + gap + 0.01)), np.array([0.02, 0.02, 0.02]))
        contacts = right.scene(home, [box]).contacts(q)
        assert bool(contacts) == expected
    assert 0.0 < contacts[0].distance < 0.010
    assert "mm of post, expected 10 mm" in str(contacts[0])


def test_fingers_may_touch_what_is_touchable_but_the_palm_may_not(right: Arm, home: dict[str, float]) -> None:
    q = q_of(right, home)
    tip = right.kinematics.fk(q)
    between = Box("cube", tip, np.array([0.04, 0.06, 0.04]))
    state = right.with_gripper(home, 0.03)
    assert right.scene(state, [between], straight=True).contacts(q)
    assert not right.scene(state, [between], touchable=frozenset({"cube"}), straight=True).contacts(q)
    long = Box("cube", tip, np.array([0.04, 0.06, 0.16]))  # reaches through the palm, 57 mm behind the tool centre
    contacts = right.scene(state, [long], touchable=frozenset({"cube"}), straight=True).contacts(q)
    assert {c.first for c in contacts} >= {"openarm_right_hand"}


def test_attached_object_collides_with_the_table_and_obstacles_but_not_with_the_hand(
    right: Arm, home: dict[str, float]
) -> None:
    held = Box("cube", np.eye(4), np.array([0.05, 0.05, 0.08]))
    q = q_of(right, home)
    assert not right.scene(home, held=[held]).contacts(q)
    pose = se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.25, -0.25, 0.432))  # 8 mm too low for the box
    low = next(s.q for s in right.inverse.solutions(pose, 0.05) if not right.scene(home).collides(s.q))
    assert not right.scene(home).collides(low)
    contact = right.scene(home, held=[held]).contacts(low)[0]
    assert (contact.first, contact.second) == ("held cube", "table")
    assert contact.distance == pytest.approx(-0.008, abs=1e-3)
    wall = Box("wall", right.kinematics.fk(q) @ se3.make(None, (0, 0, 0.05)), np.array([0.1, 0.1, 0.02]))
    assert pair(right.scene(home, [wall], [held]), q) == {"held cube", "wall"}


def test_a_held_object_may_stand_on_the_table_on_straight_parts(right: Arm, home: dict[str, float]) -> None:
    held = Box("cube", np.eye(4), np.array([0.05, 0.05, 0.06]))
    for height, free in ((0.430 + 0.001, True), (0.430 - 0.003, True), (0.430 - 0.006, False)):
        pose = se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.25, -0.25, height))
        q = next(s.q for s in right.inverse.solutions(pose, 0.05) if not right.scene(home).collides(s.q))
        assert right.scene(home, held=[held], straight=True).collides(q) != free


def test_fingers_are_where_they_are(right: Arm, home: dict[str, float]) -> None:
    q = q_of(right, home)
    tip = right.kinematics.fk(q)
    post = Box("post", tip @ se3.make(None, (0.0, 0.055, -0.02)), np.array([0.02, 0.02, 0.02]))
    assert not right.scene(right.with_gripper(home, 0.0), [post]).collides(q)
    assert right.scene(right.with_gripper(home, 0.044), [post]).collides(q)
    contact = right.scene(right.with_gripper(home, 0.044), [post]).contacts(q)[0]
    assert contact.first == "openarm_right_left_finger"  # the follower moves too, on the +y side


def test_a_thin_post_between_two_free_ends_is_not_stepped_over(right: Arm, home: dict[str, float]) -> None:
    a = q_of(right, home)
    b = a + np.array([0.5, 0, 0, 0, 0, 0, 0])
    middle = right.kinematics.fk(0.5 * (a + b))[:3, 3]
    post = box_from("post", middle, (0.004, 0.004, 0.004))
    scene = right.scene(home, [post])
    assert not scene.collides(a)
    assert not scene.collides(b)
    assert not scene.edge_free(a, b, 0.05, 0.02)
    hit = scene.first_hit(a, b)
    assert hit is not None
    assert scene.collides(hit)


def test_levers_bound_the_travel_of_every_point(right: Arm, home: dict[str, float]) -> None:
    arm, robot = right.kinematics, right.robot
    rng = np.random.default_rng(14)
    for q in rng.uniform(arm.lower, arm.upper, (40, 7)):
        dq = rng.uniform(-0.01, 0.01, 7)
        a, b = (right.description.link_poses({**home, **dict(zip(arm.names, x, strict=True))}) for x in (q, q + dq))
        bound = float(np.abs(dq) @ robot.levers)
        for link in robot.arm.moving:
            for shape in right.description.links[link].collision:
                centre = shape.T_link_primitive[:3, 3]
                assert np.linalg.norm(se3.apply(b[link], centre) - se3.apply(a[link], centre)) <= bound


def test_an_arm_may_leave_a_place_that_is_too_near(right: Arm, home: dict[str, float]) -> None:
    q = q_of(right, home)
    tip = right.kinematics.fk(q)
    near = Box("post", tip @ se3.make(None, (0, 0, 0.003 + 0.004 + 0.01)), np.array([0.02, 0.02, 0.02]))
    scene = right.scene(home, [near])
    assert scene.collides(q)
    assert scene.relax(q, 0.005) is None
    assert not scene.collides(q)
    closer = right.inverse.nearest(tip @ se3.make(None, (0, 0, 0.004)), q).q
    assert scene.collides(closer)
    deep = Box("post", tip, np.array([0.02, 0.05, 0.05]))
    contact = right.scene(home, [deep]).relax(q, 0.005)
    assert contact is not None
    assert contact.second == "post"
    # an estimate that is 1 to 3 cm out can't hold the arm: it is where it is
    over = Box("cube", tip @ se3.make(None, (0, 0, 0.003 - 0.012 + 0.025)), np.array([0.05, 0.05, 0.05]))
    stuck = right.scene(home, [over])
    assert stuck.relax(q, 0.005) is not None
    assert stuck.relax(q, 0.005, 0.03) is None
    assert not stuck.collides(q)


def test_boxes_move_without_a_new_scene(right: Arm, home: dict[str, float]) -> None:
    q = q_of(right, home)
    tip = right.kinematics.fk(q)
    box = box_from("box", (0.9, 0.9, 0.9), (0.05, 0.05, 0.05))
    held = Box("cube", np.eye(4), np.array([0.04, 0.04, 0.04]))
    scene = right.scene(home, [box], [held])
    assert not scene.collides(q)
    scene.place("box", tip @ se3.make(None, (0, 0, 0.05)))
    assert scene.collides(q)
    scene.place("box", box.T)
    scene.place("cube", se3.make(None, (0, 0, -0.25)))
    assert {"held cube"} <= {c.first for c in scene.contacts(q)}


def test_bad_boxes_are_refused(right: Arm, home: dict[str, float]) -> None:
    refused(r"box 'flat' has size .* expected three edges > 0", box_from, "flat", (0, 0, 0), (0.1, 0.1, 0.0))
    box = box_from("twin", (1, 1, 1), (0.1, 0.1, 0.1))
    refused("two boxes have the id 'twin'", right.scene, home, [box, box])


@pytest.mark.requirement("B-07")
def test_another_robot_without_srdf_is_checked(six: RobotDescription) -> None:
    robot = CollisionRobot(six, ArmKinematics(six, "tool"))
    scene = CollisionScene(robot, CollisionContext({}))
    assert scene.contacts(np.zeros(6)) == []
    assert scene.contacts(np.array([0, 1.8, 2.3, 0, 0, 0.0]))
    wall = CollisionScene(robot, CollisionContext({}, [box_from("wall", (0, 0, 1.15), (0.3, 0.3, 0.1))]))
    assert wall.contacts(np.zeros(6))[0].second == "wall"


def test_meshes_are_refused_with_the_link(six: RobotDescription) -> None:
    text = six.urdf.replace('<box size="0.06 0.06 0.06"/>', '<mesh filename="package://arm/waist.stl"/>', 1)
    robot = RobotDescription.from_urdf(text)
    refused("'waist_link' has meshes", CollisionRobot, robot, ArmKinematics(robot, "tool"))


def test_a_follower_may_come_before_its_leader_by_name() -> None:
    description = RobotDescription.load("ur5e")
    renamed = description.urdf.replace("robotiq_left_driver_joint", "z_driver_joint")
    other = replace(RobotDescription.from_urdf(renamed, ""), links=description.links)
    kinematics = [ArmKinematics(robot, "ur5e_tcp") for robot in (description, other)]
    (one, two) = (CollisionRobot(robot, k) for robot, k in zip((description, other), kinematics, strict=True))
    poses = []
    for robot, leader in ((one, "robotiq_left_driver_joint"), (two, "z_driver_joint")):
        data = robot.model.createData()
        pin.forwardKinematics(robot.model, data, robot.configuration({leader: 0.4}))
        names = ("robotiq_right_follower_joint", "robotiq_left_spring_link_joint")
        poses.append([data.oMi[robot.model.getJointId(name)].homogeneous for name in names])
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-12)
