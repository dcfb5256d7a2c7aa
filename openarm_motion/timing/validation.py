# SPDX-License-Identifier: Apache-2.0
"""Validation of a timed trajectory: proven densely on the exact layer, with clearance for a robot that lags behind.

A plan keeps the clearance of its scene where the search checked. The validation looks again, as the controller will
interpolate, at states so close that no point of the arm moves further than `travel` between two of them, and asks for a
share of the clearance there. Half a step away from a state no point has moved further than half of `travel`. Many
states at once are proven by one check that asks for more distance. m, rad, s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from openarm_common.errors import Code
from openarm_common.types import Array
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.timing.trajectory import Trajectory

if TYPE_CHECKING:
    from openarm_motion.collision.line_checks import LineChecks

#: Share of the clearance that must be left between the checks of the search.
_SHARE = 0.5
#: The same to the other arm: 27 mm of 30, so that there is room for it when that one sets out.
_ARMS = 0.9
#: No point of the arm moves further between two checks, m.
_TRAVEL = 0.004
#: States that are proven to be free at once, each number a part of the one before.
_BLOCKS = (24, 6)


def validate_trajectory(scene: LineChecks, trajectory: Trajectory, travel: float = _TRAVEL) -> None:
    """Check a trajectory densely.

    Args:
        scene: Planning scene that it was planned in; its clearances are reduced meanwhile, not for good.
        trajectory: Trajectory that goes to the controller.
        travel: Greatest travel of a point between two checks, m.

    Raises:
        PlanFailedError: IN_COLLISION, with the time and the pair.
    """
    times = dense_times(trajectory, scene.levers, travel)
    states = trajectory.at(times)[0]
    with scene.lenient(_SHARE, _ARMS):
        k = first_fault(scene, states)
        if k is not None:
            contact = scene.contacts(states[k])[0]
            text = f"after {times[k]:.2f} s of the trajectory {contact}"
            raise PlanFailedError(Code.IN_COLLISION, text, "certificate", contact, at=float(times[k]))


def keeps_clear(scene: LineChecks, trajectory: Trajectory, travel: float = _TRAVEL) -> bool:
    """Whether a trajectory, checked as densely, keeps the full clearance of its scene."""
    states = trajectory.at(dense_times(trajectory, scene.levers, travel))[0]
    return first_fault(scene, states) is None


def first_fault(scene: LineChecks, states: Array) -> int | None:
    """Some state (m, n) of a motion that collides, or None; fewer are checked than there are.

    In the middle of a block of states pairs are asked to keep as much more than their distance as they may come nearer
    to each other until either end of the block: then they keep it in each state of the block (conservative
    advancement: Mirtich, "Impulse-based dynamic simulation of rigid body systems", 1996). What is not proven so is
    checked in smaller blocks, at last state by state.
    """
    gone = np.cumsum(np.abs(np.diff(states, axis=0, prepend=states[:1])), axis=0)
    swings = scene.swings()
    left = np.arange(len(states))
    for size in _BLOCKS:
        blocks = [left[i : i + size] for i in range(0, len(left), size)]
        first, middle, last = np.array([(block[0], block[len(block) // 2], block[-1]) for block in blocks]).T
        turns = np.maximum(gone[middle] - gone[first], gone[last] - gone[middle])
        with scene.further((turns @ swings.T).max(axis=0)):
            near = [block for block, k in zip(blocks, middle, strict=True) if scene.collides(states[k])]
        if not near:
            return None
        left = np.concatenate(near)
    return next((int(left[k]) for k in ends_first(len(left)) if scene.collides(states[left[k]])), None)


def dense_times(trajectory: Trajectory, levers: Array, travel: float = _TRAVEL) -> Array:
    """Moments between which no point moves further than `travel`, by the way that each joint turns."""
    way = np.abs(np.diff(trajectory.q, axis=0)) @ levers
    return subdivided(trajectory.t, way, travel)


def subdivided(times: Array, way: Array, travel: float) -> Array:
    """Times (m,), and as many between them as make each of the ways (m - 1,) from one to the next `travel` or less."""
    counts = np.maximum(np.ceil(way / travel), 1.0).astype(np.int64)
    passed = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    inner = np.repeat(times[:-1], counts) + passed * np.repeat(np.diff(times) / counts, counts)
    return np.append(inner, times[-1])


def ends_first(n: int) -> list[int]:
    """All indices, each tenth first: a collision is found early."""
    return [*range(0, n, 10), *(k for k in range(n) if k % 10)]
