# SPDX-License-Identifier: Apache-2.0
"""Configurations of an arm in a region: the middle of it first, then what is drawn from its tolerances. m, rad."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from openarm_common.errors import Code
from openarm_common.robot.turns import nearest_turns
from openarm_common.types import Array
from openarm_motion.constraints.regions import PositionRegion, TaskRegion
from openarm_motion.planning.arm import Arm, Scale, segment_time
from openarm_motion.planning.failure import PlanFailedError

#: Poses that are drawn from a region whose middle has no configuration.
_DRAWS = 48
#: Where a position is free: distance from the present one that is tried, m.
_ANYWHERE = 0.35


def in_region(arm: Arm, region: TaskRegion, start: Array, scale: Scale = 0.0, end: float = math.inf) -> list[Array]:
    """Configurations (n,) in a region, those that are reached first come first.

    Args:
        arm: The arm.
        region: Region of the goal.
        start: (n,) joints that are not constrained stay as here.
        scale: Scale of velocity, see `StartState`.
        end: After it, s of the monotonic clock, nothing else is drawn.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a joint of another arm; LIMITS; UNREACHABLE, with the reason.
    """
    region.check(arm.names)
    if not region.positions and not region.orientations:
        return [_joints(arm, region, start)]
    limits, margin = arm.limits(scale), arm.config.planning.joint_margin
    first: Array | None = None
    for pose, free in itertools.islice(_poses(arm, region, start), 1 if region.one_pose else None):
        first = pose if first is None else first
        solve = arm.inverse.position_solutions if free else arm.inverse.solutions
        found = np.array([s.q for s in solve(pose, margin, start) or solve(pose, 0.0, start)]).reshape(-1, len(start))
        if len(found):
            found = found[~region.violations(arm.names, found, arm.kinematics.fk_many(found))]
        if len(found):
            return sorted(found, key=lambda q: segment_time(start, q, limits))
        if time.monotonic() > end:
            break
    why = "no pose of the region was found" if first is None else arm.inverse.why_not(first, margin, start)
    if first is not None and not why:
        why = "no configuration at the pose satisfies the other constraints"
    raise PlanFailedError(Code.UNREACHABLE, f"{arm.name} arm can't reach the goal: {why}", "goal")


def _joints(arm: Arm, region: TaskRegion, start: Array) -> Array:
    """The middle of the intervals, moved into the limits as far as the tolerances allow."""
    q = start.copy()
    for interval in region.joints:
        i = arm.names.index(interval.joint)
        low, high = interval.position - interval.below, interval.position + interval.above
        q[i] = min(max(interval.position, min(arm.lower[i], high)), max(arm.upper[i], low))
    return nearest_turns(arm.configuration(q, "goal", 1e-3), start, arm.upper)


def _poses(arm: Arm, region: TaskRegion, start: Array) -> Iterator[tuple[Array, bool]]:
    """Poses (4, 4) of the tool to try, and whether their orientation is free."""
    rng = np.random.default_rng(arm.config.planning.seed)
    here = arm.kinematics.fk(start)
    for k in range(_DRAWS + 1):
        turned = region.orientations[0] if region.orientations else None
        placed: Sequence[PositionRegion] = region.positions
        if turned is not None:
            R = turned.sample(rng) if k else turned.middle()
        else:
            R = here[:3, :3] if not k else Rotation.from_quat(rng.normal(size=4)).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = R
        if placed:
            volume = placed[0].volumes[k % len(placed[0].volumes)]
            drawn = k >= len(placed[0].volumes) and (turned is not None or rng.uniform() < 0.5)
            point = volume.sample(rng) if drawn else volume.T[:3, 3]
            pose[:3, 3] = point - R @ placed[0].p_tool
        else:
            pose[:3, 3] = here[:3, 3] + (rng.uniform(-_ANYWHERE, _ANYWHERE, 3) if k else 0.0)
        at_origin = bool(placed) and float(np.abs(placed[0].p_tool).max()) < 1e-9
        yield pose, turned is None and at_origin
