# SPDX-License-Identifier: Apache-2.0
"""Plans of single motions of one arm: to joints, to a pose, along a line, to a named posture. Base frame, m, rad."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.collision.exact import CollisionScene
from openarm_motion.collision.solids import Box
from openarm_motion.kinematics.line import line_contact, solve_line
from openarm_motion.planning.arm import Arm, Scale, StartState, first_contact, segment_time
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.timing.trajectory import Trajectory
from openarm_motion.timing.validation import validate_trajectory

#: A joint goal no further than this beyond its limit is moved to the limit, rad.
_ROUNDING = 1e-3
#: Goals of one search.
_GOALS = 24
#: How far the elbow may swivel along a line when it can't keep its angle, rad; the smallest that works is taken.
LINE_DRIFTS = (0.0, 0.15, -0.15, 0.3, -0.3, 0.5, -0.5, 0.8, -0.8)
#: A hand that leaves an object moves along the cells of its map, whose steps come nearer than the start by this, m;
#: the end of the line keeps what is asked, so that no series of lines comes nearer and nearer.
_PASSING = 0.003


@dataclass(frozen=True, eq=False)
class RequestBoxes:
    """Boxes of one request: obstacles (base frame) and what the arm holds (tool frame)."""

    obstacles: Sequence[Box] = ()
    attached: Sequence[Box] = ()


def to_joints(
    arm: Arm, now: StartState, goal: Sequence[float] | Array, around: RequestBoxes, what: str = "goal"
) -> Trajectory:
    """Free path to a configuration.

    Raises:
        OpenArmError: INVALID_ARGUMENT or LIMITS, naming the joint; IN_COLLISION, naming the pair; NO_PLAN; CANCELLED.
    """
    q = arm.configuration(goal, what, _ROUNDING)
    scene = free_scene(arm, now, around)
    contact = first_contact(scene, q)
    if contact is not None:
        raise PlanFailedError(Code.IN_COLLISION, f"{what} of the {arm.name} arm: {contact}", "goal", contact)
    return _plan(arm, scene, now, q[None])


def to_named(arm: Arm, now: StartState, posture: str, around: RequestBoxes) -> Trajectory:
    """Free path to a posture of the SRDF.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the postures there are; as `to_joints`.
    """
    return to_joints(arm, now, named_posture(arm, posture, now.start), around, f"posture {posture!r}")


def to_pose(arm: Arm, now: StartState, pose: Array, around: RequestBoxes, *, position_only: bool = False) -> Trajectory:
    """Free path to the tool pose (4, 4), in the nearest configuration; the joint margin is kept where that can be.

    Raises:
        OpenArmError: UNREACHABLE, with the nearest reachable pose; IN_COLLISION, naming the pair; NO_PLAN; CANCELLED.
    """
    scene = free_scene(arm, now, around)
    ordered = _configurations(arm, now.scale, now.start, pose, position_only=position_only)
    goals = [q for q in ordered if not scene.collides(q)][:_GOALS]
    if not goals:
        contact = scene.contacts(ordered[0])[0]
        text = f"pose of the {arm.name} arm: {contact} (all {len(ordered)} configurations collide)"
        raise PlanFailedError(Code.IN_COLLISION, text, "goal", contact)
    return _plan(arm, scene, now, np.array(goals))


def to_pose_on_line(arm: Arm, now: StartState, pose: Array, around: RequestBoxes) -> Trajectory:
    """Straight line of the tool to a pose (4, 4), without a change of branch, validated when it is timed.

    Raises:
        OpenArmError: UNREACHABLE, saying where the line ends and why; IN_COLLISION, naming the pair.
    """
    start = arm.inverse.classify(now.start)
    T_start = arm.kinematics.fk(now.start)
    # a start nearer to a limit than the margin may go on as near
    margin = max(0.0, min(arm.config.planning.joint_margin, arm.kinematics.margin(now.start)))
    scene = arm.scene(now.state, around.obstacles, around.attached, straight=True, environment=now.environment)
    arm.relax(scene, now.start)
    faults: list[PlanFailedError] = []
    for drift in LINE_DRIFTS if not np.isnan(start.swivel) else (0.0,):
        try:
            line = solve_line(arm.inverse, start, T_start, pose, margin, swivel_change=drift)
        except OpenArmError as error:
            faults.append(PlanFailedError(error.code, error.message, "line"))
            continue
        contact = next(iter(scene.contacts(line.q[-1])), None)
        with scene.passing(now.start, _PASSING):
            contact = contact or line_contact(scene, line)
            if contact is not None:
                faults.append(PlanFailedError(Code.IN_COLLISION, f"on the straight line {contact}", "line", contact))
                continue
            trajectory = arm.time_line(line, now.scale)
            try:
                validate_trajectory(scene, trajectory)
            except PlanFailedError as error:
                faults.append(error.settled())
                continue
        return trajectory
    worst = next((fault for fault in faults if fault.code == Code.IN_COLLISION), faults[0])
    raise PlanFailedError(worst.code, f"{arm.name} arm: {worst.message}", "line", worst.contact)


def unreachable(
    arm: Arm, pose: Array, *, position_only: bool, margin: float | None = None, near: Array | None = None
) -> OpenArmError:
    """The error for a pose that the arm can't reach: the reason, and the nearest pose to it, searched from `near`."""
    x, y, z = pose[:3, 3]
    kept = arm.config.planning.joint_margin if margin is None else margin
    why = arm.inverse.why_not(pose, kept, near, position_only=position_only)
    hint = "" if position_only else "; or leave the orientation free"
    text = f"{arm.name} arm can't reach ({x:.3f}, {y:.3f}, {z:.3f}) m: {why}{hint}"
    return PlanFailedError(Code.UNREACHABLE, text, "goal")


