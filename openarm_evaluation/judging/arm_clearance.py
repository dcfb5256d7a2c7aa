# SPDX-License-Identifier: Apache-2.0
"""Least distance of both arms, by the shapes of the simulation and its true joints; for the judge alone.

Measurements are as far apart in time as the arms, at their greatest approach speed, need to come nearer than the least
distance so far; so no smaller one is missed. m, s.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from itertools import combinations
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import load_cameras
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import load_scene
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage
from openarm_sim_bridge.world.world import start_qpos

if TYPE_CHECKING:
    from openarm_evaluation.campaign.robot import SimRobot

#: Two arms that move simultaneously are never nearer than this, m.
LEAST_CLEARANCE = 0.020
#: Two points of the arms approach each other no faster, m/s: joints run at half of their speed.
_APPROACH = 4.0


class ArmClearance:
    """The least distance of the arms of a simulated robot so far.

    Args:
        description: The robot.
        model: The simulation.
    """

    def __init__(self, description: RobotDescription, model: mujoco.MjModel) -> None:
        self._model = model
        self.arms = tuple(_arm_geoms(model, description.links_of(arm)) for arm in description.arm_names)
        self._next_ns = 0
        #: m.
        self.least = float(np.inf)

    def due(self, t_ns: int) -> bool:
        """Return whether the arms may have come nearer by now than ever before."""
        return t_ns >= self._next_ns

    def measure(self, t_ns: int, data: mujoco.MjData) -> None:
        """Measure."""
        distance = self.distance(data)
        self.least = min(self.least, distance)
        self._next_ns = t_ns + round(1e9 * max(0.0, distance - self.least) / _APPROACH)

    def distance(self, data: mujoco.MjData) -> float:
        """Least distance of two arms in a state whose kinematics are done, m; infinite with one arm."""
        pairs = combinations(self.arms, 2)
        return min((self._distance(data, *pair) for pair in pairs), default=float(np.inf))

    def _distance(self, data: mujoco.MjData, first: NDArray[np.intp], second: NDArray[np.intp]) -> float:
        model = self._model
        centres, radii = data.geom_xpos, model.geom_rbound
        bound = np.linalg.norm(centres[first][:, None] - centres[second][None], axis=-1)
        bound = bound - radii[first][:, None] - radii[second][None]
        best = float(np.inf)
        for flat in np.argsort(bound, axis=None):
            i, j = np.unravel_index(flat, bound.shape)
            if bound[i, j] >= best:
                break
            found = mujoco.mj_geomDistance(model, data, int(first[i]), int(second[j]), 2.0, None)
            best = min(best, max(found, float(bound[i, j])))  # in some postures MuJoCo says 0 of shapes far apart
        return best


def watch_clearance(robot: SimRobot) -> ArmClearance:
    """Measure on a robot in this process, from each control tick to the next."""
    clearance = ArmClearance(robot.description, robot.world.model)
    tick: Callable[[], None] = robot.tick

    def watched() -> None:
        tick()
        if clearance.due(robot.t_ns):
            clearance.measure(robot.t_ns, robot.world.data)

    robot.tick = watched  # type: ignore[method-assign]
    return clearance


def least_clearance(states: Iterable[tuple[int, Mapping[str, float]]]) -> float:
    """Least distance of the arms in the joint states of a simulation, m.

    Args:
        states: Stamp in ns, and position by joint; oldest first, as often as a control tick.
    """
    description = RobotDescription.load().described
    world = Stage(description, load_cameras(), None, PhysicsConfig()).world(load_scene("empty"))
    clearance = ArmClearance(description, world.model)
    for t_ns, joints in states:
        if clearance.due(t_ns):
            world.data.qpos[:] = start_qpos(world.model, joints)
            mujoco.mj_kinematics(world.model, world.data)
            clearance.measure(t_ns, world.data)
    return clearance.least


def _arm_geoms(model: mujoco.MjModel, links: Collection[str]) -> NDArray[np.intp]:
    """Colliding geoms of an arm and its hand; the fixed base is not a part of it."""
    found = [
        geom
        for geom in range(model.ngeom)
        if model.geom_contype[geom] or model.geom_conaffinity[geom]
        if model.body(model.geom_bodyid[geom]).name in links
        if model.body_weldid[model.geom_bodyid[geom]] != 0
    ]
    return np.array(found, dtype=np.intp)
