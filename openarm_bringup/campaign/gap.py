# SPDX-License-Identifier: Apache-2.0
"""How near both arms came to each other, by the shapes of the simulation and its true joints; for the judge alone.

Looks are as far apart in time as the arms, at the greatest speed that they approach each other with, need to come
nearer than the least distance so far; so no smaller one is missed. m, s.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_bringup.campaign.robot import SimRobot

#: Two arms that work at once are never nearer than this, m.
LEAST_GAP = 0.020
#: Two points of the arms approach each other no faster, m/s: joints run at half of their speed.
_APPROACH = 4.0


class ArmGap:
    """Watches a robot, from each control tick to the next.

    Args:
        robot: Whose tick it takes part in.
    """

    def __init__(self, robot: SimRobot) -> None:
        self._robot = robot
        model = robot.world.model
        self._sides = tuple(_arm_geoms(model, side) for side in ("left", "right"))
        self._next_ns = 0
        #: Least distance so far, m.
        self.least = float(np.inf)
        tick: Callable[[], None] = robot.tick

        def watched() -> None:
            tick()
            self._look()

        robot.tick = watched  # type: ignore[method-assign]

    def _look(self) -> None:
        robot = self._robot
        if robot.t_ns < self._next_ns:
            return
        gap = self.distance()
        self.least = min(self.least, gap)
        self._next_ns = robot.t_ns + round(1e9 * max(0.0, gap - self.least) / _APPROACH)

    def distance(self) -> float:
        """Distance of the arms now, m."""
        model, data = self._robot.world.model, self._robot.world.data
        first, second = self._sides
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
