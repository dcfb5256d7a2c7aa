# SPDX-License-Identifier: Apache-2.0
"""Motions of both arms at once that keep them apart all the way. Base frame, m, rad, s.

Together: one path of all joints, timed as one. Staggered: each arm has a path of its own, and one of them starts later,
by as little as keeps them apart; only pairs of moments are checked for that, nothing is planned again.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.collision.exact import Clearance, CollisionScene, Contact
from openarm_motion.collision.line_checks import LineChecks
from openarm_motion.collision.occupancy import NOTHING, Environment
from openarm_motion.collision.solids import Box
from openarm_motion.planning.arm import Arm, PlanningGroup, Scale, StartState
from openarm_motion.planning.coordination import ActiveMotion, least_delay
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.planning.planner import PlannedPath
from openarm_motion.planning.rrt import FastPlanner
from openarm_motion.timing.trajectory import JointLimits, Trajectory
from openarm_motion.timing.validation import dense_times, validate_trajectory

#: Two arms that move at once plan to stay this far apart, m: 20 mm remain when each lags behind its plan a little.
SEPARATION = 0.025


class DualArmScene(LineChecks):
    """Exact checks of two arms in one set of surroundings; not for two threads at once.

    Args:
        first: Scene of the first arm, which also checks the other arm's links.
        second: Scene of the second arm.
        split: Joints of the first arm.
    """

    def __init__(self, first: CollisionScene, second: CollisionScene, split: int) -> None:
        self.first, self.second = first, second
        self._split = split
        self.levers = np.concatenate([first.levers, second.levers])

    @property
    def arms(self) -> Sequence[CollisionScene]:
        """Both scenes."""
        return self.first, self.second

    def collides(self, q: ArrayLike) -> bool:
        """Whether some pair is nearer than it may be at a configuration (n1 + n2,)."""
        a, b = self._put(q)
        return self.first.collides(a) or self.second.collides(b)

    def contacts(self, q: ArrayLike) -> list[Contact]:
        """All pairs that are nearer than they may be, the deepest first; a pair of both arms once."""
        a, b = self._put(q)
        found = self.first.contacts(a)
        seen = {frozenset((c.first, c.second)) for c in found}
        found += [c for c in self.second.contacts(b) if frozenset((c.first, c.second)) not in seen]
        return sorted(found, key=lambda contact: contact.distance - contact.required)

    @contextmanager
    def lenient(self, share: float, arms: float | None = None) -> Iterator[None]:
        """Ask for only a share of each positive distance meanwhile, `arms` of that between the arms."""
        with self.first.lenient(share, arms), self.second.lenient(share, arms):
            yield

    def swings(self) -> Array:
        """See `LineChecks`."""
        robots = [scene.robot for scene in self.arms]
        return np.vstack([scene.swings_of(robots) for scene in self.arms])

    @contextmanager
    def further(self, by: Array) -> Iterator[None]:
        """See `LineChecks`."""
        first = self.first.pairs
        with self.first.further(by[:first]), self.second.further(by[first:]):
            yield

    def separation(self, q: ArrayLike) -> float:
        """Distance of the arms from each other at a configuration (n1 + n2,), what they hold included, m."""
        a, _ = self._put(q)
        # what the second arm holds goes with it as the first one sees it
        return self.first.gap(a, self.second.robot.arm.moving | self.first.carried)

    def placed(self, q: ArrayLike) -> tuple[CollisionScene, CollisionScene]:
        """Both scenes with the other arm where a configuration (n1 + n2,) has it."""
        self._put(q)
        return self.first, self.second

    def _put(self, q: ArrayLike) -> tuple[Array, Array]:
        values = np.asarray(q, dtype=np.float64)
        a, b = values[: self._split], values[self._split :]
        self.first.put_other(self.second.robot, b)
        self.second.put_other(self.first.robot, a)
        return a, b


class DualArm(PlanningGroup):
    """Two arms of one robot that are planned together.

    Args:
        first: One arm; its joints come first in every configuration.
        second: The other.
    """

    def __init__(self, first: Arm, second: Arm) -> None:
        self.arms, self.title, self.config = (first, second), "both arms", first.config
        self.names: tuple[str, ...] = (*first.names, *second.names)
        self.split = first.kinematics.n
        self.lower, self.upper = (
            np.concatenate(ends) for ends in ((first.lower, second.lower), (first.upper, second.upper))
        )

    def parts(self, values: Array) -> tuple[Array, Array]:
        """What belongs to each arm, of values (..., n1 + n2)."""
        return values[..., : self.split], values[..., self.split :]

    def scene(
        self,
        state: Mapping[str, float],
        boxes: Sequence[Box] = (),
        separation: float = SEPARATION,
        held: tuple[Sequence[Box], Sequence[Box]] = ((), ()),
        environment: Environment = NOTHING,
        clearance: Clearance | None = None,
    ) -> DualArmScene:
        """Surroundings of both arms with the table in them.

        Args:
            state: The robot's joints.
            boxes: Obstacles, base frame.
            separation: Distance that the arms keep from each other, m.
            held: Boxes held by each arm, its tool frame.
            environment: Bodies of the planning scene and the map.
            clearance: Other distances, instead of that of free paths.
        """
        carried = [arm.robot.on_tool(mine) for arm, mine in zip(self.arms, held, strict=True)]
        first, second = (
            arm.scene(
                state,
                boxes,
                held[i],
                environment=environment,
                carried=carried[1 - i],
                arms=separation,
                clearance=clearance,
            )
            for i, arm in enumerate(self.arms)
        )
        return DualArmScene(first, second, self.split)

    def limits(self, scale: Scale) -> JointLimits:
        """Limits of all joints at a velocity scale."""
        first, second = (arm.limits(scale) for arm in self.arms)
        return JointLimits(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))

    def plan(
        self, scene: LineChecks, now: StartState, goals: Array, time_limit: float, fineness: float = 1.0
    ) -> PlannedPath:
        """See `PlanningGroup`; the planner is that of the suite, whatever the configuration says."""
        return FastPlanner().plan(self.query(scene, now, goals, time_limit, fineness))


#: Pairs of goals that one search gets.
_GOALS = 24
#: No point of the arms moves further between two checks, m, and as much less than planned they may be apart there.
_TRAVEL = 0.004
_SEEN = SEPARATION - 0.25 * _TRAVEL
#: Checks from one coarse check to the next.
_STRIDE = 8


@dataclass(frozen=True, eq=False)
class DualArmGoals:
    """What both arms are asked.

    Attributes:
        goals: Goals of each arm, configurations (k, n); any will do, an earlier one is preferred.
        obstacles: Boxes, base frame.
        held: Boxes that each arm holds, tool frame.
    """

    goals: tuple[Array, Array]
    obstacles: Sequence[Box] = ()
    held: tuple[Sequence[Box], Sequence[Box]] = ((), ())


@dataclass(frozen=True, eq=False)
class DualArmPlan:
    """Trajectories that begin at the same moment, how long each rests in it first, and the arms' least distance, m."""

    trajectories: tuple[Trajectory, Trajectory]
    start_delays: tuple[float, float]
    clearance: float

    @property
    def whole(self) -> Trajectory:
        """Both trajectories as one of all joints."""
        times = np.union1d(*(part.t for part in self.trajectories))
        names = tuple(name for part in self.trajectories for name in part.names)
        columns = zip(*(part.at(times) for part in self.trajectories), strict=True)
        return Trajectory(names, times, *(np.hstack(both) for both in columns))


