# SPDX-License-Identifier: Apache-2.0
"""Motions of both arms at once that keep them apart all the way. Base frame, m, rad, s.

Together: one path of all joints, timed as one. Staggered: each arm has a path of its own, and one of them starts later,
by as little as keeps them apart; only pairs of moments are looked at for that, nothing is planned anew.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.collision.collision import Box
from openarm_motion.planning.arm import Situation
from openarm_motion.planning.beside import Course, least_wait
from openarm_motion.planning.both import SEPARATION, BothArms, BothScene
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.planning.fast_planner import FastPlanner
from openarm_motion.timing.blending import timings
from openarm_motion.timing.certificate import certify, dense_times
from openarm_motion.timing.checks import Motion
from openarm_motion.timing.trajectory import Trajectory

#: Pairs of goals that one search gets.
_GOALS = 24
#: No point of the arms moves further between two looks, m, and as much less than planned they may be apart there.
_TRAVEL = 0.004
_SEEN = SEPARATION - 0.25 * _TRAVEL
#: Looks from one coarse look to the next.
_STRIDE = 8
#: Steps of the searches, how many times finer.
_FINENESS = (1.0, 4.0)


@dataclass(frozen=True, eq=False)
class BothGoals:
    """What both arms are asked.

    Attributes:
        goals: Of each arm, configurations (k, n); any will do, an earlier one is preferred.
        obstacles: Boxes, base frame.
        held: Boxes that each arm holds, tool frame.
    """

    goals: tuple[Array, Array]
    obstacles: Sequence[Box] = ()
    held: tuple[Sequence[Box], Sequence[Box]] = ((), ())


@dataclass(frozen=True, eq=False)
class BothPlan:
    """Trajectories that begin at the same moment, how long each rests in it first, and the arms' least distance, m."""

    trajectories: tuple[Trajectory, Trajectory]
    delays: tuple[float, float]
    separation: float


def plan_together(both: BothArms, now: Situation, wanted: BothGoals, time_limit: float) -> BothPlan:
    """One path of all joints.

    Args:
        both: The arms.
        now: The robot's joints; `start` is that of both arms (n1 + n2,).
        wanted: Where to.
        time_limit: s.

    Raises:
        OpenArmError: IN_COLLISION, when the arms start or would end too near to something, naming the pair; NO_PLAN;
            CANCELLED.
    """
    end = time.monotonic() + time_limit
    scene = both.scene(now.state, wanted.obstacles, held=wanted.held, known=now.known)
    for arm, part, start in zip(both.arms, scene.placed(now.start), both.parts(now.start), strict=True):
        arm.relax(part, start)
    goals = _pairs(scene, wanted.goals)
    limits, search = both.limits(now.scale), both.arms[0].config.planning
    least, fault, contact = _least(scene, now.start), "", None
    for fineness in _FINENESS:
        left = max(end - time.monotonic(), 0.1)
        path = FastPlanner().plan(both.query(scene, now.start, goals, now.scale, left, now.stopped, fineness))
        for whole in timings(search.timing, both.names, path.waypoints, limits, search.period):
            try:
                certify(scene, whole, _TRAVEL)
            except PlanFailedError as error:
                fault, contact = error.message, error.contact
                continue
            gap = separation(scene, whole)
            if gap >= least:
                q, v, a = (both.parts(x) for x in (whole.q, whole.v, whole.a))
                first, second = (Trajectory(arm.names, whole.t, q[i], v[i], a[i]) for i, arm in enumerate(both.arms))
                return BothPlan((first, second), (0.0, 0.0), gap)
            fault, contact = f"the arms would come within {gap * 1e3:.1f} mm of each other", None
    text = f"the plan of both arms did not pass the dense look: {fault}"
    raise PlanFailedError(Code.IN_COLLISION, text, "certificate", contact)


def plan_staggered(both: BothArms, now: Situation, wanted: BothGoals, time_limit: float) -> BothPlan:
    """A path of each arm alone; the later one waits as briefly as keeps them apart.

    Of both orders the one that ends earlier is taken. The first arm is planned with the other where it is, the second
    with the first at its goal: the second may always follow once the first has arrived.

    Raises:
        OpenArmError: as `plan_together`.
    """
    found: list[_Staggered] = []
    faults: list[OpenArmError] = []
    for first in range(2):
        try:
            found.append(_in_order(both, now, wanted, first, 0.5 * time_limit))
        except OpenArmError as error:
            if error.code not in (Code.NO_PLAN, Code.IN_COLLISION):
                raise
            faults.append(error)
    if not found:
        text = "; ".join(f"{arm.name} first: {e.message}" for arm, e in zip(both.arms, faults, strict=True))
        raise OpenArmError(faults[0].code, f"neither arm can go first: {text}")
    best = min(found, key=lambda plan: max(part.duration for part in plan.parts))
    scene = both.scene(now.state, held=wanted.held)
    return BothPlan(best.parts, best.waits, separation(scene, joined(both, best.parts)))


