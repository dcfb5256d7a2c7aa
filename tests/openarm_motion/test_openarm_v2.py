# SPDX-License-Identifier: Apache-2.0
"""OpenArm v2 through the code of OpenArm v1, by its folder alone."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_motion.collision.solids import box_from
from openarm_motion.config import MotionConfig
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.moves import RequestBoxes, to_pose

TABLE = box_from("table", (0.46, 0.0, 0.43), (0.7, 1.2, 0.04))  # its top is at 0.45 m


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return RobotDescription.load("openarm_v2")


@pytest.fixture(scope="module")
def arm(robot: RobotDescription) -> Arm:
    return Arm("left", robot, MotionConfig(), [TABLE])


@pytest.mark.requirement("B-13")
def test_the_arms_hang_and_open_as_those_of_openarm_v1(robot):
    first = RobotDescription.load("openarm_v1")
    for side in robot.arm_names:
        own, other = (r.link_pose(r.tcp_link(side), dict.fromkeys(r.joints, 0.0)) for r in (robot, first))
        np.testing.assert_allclose(own[:3, :3], other[:3, :3], atol=1e-9)
        np.testing.assert_allclose(own[:3, 3], other[:3, 3], atol=0.02)
        closed = dict.fromkeys(robot.joints, 0.0)
        opened = {**closed, **robot.group_state(f"{side}_gripper", "open")}
        T = np.linalg.inv(own)
        tips = [
            {state: T @ robot.link_pose(finger, q) @ _pad(robot, finger) for state, q in (("0", closed), ("1", opened))}
            for finger in robot.arm(side).fingers
        ]
        gaps = [abs(tips[0][state][1, 3] - tips[1][state][1, 3]) for state in ("0", "1")]
        assert gaps[0] == pytest.approx(0.0085, abs=1e-4)  # thickness of a pad: their middles, faces touching
        assert gaps[1] == pytest.approx(0.0917, abs=0.003)
        assert max(abs(tip["1"][0, 3]) for tip in tips) < 1e-3


@pytest.mark.long
@pytest.mark.requirement("B-13")
def test_a_pose_over_a_table_is_planned_from_home(arm):
    robot = RobotDescription.load("openarm_v2")
    home = {**robot.group_state("both_arms", "home"), **{robot.finger_joint(side): 0.0 for side in robot.arms}}
    start = np.array([home[name] for name in arm.names])
    assert not arm.scene(home).collides(start)
    target = se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.25, 0.2, 0.55))
    trajectory = to_pose(arm, StartState(home, start), target, RequestBoxes())
    np.testing.assert_allclose(arm.kinematics.fk(trajectory.q[-1]), target, atol=1e-3)


def _pad(robot: RobotDescription, finger: str) -> np.ndarray:
    return next(s.T_link_primitive for s in robot.links[finger].collision if s.name == f"{finger}_pad_collision")


@pytest.mark.requirement("R-05", "B-07")
def test_links_that_the_design_holds_apart_are_asked_for_no_more(arm):
    """link5 and the base of the hand are 2.3 mm apart where the wrist bends most; 3 mm are asked of all others."""
    scene = arm.scene({**dict.fromkeys(arm.description.joints, 0.0)})
    asked = {d for i, j, d in scene.required() if {i, j} <= set(arm.robot.moving)}
    less = sorted(asked - {arm.config.clearance.own})
    assert arm.config.clearance.own in asked
    assert [round(d, 4) for d in less] == [0.0021, 0.0022]
    rng, nearer = np.random.default_rng(5), 0
    close = Arm(arm.name, arm.description, arm.config, [TABLE], apart={}).scene(scene.around.state)
    for q in rng.uniform(arm.lower, arm.upper, (300, 7)):
        if not scene.collides(q) and close.collides(q):
            nearer += 1
            assert all(0.002 < contact.distance < 0.003 for contact in close.contacts(q))
    assert nearer > 10