def plan_together(both: DualArm, now: StartState, wanted: DualArmGoals, time_limit: float) -> DualArmPlan:
    """One path of all joints.

    Args:
        both: The arms.
        now: The robot's joints; `start` is that of both arms (n1 + n2,).
        wanted: Goal of both arms.
        time_limit: s.

    Raises:
        OpenArmError: IN_COLLISION, when the arms start or would end too near to something, naming the pair; NO_PLAN;
            CANCELLED.
    """
    end = time.monotonic() + time_limit
    scene = both.scene(now.state, wanted.obstacles, held=wanted.held, environment=now.environment)
    for arm, part, start in zip(both.arms, scene.placed(now.start), both.parts(now.start), strict=True):
        arm.relax(part, start)
    goals, least = _pairs(scene, wanted.goals), _least(scene, now.start)
    gap = np.nan

    def validate(scene: DualArmScene, whole: Trajectory) -> None:
        nonlocal gap
        validate_trajectory(scene, whole, _TRAVEL)
        gap = separation(scene, whole)
        if gap < least:
            text = f"the arms would come within {gap * 1e3:.1f} mm of each other"
            raise PlanFailedError(Code.IN_COLLISION, text, "certificate")

    whole = both.plan_validated(scene, now, goals, end - time.monotonic(), validate).trajectory
    q, v, a = (both.parts(x) for x in (whole.q, whole.v, whole.a))
    first, second = (Trajectory(arm.names, whole.t, q[i], v[i], a[i]) for i, arm in enumerate(both.arms))
    return DualArmPlan((first, second), (0.0, 0.0), gap)


