# SPDX-License-Identifier: Apache-2.0
"""Compile every numba kernel of this package, so that the first plan of a process does not wait for that."""

from __future__ import annotations

import numpy as np

from openarm_common.octree.lattice import KEY_ZERO, Lattice
from openarm_common.robot.description import RobotDescription
from openarm_motion.collision.exact import CollisionContext, CollisionScene
from openarm_motion.collision.fast import FastScene
from openarm_motion.collision.occupancy import OccupancyMap
from openarm_motion.collision.robot import CollisionRobot
from openarm_motion.kinematics.chain import ArmKinematics
from openarm_motion.kinematics.inverse import InverseKinematics
from openarm_motion.kinematics.line import solve_line
from openarm_motion.planning.arm import segment_time
from openarm_motion.planning.rrt import warm_search
from openarm_motion.timing.trajectory import JointLimits, time_polyline


def warm_kinematics() -> None:
    """Run the kernels of postures and speeds once with the types that the package uses."""
    description = RobotDescription.load()
    name, parts = next(iter(description.arms.items()))
    kinematics = ArmKinematics(description, parts.tcp)
    inverse = InverseKinematics(kinematics)
    home = description.group_state(f"{name}_arm", "home")  # clear of singularities: a straight line leads away
    q = np.array([home[joint] for joint in parts.joints])
    pose = kinematics.fk_many(np.stack([q, q]))[0]
    inverse.nearest(pose, q)
    inverse.position_solutions(pose, near=q)
    inverse.solutions(pose, near=q)
    away = pose.copy()
    away[2, 3] += 9.0
    inverse.solutions(away)  # what is out of reach has kernels of its own
    away[2, 3] = pose[2, 3] + 0.01
    solve_line(inverse, inverse.classify(q), pose, away, margin=0.0)
    limits = JointLimits(*np.ones((3, q.size)))
    segment_time(q, q + 0.01, limits)
    time_polyline(kinematics.names, np.stack([q, q + 0.01, q]), limits)


def warm_collision() -> None:
    """Run the kernels of collisions and of the search among them once."""
    description = RobotDescription.load()
    name, parts = next(iter(description.arms.items()))
    home = description.group_state(f"{name}_arm", "home")
    q = np.array([home[joint] for joint in parts.joints])
    scene = CollisionScene(CollisionRobot(description, ArmKinematics(description, parts.tcp)), CollisionContext(home))
    warm_search(FastScene([scene]), q)
    OccupancyMap(np.zeros((1, 3), np.int64), Lattice(0.02, (KEY_ZERO, KEY_ZERO, KEY_ZERO), (4, 4, 4)), 1).distances  # noqa: B018
