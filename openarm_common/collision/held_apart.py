# SPDX-License-Identifier: Apache-2.0
"""What the geometry of a robot holds apart: links that no posture brings together. m, rad."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from openarm_common.collision.self_collision import SelfCollision
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.urdf import Joint
from openarm_common.types import Array, Ints

#: Links that more joints move against each other can be brought together by most arms.
_JOINTS = 2
#: Between two postures that are looked at, rad; of a prismatic joint, m.
_STEP, _STEP_M = 0.1, 0.01
#: Nearest postures from which a nearer one is searched for, and the last step of that, rad or m.
_STARTS, _FINEST = 4, 1e-4


def held_apart(description: RobotDescription, within: float) -> dict[frozenset[str], float]:
    """Return the least distances, over the range of joints, of links that stay apart but come nearer than `within`.

    Nobody can ask for more distance of such a pair than its design gives it. Pairs that touch somewhere are left out.

    Args:
        description: The robot.
        within: m; distances above `SelfCollision` measures up to are not found.

    Returns:
        Distance by the names of the two links, m.
    """
    movable = [joint for joint in description.joints.values() if joint.type != "fixed" and joint.mimic is None]
    robot, column = SelfCollision(description, [j.name for j in movable]), {j.name: k for k, j in enumerate(movable)}
    out = dict[frozenset[str], float]()
    for links, pairs in robot.pairs_of_links().items():
        between = _between(description, *links)
        if not 0 < len(between) <= _JOINTS or any(joint.mimic for joint in between):
            continue
        columns = [column[joint.name] for joint in between]

        def distance(q: Array, columns: list[int] = columns, pairs: Ints = pairs) -> float:
            full = np.zeros(len(movable))
            full[columns] = q
            return float(robot.distances_of(full, pairs).min())

        least = _least(distance, between, within)
        if least is not None:
            out[frozenset(links)] = least
    return out


def _between(description: RobotDescription, first: str, second: str) -> list[Joint]:
    """Return the joints that move two links against each other."""
    one, other = description.chain(first), description.chain(second)
    return [j for j in (*one, *other) if j.type != "fixed" and not (j in one and j in other)]


def _least(distance: Callable[[Array], float], joints: Sequence[Joint], within: float) -> float | None:
    """Return the least distance over the range of the joints, m; None where it is 0 somewhere or not below `within`."""
    low = np.array([max(joint.lower, -math.pi) for joint in joints])
    high = np.array([min(joint.upper, math.pi) for joint in joints])
    steps = np.array([_STEP_M if joint.type == "prismatic" else _STEP for joint in joints])
    counts = [max(2, math.ceil(share) + 1) for share in ((high - low) / steps).tolist()]
    axes = [np.linspace(a, b, count) for a, b, count in zip(low, high, counts, strict=True)]
    postures = np.array(list(itertools.product(*axes)))
    found = np.empty(len(postures))
    # in any order: what touches somewhere is soon seen to
    for k in np.random.default_rng(0).permutation(len(postures)).tolist():
        found[k] = distance(postures[k])
        if found[k] <= 0.0:
            return None
    nearest = math.inf
    for k in np.argsort(found)[:_STARTS].tolist():
        nearest = min(nearest, _descended(distance, postures[k], float(found[k]), low, high, steps))
    return nearest if 0.0 < nearest < within else None


def _descended(
    distance: Callable[[Array], float], q: Array, value: float, low: Array, high: Array, step: Array
) -> float:
    """Return the least distance that steps along one joint at a time lead to from a posture, m."""
    while float(step.max()) > _FINEST:
        tries = [np.clip(q + sign * step * axis, low, high) for axis in np.eye(len(q)) for sign in (-1.0, 1.0)]
        values = [distance(one) for one in tries]
        best = int(np.argmin(values))
        if values[best] < value:
            q, value = tries[best], values[best]
        else:
            step = 0.5 * step
    return value
