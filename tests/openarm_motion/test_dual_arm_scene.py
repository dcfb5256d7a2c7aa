# SPDX-License-Identifier: Apache-2.0
"""Both arms planned as one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from openarm_motion.collision.solids import Box, box_from
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.dual_arm import DualArm, DualArmScene
from openarm_motion.planning.ompl_planner import OmplPlanner


@pytest.fixture(scope="module")
def both(arms: dict[str, Arm]) -> DualArm:
    return DualArm(arms["left"], arms["right"])


def over_the_middle(both: DualArm, home: dict[str, float], y: float) -> list[np.ndarray]:
    """For each arm a configuration with the hand at (0.30, y, 0.62), free with the other arm at home."""
    from openarm_common import se3

    found = []
    for arm in both.arms:
        pose = se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.30, y, 0.62))
        scene = arm.scene(home)
        found.append(next(s.q for s in arm.inverse.solutions(pose, 0.05) if not scene.collides(s.q)))
    return found


def joined(both: DualArm, home: dict[str, float]) -> np.ndarray:
    return np.array([home[name] for name in both.names])


@pytest.mark.requirement("A-74")
def test_one_arm_fine_but_two_collide(both: DualArm, home: dict[str, float]) -> None:
    left, right = over_the_middle(both, home, 0.0)
    scene = both.scene(home)
    start = joined(both, home)
    assert scene.contacts(start) == []
    assert not scene.collides(np.concatenate([left, start[7:]]))
    assert not scene.collides(np.concatenate([start[:7], right]))
    together = np.concatenate([left, right])
    assert scene.collides(together)
    contact = scene.contacts(together)[0]
    assert {contact.first.split("_")[1], contact.second.split("_")[1]} == {"left", "right"}
    assert contact.required == pytest.approx(0.025)


@pytest.mark.requirement("A-74")
def test_arms_that_swap_sides_of_a_box_keep_apart_all_the_way(both: DualArm, home: dict[str, float]) -> None:
    left_in, right_in = over_the_middle(both, home, 0.0)
    start = joined(both, home)
    # one arm leaves the middle while the other enters it: the straight line meets half-way
    a, b = np.concatenate([left_in, start[7:]]), np.concatenate([start[:7], right_in])
    scene: DualArmScene = both.scene(home)
    path = OmplPlanner().plan(both.query(scene, StartState({}, a, 0.5), b[None], 10.0))
    finer = both.scene(home, separation=0.020)
    for p, q in itertools.pairwise(path.waypoints):
        assert finer.edge_free(p, q, 0.01, 0.005)


def test_an_obstacle_of_the_second_arm_is_seen(both: DualArm, home: dict[str, float]) -> None:
    start = joined(both, home)
    hand = both.arms[1].kinematics.fk(start[7:])[:3, 3]
    box: Box = box_from("post", hand, (0.05, 0.05, 0.05))
    scene = both.scene(home, [box])
    assert scene.collides(start)
    assert "post" in {c.second for c in scene.contacts(start)}
