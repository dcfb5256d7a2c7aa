# SPDX-License-Identifier: Apache-2.0
"""Plans to regions of configurations, on paths that stay in another region. Base frame, m, rad.

A path that is constrained is tried as a straight joint line, then as a straight line of the tool (whose orientation
turns from one end to the other, so a tolerance of orientation that holds at both mostly holds between them), then
searched for by rejection. Whatever is found is timed, and validated densely for collisions and constraint alike.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.collision.exact import CollisionScene
from openarm_motion.constraints.asked import RegionGoal
from openarm_motion.constraints.goals import in_region
from openarm_motion.constraints.lines import ConstrainedLines
from openarm_motion.constraints.regions import TaskRegion
from openarm_motion.kinematics.line import solve_line
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.planning.moves import RequestBoxes, free_scene, some_of_all
from openarm_motion.timing.trajectory import Trajectory

#: Goals of one search, and those that lines are tried to.
_GOALS, _LINES = 24, 6
#: A straight joint line is looked at in steps of this before it is timed, rad.
_STEP = 0.05


def to_region(arm: Arm, now: StartState, goal: RegionGoal, around: RequestBoxes) -> Trajectory:
    """Path to a configuration in one of the regions; free, or constrained.

    Raises:
        PlanFailedError: UNREACHABLE; IN_COLLISION, naming the pair; VIOLATION, when start or goal violates what the
            path has to satisfy; NO_PLAN.
        OpenArmError: INVALID_ARGUMENT; LIMITS; CANCELLED.
    """
    end = _end(arm, goal)
    scene = free_scene(arm, now, around)
    wanted = _configurations(arm, now, goal.regions, end)
    free = [q for q in wanted if not scene.collides(q)]
    if not free:
        contact = scene.contacts(wanted[0])[0]
        more = f" (all {len(wanted)} configurations collide)" if len(wanted) > 1 else ""
        raise PlanFailedError(Code.IN_COLLISION, f"goal of the {arm.name} arm: {contact}{more}", "goal", contact)
    if not goal.path:
        goals = np.array(free[:_GOALS])
        return arm.plan_validated(scene, now, goals, max(end - time.monotonic(), 0.05)).trajectory
    return _constrained(arm, now, scene, free, goal.path, end)


def reaching(arm: Arm, now: StartState, start: Array, goal: RegionGoal) -> Array:
    """Configurations (k, n) of one of two arms in one of the regions, those that are reached first come first.

    Raises:
        OpenArmError: INVALID_ARGUMENT; LIMITS; UNREACHABLE.
    """
    return some_of_all(_configurations(arm, replace(now, start=start), goal.regions, _end(arm, goal)))


def _end(arm: Arm, goal: RegionGoal) -> float:
    return time.monotonic() + (goal.time_limit or arm.config.planning.time_limit)


def _configurations(arm: Arm, now: StartState, regions: Sequence[TaskRegion], end: float) -> list[Array]:
    found: list[Array] = []
    fault: OpenArmError | None = None
    for region in regions:
        try:
            found += in_region(arm, region, now.start, now.scale, end)
        except OpenArmError as error:
            fault = fault or error.settled()
    if found:
        return found
    raise fault or PlanFailedError(Code.INVALID_ARGUMENT, "the goal constrains nothing", "request")


def _constrained(
    arm: Arm, now: StartState, scene: CollisionScene, free: Sequence[Array], path: TaskRegion, end: float
) -> Trajectory:
    lines = ConstrainedLines(arm, scene, path)
    if text := lines.fault(now.start):
        raise PlanFailedError(Code.VIOLATION, f"the start violates the path constraints: {text}", "start")
    goals = [q for q in free if not lines.fault(q)][:_GOALS]
    if not goals:
        text = f"the goal violates the path constraints: {lines.fault(free[0])}"
        raise PlanFailedError(Code.VIOLATION, text, "goal")
    for trajectory in _lines(arm, now, lines, goals):
        if now.stopped():
            raise OpenArmError(Code.CANCELLED, "planning was stopped")
        try:
            lines.validate(trajectory)
            return trajectory
        except PlanFailedError:
            continue
    left = max(end - time.monotonic(), 0.05)
    plan = arm.plan_validated(lines, now, np.array(goals), left, lambda _, trajectory: lines.validate(trajectory))
    return plan.trajectory


def _lines(arm: Arm, now: StartState, lines: ConstrainedLines, goals: Sequence[Array]) -> Iterator[Trajectory]:
    """Straight joint lines, then straight lines of the tool, that satisfy the constraint."""
    for q in goals[:_LINES]:
        steps = max(2, int(np.ceil(float(np.abs(q - now.start).max()) / _STEP)))
        if not lines.violations(now.start + np.linspace(0.0, 1.0, steps + 1)[:, None] * (q - now.start)).any():
            yield arm.straight(now, q)
    here = arm.inverse.classify(now.start)
    margin = max(0.0, min(arm.config.planning.joint_margin, arm.kinematics.margin(now.start)))
    for q in goals[:_LINES]:
        try:
            line = solve_line(arm.inverse, here, arm.kinematics.fk(now.start), arm.kinematics.fk(q), margin)
        except OpenArmError:
            continue
        if not lines.violations(line.q).any():
            yield arm.time_line(line, now.scale)
