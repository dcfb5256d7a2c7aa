# SPDX-License-Identifier: Apache-2.0
"""Validation of a timed trajectory: checked densely on the exact layer, with clearance for a robot that lags behind.

A plan keeps the clearance of its scene where the search checked. The validation checks again, as the controller will
interpolate, so closely that no point of the arm moves further than `travel` between two checks, and asks for a share of
the clearance there. Half a step away from a sample no point has moved further than half of `travel`. m, rad, s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from openarm_common.errors import Code
from openarm_common.types import Array
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.timing.trajectory import Trajectory

if TYPE_CHECKING:
    from openarm_motion.collision.exact import LineChecks

#: Share of the clearance that must be left between the checks of the search.
_SHARE = 0.5
#: The same to the other arm: 27 mm of 30, so that there is room for it when that one sets out.
_ARMS = 0.9
#: No point of the arm moves further between two checks, m.
_TRAVEL = 0.004


def validate_trajectory(scene: LineChecks, trajectory: Trajectory, travel: float = _TRAVEL) -> None:
    """Check a trajectory densely.

    Args:
        scene: What it was planned in; its clearances are reduced meanwhile, not for good.
        trajectory: As it goes to the controller.
        travel: Greatest travel of a point between two checks, m.

    Raises:
        PlanFailedError: IN_COLLISION, with the time and the pair.
    """
    times = dense_times(trajectory, scene.levers, travel)
    states = trajectory.at(times)[0]
    with scene.lenient(_SHARE, _ARMS):
        for k in ends_first(len(states)):
            if scene.collides(states[k]):
                contact = scene.contacts(states[k])[0]
                text = f"after {times[k]:.2f} s of the trajectory {contact}"
                raise PlanFailedError(Code.IN_COLLISION, text, "certificate", contact)


def dense_times(trajectory: Trajectory, levers: Array, travel: float = _TRAVEL) -> Array:
    """Moments between which no point moves further than `travel`, by the way that each joint turns."""
    way = np.abs(np.diff(trajectory.q, axis=0)) @ levers
    return subdivided(trajectory.t, way, travel)


def subdivided(times: Array, way: Array, travel: float) -> Array:
    """Times (m,), and as many between them as make each of the ways (m - 1,) from one to the next `travel` or less."""
    parts = [
        np.linspace(times[i], times[i + 1], max(1, int(np.ceil(w / travel))), endpoint=False) for i, w in enumerate(way)
    ]
    return np.concatenate([*parts, times[-1:]])


def ends_first(n: int) -> list[int]:
    """All indices, each tenth first: a collision is found early."""
    return [*range(0, n, 10), *(k for k in range(n) if k % 10)]