def plan_any(both: BothArms, now: Situation, wanted: BothGoals, time_limit: float) -> BothPlan:
    """Together where that is found in half of the time, else staggered.

    Raises:
        OpenArmError: as `plan_together`.
    """
    try:
        return plan_together(both, now, wanted, 0.5 * time_limit)
    except OpenArmError as error:
        if error.code not in (Code.NO_PLAN, Code.IN_COLLISION):
            raise
        try:
            return plan_staggered(both, now, wanted, 0.5 * time_limit)
        except OpenArmError as second:
            if second.code == Code.CANCELLED:
                raise
            raise error from second  # the first one knows more: it looked at both arms


def separation(scene: BothScene, whole: Trajectory) -> float:
    """Least distance of the arms on a timed motion of all joints, at looks no more than 4 mm of way apart, m."""
    states = whole.at(dense_times(whole, scene.levers, _TRAVEL))[0]
    gaps = {i: scene.separation(states[i]) for i in {*range(0, len(states), _STRIDE), len(states) - 1}}
    least = min(gaps.values())
    looked = sorted(gaps)
    for i, j in itertools.pairwise(looked):
        # the distance changes no faster than points move
        if 0.5 * (gaps[i] + gaps[j] - (j - i) * _TRAVEL) < least:
            least = min(least, *(scene.separation(states[k]) for k in range(i, j + 1)))
    return least


def delayed(trajectory: Trajectory, wait: float) -> Trajectory:
    """The same after a rest of `wait` seconds."""
    if wait <= 0.0:
        return trajectory
    rest = np.zeros_like(trajectory.v[:1])
    return replace(
        trajectory,
        t=np.concatenate([[0.0], trajectory.t + wait]),
        q=np.concatenate([trajectory.q[:1], trajectory.q]),
        v=np.concatenate([rest, trajectory.v]),
        a=np.concatenate([rest, trajectory.a]),
    )


@dataclass(frozen=True, eq=False)
class _Staggered:
    parts: tuple[Trajectory, Trajectory]
    waits: tuple[float, float]


def _in_order(both: BothArms, now: Situation, wanted: BothGoals, first: int, time_limit: float) -> _Staggered:
    second = 1 - first
    early = _alone(both, first, now, now.state, wanted, time_limit)
    there = {**now.state, **dict(zip(both.arms[first].names, early.q[-1].tolist(), strict=True))}
    late = _alone(both, second, now, there, wanted, time_limit)
    one, other = (Course(both.arms[i], Motion.of(part), wanted.held[i]) for i, part in ((first, early), (second, late)))
    wait = least_wait(other, [one], now.state, stopped=now.stopped)
    if first == 0:
        return _Staggered((early, delayed(late, wait)), (0.0, wait))
    return _Staggered((delayed(late, wait), early), (wait, 0.0))


def joined(both: BothArms, parts: tuple[Trajectory, Trajectory]) -> Trajectory:
    """Both trajectories as one of all joints."""
    times = np.union1d(parts[0].t, parts[1].t)
    (q0, v0, a0), (q1, v1, a1) = (part.at(times) for part in parts)
    return Trajectory(both.names, times, np.hstack([q0, q1]), np.hstack([v0, v1]), np.hstack([a0, a1]))


def _alone(
    both: BothArms, index: int, now: Situation, state: Mapping[str, float], wanted: BothGoals, time_limit: float
) -> Trajectory:
    """The path of one arm with the other one where `state` says."""
    arm, start = both.arms[index], both.parts(now.start)[index]
    scene = both.scene_of(index, state, wanted.obstacles, held=wanted.held, known=now.known)
    arm.relax(scene, start)
    goals = [q for q in wanted.goals[index] if not scene.collides(q)][:_GOALS]
    if not goals:
        contact = scene.contacts(wanted.goals[index][0])[0]
        raise PlanFailedError(Code.IN_COLLISION, f"goal of the {arm.name} arm: {contact}", "goal", contact)
    mine = Situation(state, start, now.scale, now.stopped, now.known)
    return arm.plan_certified(scene, mine, np.array(goals), time_limit).trajectory


def _pairs(scene: BothScene, goals: tuple[Array, Array]) -> Array:
    """Goals of both arms that go together, the preferred ones first; (k, n1 + n2)."""
    order = sorted(np.ndindex(len(goals[0]), len(goals[1])), key=sum)
    found: list[Array] = []
    for i, j in order:
        q = np.concatenate([goals[0][i], goals[1][j]])
        if not scene.collides(q):
            found.append(q)
            if len(found) == _GOALS:
                break
    if not found:
        contact = scene.contacts(np.concatenate([goals[0][0], goals[1][0]]))[0]
        text = f"goals of both arms: {contact} (all {len(order)} pairs of goals collide)"
        raise PlanFailedError(Code.IN_COLLISION, text, "goal", contact)
    return np.array(found)


def _least(scene: BothScene, start: Array) -> float:
    """Distance that the arms keep: less only where they start nearer to each other already."""
    return min(_SEEN, scene.separation(start) - 0.25 * _TRAVEL)
