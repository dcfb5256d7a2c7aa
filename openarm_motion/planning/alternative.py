# SPDX-License-Identifier: Apache-2.0
"""The nearest goal that works, in place of one that an arm can't be planned to. Base frame, m, rad."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.turns import nearest_turns
from openarm_common.types import Array
from openarm_motion.collision.exact import CollisionScene
from openarm_motion.planning import moves
from openarm_motion.planning.approach import ApproachFailedError, ApproachPlan, ApproachRequest
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.failure import Alternative, PlanFailedError
from openarm_motion.planning.moves import RequestBoxes
from openarm_motion.timing.trajectory import Trajectory

#: Distances from the pose that was asked for that are tried, m.
_RINGS = (0.02, 0.04, 0.07, 0.11, 0.16, 0.22)
#: Time for the search of one candidate, s.
_SEARCH = 0.3
#: Time for what is near to the target of an approach, s.
_APPROACH = 0.5
#: Configurations of a pose that are checked.
_CONFIGURATIONS = 16
#: Steps back from a configuration towards the start.
_STEPS = 20


def explained(plan: Callable[[], Trajectory], instead: Callable[[], Alternative | None]) -> Trajectory:
    """A plan; when it fails for where it was to go, the error says what would work instead.

    Raises:
        OpenArmError: that of `plan`.
    """
    try:
        return plan()
    except PlanFailedError as error:
        blocked = error.stage in ("goal", "search", "certificate")
        if not blocked or error.code not in (Code.UNREACHABLE, Code.IN_COLLISION, Code.NO_PLAN):
            raise
        found = instead()
        raise PlanFailedError(error.code, error.message, error.stage, error.contact, found) from error


def explained_approach(
    plan: Callable[[], ApproachPlan], arm: Arm, now: StartState, request: ApproachRequest
) -> ApproachPlan:
    """The same for an approach: what is near to the target that got furthest.

    Raises:
        OpenArmError: that of `plan`.
    """
    try:
        return plan()
    except ApproachFailedError as error:
        target = next(target for target in request.targets if target.id == error.furthest.id)
        around = RequestBoxes(request.obstacles, request.attached)
        error.alternative = near_pose(arm, now, around, target.pose, budget=_APPROACH)
        raise


def near_pose(
    arm: Arm, now: StartState, around: RequestBoxes, pose: Array, *, position_only: bool = False, budget: float = 1.0
) -> Alternative | None:
    """The nearest tool pose that the arm can be planned to; None when none is found within `budget` s.

    The orientation is kept, or free where it may be.
    """
    end = time.monotonic() + budget
    scene, asked = moves.free_scene(arm, now, around), pose[:3, 3].copy()
    nearest = arm.inverse.nearest(pose, now.start, position_only=position_only)
    if not nearest.success:
        pose = arm.kinematics.fk(nearest.q)
    for target in _poses_around(pose):
        if time.monotonic() > end or now.stopped():
            return None
        solve = arm.inverse.position_solutions if position_only else arm.inverse.solutions
        found = solve(target, arm.config.planning.joint_margin, now.start)
        # of a whole turn of the elbow, some of every part
        goals = [s.q for s in found[:: max(1, len(found) // _CONFIGURATIONS)] if not scene.collides(s.q)]
        q = _planned(arm, scene, now, np.array(goals[:8])) if goals else None
        if q is not None:
            there = arm.kinematics.fk(q)
            return Alternative(q, there, float(np.linalg.norm(there[:3, 3] - asked)))
    return None


def near_joints(
    arm: Arm, now: StartState, around: RequestBoxes, goal: Array, budget: float = 1.0
) -> Alternative | None:
    """The configuration nearest to `goal`, on the way back to the start, that the arm can be planned to."""
    end = time.monotonic() + budget
    scene, goal = moves.free_scene(arm, now, around), nearest_turns(goal, now.start, arm.upper)
    wanted = arm.kinematics.fk(goal)
    for u in np.linspace(1.0, 0.0, _STEPS, endpoint=False):
        if time.monotonic() > end or now.stopped():
            return None
        q = now.start + u * (goal - now.start)
        if not scene.collides(q) and _planned(arm, scene, now, q[None]) is not None:
            there = arm.kinematics.fk(q)
            return Alternative(q, there, float(np.linalg.norm(there[:3, 3] - wanted[:3, 3])))
    return None


def _planned(arm: Arm, scene: CollisionScene, now: StartState, goals: Array) -> Array | None:
    """The goal that a plan reaches in a short time, or None."""
    try:
        return np.asarray(arm.plan_validated(scene, now, goals, _SEARCH).trajectory.q[-1])
    except OpenArmError:
        return None


def _poses_around(pose: Array) -> Iterator[Array]:
    """The pose itself and others about it, the nearest first: up, back along the tool, aside, forwards, down."""
    yield pose
    ways = np.array([[0, 0, 1], -pose[:3, 2], [0, 1, 0], [0, -1, 0], [-1, 0, 0], [1, 0, 0], [0, 0, -1]])
    for ring, way in itertools.product(_RINGS, ways):
        other = pose.copy()
        other[:3, 3] += ring * way
        yield other
