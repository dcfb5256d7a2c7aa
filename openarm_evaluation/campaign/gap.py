# SPDX-License-Identifier: Apache-2.0
"""How near both arms came to each other, by the shapes of the simulation and its true joints; for the judge alone.

Looks are as far apart in time as the arms, at the greatest speed that they approach each other with, need to come
nearer than the least distance so far; so no smaller one is missed. m, s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import load_cameras
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import load_scene
from openarm_evaluation.campaign.robot import SimRobot
from openarm_sim_bridge.world.compiled import start_qpos
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage

#: Two arms that work at once are never nearer than this, m.
LEAST_GAP = 0.020
#: Two points of the arms approach each other no faster, m/s: joints run at half of their speed.
_APPROACH = 4.0


class Gap:
    """The least distance of the arms of a simulated robot so far.

    Args:
        model: The simulation.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self.sides = tuple(_arm_geoms(model, side) for side in ("left", "right"))
        self._next_ns = 0
        #: m.
        self.least = float(np.inf)

    def due(self, t_ns: int) -> bool:
        """Whether the arms may have come nearer by now than they ever were."""
        return t_ns >= self._next_ns

    def look(self, t_ns: int, data: mujoco.MjData) -> None:
        """Measure."""
        gap = self.distance(data)
        self.least = min(self.least, gap)
        self._next_ns = t_ns + round(1e9 * max(0.0, gap - self.least) / _APPROACH)

    def distance(self, data: mujoco.MjData) -> float:
        """Distance of the arms in a state whose kinematics are done, m."""
        model = self._model
        first, second = self.sides
        centres, radii = data.geom_xpos, model.geom_rbound
        bound = np.linalg.norm(centres[first][:, None] - centres[second][None], axis=-1)
        bound = bound - radii[first][:, None] - radii[second][None]
        best = float(np.inf)
        for flat in np.argsort(bound, axis=None):
            i, j = np.unravel_index(flat, bound.shape)
            if bound[i, j] >= best:
                break
            best = min(best, mujoco.mj_geomDistance(model, data, int(first[i]), int(second[j]), 2.0, None))
        return best


def watch_gap(robot: SimRobot) -> Gap:
    """Watch a robot in this process, from each control tick to the next."""
    gap = Gap(robot.world.model)
    tick: Callable[[], None] = robot.tick

    def watched() -> None:
        tick()
        if gap.due(robot.t_ns):
            gap.look(robot.t_ns, robot.world.data)

    robot.tick = watched  # type: ignore[method-assign]
    return gap


def least_gap(states: Iterable[tuple[int, Mapping[str, float]]]) -> float:
    """Least distance of the arms in the joint states of a simulation, m.

    Args:
        states: Stamp in ns, and position by joint; oldest first, as often as a control tick.
    """
    world = Stage(RobotDescription.load(), load_cameras(), None, PhysicsConfig()).world(load_scene("empty"))
    gap = Gap(world.model)
    for t_ns, joints in states:
        if gap.due(t_ns):
            world.data.qpos[:] = start_qpos(world.model, joints)
            mujoco.mj_kinematics(world.model, world.data)
            gap.look(t_ns, world.data)
    return gap.least


def _arm_geoms(model: mujoco.MjModel, side: str) -> NDArray[np.intp]:
    """Colliding geoms of an arm and its hand; the fixed base is not a part of it."""
    found = [
        geom
        for geom in range(model.ngeom)
        if model.geom_contype[geom] or model.geom_conaffinity[geom]
        if model.body(model.geom_bodyid[geom]).name.startswith(f"openarm_{side}_")
        if model.body_weldid[model.geom_bodyid[geom]] != 0
    ]
    return np.array(found, dtype=np.intp)