def plan_staggered(both: DualArm, now: StartState, wanted: DualArmGoals, time_limit: float) -> DualArmPlan:
    """A path of each arm alone; the later one waits as briefly as keeps them apart.

    Of both orders the one that ends earlier is taken. The first arm is planned with the other where it is, the second
    with the first at its goal: the second may always follow once the first has arrived.

    Raises:
        OpenArmError: as `plan_together`.
    """
    found: list[DualArmPlan] = []
    faults: list[OpenArmError] = []
    for first in range(2):
        try:
            found.append(_in_order(both, now, wanted, first, 0.5 * time_limit))
        except OpenArmError as error:
            if error.code not in (Code.NO_PLAN, Code.IN_COLLISION):
                raise
            faults.append(error.settled())
    if not found:
        text = "; ".join(f"{arm.name} first: {e.message}" for arm, e in zip(both.arms, faults, strict=True))
        raise OpenArmError(faults[0].code, f"neither arm can go first: {text}")
    best = min(found, key=lambda plan: max(part.duration for part in plan.trajectories))
    scene = both.scene(now.state, held=wanted.held)
    return replace(best, clearance=separation(scene, best.whole))


def plan_any(both: DualArm, now: StartState, wanted: DualArmGoals, time_limit: float) -> DualArmPlan:
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
            raise error from second  # the first one knows more: it considered both arms


def separation(scene: DualArmScene, whole: Trajectory) -> float:
    """Least distance of the arms on a timed motion of all joints, at checks no more than 4 mm of travel apart, m."""
    states = whole.at(dense_times(whole, scene.levers, _TRAVEL))[0]
    gaps = {i: scene.separation(states[i]) for i in {*range(0, len(states), _STRIDE), len(states) - 1}}
    least = min(gaps.values())
    checked = sorted(gaps)
    for i, j in itertools.pairwise(checked):
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


def _in_order(both: DualArm, now: StartState, wanted: DualArmGoals, first: int, time_limit: float) -> DualArmPlan:
    """The plan in which arm number `first` goes first, without the least distance of the arms."""
    second = 1 - first
    early = _alone(both, first, now, now.state, wanted, time_limit)
    there = {**now.state, **dict(zip(both.arms[first].names, early.q[-1].tolist(), strict=True))}
    late = _alone(both, second, now, there, wanted, time_limit)
    one, other = (ActiveMotion(both.arms[i], part, wanted.held[i]) for i, part in ((first, early), (second, late)))
    wait = least_delay(other, [one], now.state, stopped=now.stopped)
    if first == 0:
        return DualArmPlan((early, delayed(late, wait)), (0.0, wait), np.nan)
    return DualArmPlan((delayed(late, wait), early), (wait, 0.0), np.nan)


def _alone(
    both: DualArm, index: int, now: StartState, state: Mapping[str, float], wanted: DualArmGoals, time_limit: float
) -> Trajectory:
    """The path of one arm with the other one where `state` says."""
    arm, start = both.arms[index], both.parts(now.start)[index]
    scene = both.scene(state, wanted.obstacles, held=wanted.held, environment=now.environment).arms[index]
    arm.relax(scene, start)
    goals = [q for q in wanted.goals[index] if not scene.collides(q)][:_GOALS]
    if not goals:
        contact = scene.contacts(wanted.goals[index][0])[0]
        raise PlanFailedError(Code.IN_COLLISION, f"goal of the {arm.name} arm: {contact}", "goal", contact)
    mine = StartState(state, start, now.scale, now.stopped, now.environment)
    return arm.plan_validated(scene, mine, np.array(goals), time_limit).trajectory


def _pairs(scene: DualArmScene, goals: tuple[Array, Array]) -> Array:
    """Goals of both arms that go together, the preferred ones first; (k, n1 + n2)."""
    order = sorted(np.ndindex(len(goals[0]), len(goals[1])), key=sum)
    pairs = (np.concatenate([goals[0][i], goals[1][j]]) for i, j in order)
    found = list(itertools.islice((q for q in pairs if not scene.collides(q)), _GOALS))
    if not found:
        contact = scene.contacts(np.concatenate([goals[0][0], goals[1][0]]))[0]
        text = f"goals of both arms: {contact} (all {len(order)} pairs of goals collide)"
        raise PlanFailedError(Code.IN_COLLISION, text, "goal", contact)
    return np.array(found)


def _least(scene: DualArmScene, start: Array) -> float:
    """Distance that the arms keep: less only where they start nearer to each other already."""
    return min(_SEEN, scene.separation(start) - 0.25 * _TRAVEL)
