# SPDX-License-Identifier: Apache-2.0
"""Configurations that a target of one of two arms stands for. Base frame, m, rad."""

from __future__ import annotations

import numpy as np

from openarm_common.types import Array
from openarm_motion.planning import moves
from openarm_motion.planning.arm import Arm, Situation, segment_time

#: Configurations of one arm that a search of both gets.
_MOST = 24


def posture(arm: Arm, name: str, start: Array) -> Array:
    """A posture of the SRDF (n,); joints that it does not name stay.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the postures there are; LIMITS.
    """
    state = arm.description.group_state(arm.config.group.format(arm=arm.name), name)
    present: dict[str, float] = dict(zip(arm.names, start.tolist(), strict=True))
    return arm.configuration([state.get(joint, present[joint]) for joint in arm.names], f"posture {name!r}", 1e-3)


def yielding(arm: Arm, start: Array, name: str) -> Array:
    """Stay, or else the posture of that name; (2, n)."""
    return np.stack([start, posture(arm, name, start)])


def goal_configurations(
    arm: Arm, now: Situation, start: Array, pose: Array, *, free_orientation: bool = False
) -> Array:
    """Configurations with the tool at a pose, the nearest first; (k, n).

    Raises:
        PlanFailedError: UNREACHABLE, with the reason.
    """
    solve = arm.inverse.position_solutions if free_orientation else arm.inverse.solutions
    solutions = solve(pose, arm.config.planning.joint_margin, start)
    if not solutions:
        raise moves.unreachable(arm, pose, free_orientation=free_orientation)
    limits = arm.limits(now.scale)
    # of a whole turn of the elbow, some of every part: the nearest alone may all meet the other arm
    ordered = sorted((s.q for s in solutions), key=lambda q: segment_time(start, q, limits))
    return np.array(ordered[:: max(1, len(ordered) // _MOST)][:_MOST])
