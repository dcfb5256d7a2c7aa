# SPDX-License-Identifier: Apache-2.0
"""A robot against itself, next to the exact checks of the planner."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.collision.self_collision import SelfCollision
from openarm_common.robot.description import RobotDescription
from openarm_motion.collision.exact import Clearance, CollisionContext, CollisionScene
from openarm_motion.collision.robot import CollisionRobot
from openarm_motion.kinematics.chain import ArmKinematics

TOUCHING = Clearance(own=0.0, world=0.0, arms=0.0, hand=0.0, touch=0.0, rest=0.0)
#: A ball that hangs over a box, on a rod of variable length.
PENDULUM = """<robot name="r">
<link name="base"><collision><geometry><box size="0.2 0.2 0.2"/></geometry></collision></link>
<link name="arm"/>
<link name="tip"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
<joint name="a" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.4"/>
<axis xyz="0 1 0"/>
<limit lower="-4" upper="4" velocity="1" effort="1"/></joint>
<joint name="b" type="prismatic"><parent link="arm"/><child link="tip"/><axis xyz="0 0 1"/>
<limit lower="-0.4" upper="0.4" velocity="1" effort="1"/></joint></robot>"""
pytestmark = pytest.mark.requirement("R-08")


@pytest.mark.parametrize(("name", "states"), [("openarm_v1", 60), ("openarm_v2", 60), ("panda", 120)])
def test_postures_that_the_exact_layer_calls_free_are_free_and_those_that_touch_are_found(
    name: str, states: int
) -> None:
    robot = RobotDescription.load(name)
    names = [joint for arm in robot.arms.values() for joint in arm.controlled]
    checks = SelfCollision(robot, names)
    arms = {arm: CollisionRobot(robot, ArmKinematics(robot, parts.tcp)) for arm, parts in robot.arms.items()}
    low, high = robot.limits(names)
    found = {True: 0, False: 0}
    for q in np.random.default_rng(5).uniform(low, high, (states, len(names))):
        state = dict(zip(names, q.tolist(), strict=True))
        hit = False
        for seen in arms.values():
            scene = CollisionScene(seen, CollisionContext(state, clearance=TOUCHING))
            hit = hit or scene.collides([state[joint] for joint in seen.kinematics.names])
        nearest = checks.nearest(checks.distances(q))
        found[hit] += 1
        if abs(nearest.distance) > 1e-3:  # the proof of the fast checks is within a share of the distance
            assert (nearest.distance < 0.0) == hit, f"{nearest} of {q.tolist()}"
    assert min(found.values()) > 2


def test_the_nearest_links_are_named_with_the_distance_between_them() -> None:
    robot = RobotDescription.from_urdf(PENDULUM)
    checks = SelfCollision(robot, ["a", "b"])
    nearest = checks.nearest(checks.distances(np.array([np.pi, 0.24])))
    assert {nearest.first, nearest.second} == {"base", "tip"}
    assert nearest.distance == pytest.approx(0.4 - 0.24 - 0.1 - 0.05, abs=1e-6)
    assert checks.nearest(checks.distances(np.array([np.pi, 0.30]))).distance < 0.0
    assert checks.nearest(checks.distances(np.array([0.0, 0.24]))).distance == pytest.approx(0.02)
