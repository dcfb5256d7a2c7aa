# SPDX-License-Identifier: Apache-2.0
"""The tool along straight lines through several poses, as far as that goes. Base frame, m, rad."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.constraints.asked import CartesianGoal
from openarm_motion.constraints.lines import ConstrainedLines
from openarm_motion.kinematics.line import line_poses, line_way
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.planning.moves import LINE_DRIFTS, RequestBoxes
from openarm_motion.timing.trajectory import Trajectory, resting, time_path
from openarm_motion.timing.validation import validate_trajectory

#: Greatest change of a joint between two points of a line, rad; the same between two branches is a jump.
_MAX_STEP = 0.2
#: A longer way is a mistake, m.
_LONGEST = 50.0
#: Fewest points of a line that can be timed, and the nearest that points are in time, s.
_FEWEST = 7
_SHORTEST = 0.002


@dataclass(frozen=True, eq=False)
class CartesianPath(Trajectory):
    """A trajectory along a part of a path; `ended` says why it is not all of it."""

    fraction: float = 1.0
    ended: str = ""


def along(arm: Arm, now: StartState, goal: CartesianGoal, around: RequestBoxes) -> CartesianPath:
    """Follow straight lines as far as limits, collisions and constraints allow; at rest in each way point.

    Raises:
        PlanFailedError: IN_COLLISION, when the arm starts in collision.
        OpenArmError: INVALID_ARGUMENT, for way points far apart, or a constraint of a joint of another arm.
    """
    scene = arm.scene(now.state, around.obstacles, around.attached, straight=True, environment=now.environment)
    lines = ConstrainedLines(arm, scene, goal.path)
    if goal.avoid_collisions:
        arm.relax(scene, now.start)
    q, parts, done, ended = now.start, list[Trajectory](), 0.0, ""
    poses = [arm.kinematics.fk(now.start), *goal.waypoints]
    total = sum(line_way(a, b) for a, b in pairwise(poses))
    if not total < _LONGEST:
        text = f"the way through {len(goal.waypoints)} way points is {total:g} m long, expected less than {_LONGEST:g}"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    for pose in goal.waypoints:
        part, way, share, ended = _segment(arm, now, lines, q, pose, goal)
        done += way
        if part is not None:
            parts.append(part)
            q = part.q[-1]
        if share < 1.0:
            break
    joined = _joined(arm, now.start, parts)
    fraction = 1.0 if not ended else min(done / total, 1.0) if total > 0.0 else 0.0
    return CartesianPath(joined.names, joined.t, joined.q, joined.v, joined.a, fraction=fraction, ended=ended)


def _segment(
    arm: Arm, now: StartState, lines: ConstrainedLines, start: Array, pose: Array, goal: CartesianGoal
) -> tuple[Trajectory | None, float, float, str]:
    """The longest part of one line: its trajectory, way, share of the line, and why it ends there."""
    poses, s = line_poses(arm.kinematics.fk(start), pose)
    if s[-1] < 1e-9:
        return None, 0.0, 1.0, ""
    here = arm.inverse.classify(start)
    margin = max(0.0, min(arm.config.planning.joint_margin, arm.kinematics.margin(start)))
    scene = lines.arms[0]
    jump = goal.revolute_jump or _MAX_STEP
    best: tuple[int, Array, str] = (0, start[None], "")
    for drift in LINE_DRIFTS if not np.isnan(here.swivel) else (0.0,):
        q, reached, why = arm.inverse.follow(poses, here, margin, jump, drift)
        q = q[:reached]
        steps = np.linalg.norm(np.diff(q, axis=0), axis=1)
        if goal.jump_factor and (jumps := np.flatnonzero(steps > goal.jump_factor * steps.mean())).size:
            reached, why = int(jumps[0]) + 1, f"the joints jump by more than {goal.jump_factor:g} average steps"
        if goal.path and reached and (outside := np.flatnonzero(lines.violations(q[:reached]))).size:
            reached = int(outside[0])
            why = lines.fault(q[reached])
        if goal.avoid_collisions:
            hit = next((k for k in range(reached) if scene.collides(q[k])), None)
            if hit is not None:
                reached, why = hit, str(scene.contacts(q[hit])[0])
        if reached > best[0]:
            best = reached, q[:reached], why
        if reached == len(poses):
            break
        best = best if best[2] else (best[0], best[1], why)
    reached, q, why = best
    speed = arm.config.limits.straight_speed * arm.scale(now.scale)
    period = arm.config.planning.period
    if goal.max_step > 0.0:
        period = float(np.clip(goal.max_step / speed, _SHORTEST, period))
    while reached >= _FEWEST:
        part = time_path(arm.names, q[:reached], s[:reached], arm.limits(now.scale), speed, period)
        try:
            if goal.avoid_collisions:
                validate_trajectory(scene, part)
        except PlanFailedError as error:
            reached, why = reached - max(1, reached // 10), error.message
            continue
        whole = reached == len(poses)
        return part, float(s[reached - 1]), 1.0 if whole else float(s[reached - 1] / s[-1]), "" if whole else why
    return None, 0.0, 0.0, why or "the line is too short to be followed in part"


def _joined(arm: Arm, start: Array, parts: Sequence[Trajectory]) -> Trajectory:
    """Trajectories one after the other; rest where there is none."""
    if not parts:
        return resting(arm.names, start, arm.config.planning.period)
    t, q, v, a = [parts[0].t], [parts[0].q], [parts[0].v], [parts[0].a]
    for part in parts[1:]:
        t.append(t[-1][-1] + part.t[1:])
        for rows, values in ((q, part.q), (v, part.v), (a, part.a)):
            rows.append(values[1:])
    return Trajectory(arm.names, *(np.concatenate(rows) for rows in (t, q, v, a)))