def free_scene(arm: Arm, now: StartState, around: RequestBoxes) -> CollisionScene:
    """What free paths of a request are planned in, the start freed of what it is in contact with.

    Raises:
        PlanFailedError: IN_COLLISION, when the arm starts in collision.
    """
    scene = arm.scene(now.state, around.obstacles, around.attached, environment=now.environment)
    arm.relax(scene, now.start)
    return scene


def _plan(arm: Arm, scene: CollisionScene, now: StartState, goals: Array) -> Trajectory:
    return arm.plan_validated(scene, now, goals, arm.config.planning.time_limit).trajectory


#: Configurations of one arm that a search of both gets.
_MOST = 24


def named_posture(arm: Arm, name: str, start: Array) -> Array:
    """A posture of the SRDF (n,); joints that it does not name stay.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the postures there are; LIMITS.
    """
    state = arm.description.group_state(arm.config.group.format(arm=arm.name), name)
    present: dict[str, float] = dict(zip(arm.names, start.tolist(), strict=True))
    return arm.configuration([state.get(joint, present[joint]) for joint in arm.names], f"posture {name!r}", 1e-3)


def yielding(arm: Arm, start: Array, name: str) -> Array:
    """Stay, or else the posture of that name; (2, n)."""
    return np.stack([start, named_posture(arm, name, start)])


def goal_configurations(arm: Arm, now: StartState, start: Array, pose: Array, *, position_only: bool = False) -> Array:
    """Configurations with the tool at a pose, the nearest first; (k, n).

    Raises:
        PlanFailedError: UNREACHABLE, with the reason.
    """
    return some_of_all(_configurations(arm, now.scale, start, pose, position_only=position_only))


def some_of_all(ordered: Sequence[Array]) -> Array:
    """Of a whole turn of the elbow some of every part, (k, n): the nearest alone may all meet the other arm."""
    return np.array(ordered[:: max(1, len(ordered) // _MOST)][:_MOST])


def _configurations(arm: Arm, scale: Scale, start: Array, pose: Array, *, position_only: bool) -> list[Array]:
    """All configurations with the tool at a pose, those that are reached first come first; UNREACHABLE without one.

    Where none keeps the margin from the joint limits, those within the limits are taken.
    """
    solve = arm.inverse.position_solutions if position_only else arm.inverse.solutions
    solutions = solve(pose, arm.config.planning.joint_margin, start) or solve(pose, 0.0, start)
    if not solutions:
        raise unreachable(arm, pose, position_only=position_only, near=start)
    limits = arm.limits(scale)
    return sorted((s.q for s in solutions), key=lambda q: segment_time(start, q, limits))
