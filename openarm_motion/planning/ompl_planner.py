# SPDX-License-Identifier: Apache-2.0
"""The planner on the exact collision layer: the straight line where it is free, else OMPL's RRT-Connect. rad."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.planning.planner import RANGE, SHORTENINGS, PlannedPath, PlanQuery, cancelled

#: Two configurations nearer than this in every joint are one, rad.
_SAME = 1e-6
#: The seed of OMPL's random numbers is one for the process: set and used under this lock.
_SEED_LOCK = threading.Lock()


class OmplPlanner:
    """Straight line first, then OMPL's RRTConnect."""

    def plan(self, query: PlanQuery) -> PlannedPath:
        """See `Planner`."""
        edges = _Counter(query.edge_free)
        for i, goal in enumerate(query.goals):
            if query.stopped():
                raise cancelled()
            if float(np.max(np.abs(goal - query.start))) < _SAME or edges.free(query.start, goal):
                return PlannedPath(np.stack([query.start, goal]), i, edges.count)
        path = self._search(query, edges)
        distances = np.max(np.abs(query.goals - path[-1]), axis=1)
        goal = int(np.argmin(distances))
        # the search works with values moved into its bounds; the ends are those that were asked for
        path[0], path[-1] = query.start, query.goals[goal]
        path = shorten(path, edges.free, query.cost, SHORTENINGS, np.random.default_rng(query.seed))
        return PlannedPath(path, goal, edges.count)

    def _search(self, query: PlanQuery, edges: _Counter) -> Array:
        n = query.start.size
        ou.setLogLevel(ou.LOG_NONE)
        space = ob.RealVectorStateSpace(n)
        bounds = ob.RealVectorBounds(n)
        for i in range(n):
            bounds.setLow(i, float(query.lower[i]))
            bounds.setHigh(i, float(query.upper[i]))
        space.setBounds(bounds)
        information = ob.SpaceInformation(space)
        # python references must outlive the search: OMPL holds plain pointers
        validity, motion = _Validity(information, query, n), _Motion(information, edges, n)
        information.setStateValidityChecker(validity)
        information.setMotionValidator(motion)
        information.setup()

        def state(q: Array) -> Any:
            # a start 6e-9 rad outside a limit would be an "invalid start"
            allocated = space.allocState()
            allocated[0:n] = np.clip(q, query.lower, query.upper).tolist()
            return allocated

        problem = ob.ProblemDefinition(information)
        problem.addStartState(state(query.start))
        goals = ob.GoalStates(information)
        for goal in query.goals:
            goals.addState(state(goal))
        problem.setGoal(goals)
        with _SEED_LOCK:
            ou.RNG.setSeed(max(query.seed, 1))
            planner = og.RRTConnect(information)
            planner.setRange(RANGE)
            planner.setProblemDefinition(problem)
            planner.setup()
        end, samples = time.monotonic() + query.time_limit, itertools.count()

        def enough() -> bool:  # asked once a sample
            limit = next(samples) >= query.iterations if query.iterations else time.monotonic() > end
            return limit or query.stopped()

        planner.solve(ob.PlannerTerminationCondition(enough))
        if query.stopped():
            raise cancelled()
        if not problem.hasExactSolution():
            limit = f"{query.iterations} samples" if query.iterations else f"{query.time_limit:g} s"
            raise OpenArmError(
                Code.NO_PLAN,
                f"no free path to any of {len(query.goals)} goal(s) within {limit}"
                f" ({edges.count} lines checked); allow more time, or move what is in the way",
            )
        states = problem.getSolutionPath().getStates()
        return np.array([list(s[0:n]) for s in states], dtype=np.float64)


def shorten(
    path: Array,
    edge_free: Callable[[Array, Array], bool],
    cost: Callable[[Array, Array], float],
    attempts: int,
    rng: np.random.Generator,
) -> Array:
    """Make a polyline cheaper: leave way points out, cut corners, pull way points towards their neighbours.

    Args:
        path: (m, n) way points; the ends stay.
        edge_free: Whether a straight line is free.
        cost: Of one segment; fewer segments are cheaper when it counts stops.
        attempts: Number of random attempts.
        rng: Random numbers.
    """
    points = _skip([*path], edge_free)
    for _ in range(attempts):
        if len(points) < 3:
            break
        if rng.random() < 0.5:
            i = int(rng.integers(1, len(points) - 1))
            a, b = points[i - 1], points[i + 1]
            middle = a + (b - a) * float(
                np.clip((points[i] - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-12), 0, 1)
            )
            moved = points[i] + rng.random() * (middle - points[i])
            fresh, old = [a, moved, b], points[i - 1 : i + 2]
            first, last = i - 1, i + 1
        else:
            first, last = (int(k) for k in np.sort(rng.choice(len(points) - 1, 2, replace=False)))
            u, w = rng.random(2)
            a = points[first] + u * (points[first + 1] - points[first])
            b = points[last] + w * (points[last + 1] - points[last])
            fresh, old = [points[first], a, b, points[last + 1]], points[first : last + 2]
            last += 1
        if _cost(fresh, cost) < 0.99 * _cost(old, cost) and all(edge_free(p, q) for p, q in itertools.pairwise(fresh)):
            points = _skip([*points[:first], *fresh, *points[last + 1 :]], edge_free)
    return np.array(points)


def _skip(points: list[Array], edge_free: Callable[[Array, Array], bool]) -> list[Array]:
    """Greedily go from each way point to the furthest one that a free line reaches."""
    kept, i = [points[0]], 0
    while i < len(points) - 1:
        j = len(points) - 1
        while j > i + 1 and not edge_free(points[i], points[j]):
            j -= 1
        kept.append(points[j])
        i = j
    return kept


def _cost(points: list[Array], cost: Callable[[Array, Array], float]) -> float:
    return sum(cost(a, b) for a, b in itertools.pairwise(points))


class _Counter:
    """Counts the lines that are checked, and remembers the answers: shortening asks for some again."""

    def __init__(self, edge_free: Callable[[Array, Array], bool]) -> None:
        self._edge_free = edge_free
        self._known: dict[tuple[bytes, bytes], bool] = {}
        self.count = 0

    def free(self, a: Array, b: Array) -> bool:
        key = (a.tobytes(), b.tobytes())
        if key not in self._known:
            self.count += 1
            self._known[key] = self._edge_free(a, b)
        return self._known[key]


class _Validity(ob.StateValidityChecker):
    def __init__(self, information: Any, query: PlanQuery, n: int) -> None:
        super().__init__(information)
        self._query, self._n = query, n

    def isValid(self, state: Any) -> bool:
        # a numpy bool would raise std::bad_cast
        return not self._query.collides(np.array(state[0 : self._n]))


class _Motion(ob.MotionValidator):
    def __init__(self, information: Any, edges: _Counter, n: int) -> None:
        super().__init__(information)
        self._edges, self._n = edges, n

    def checkMotion(self, a: Any, b: Any) -> bool:
        return bool(self._edges.free(np.array(a[0 : self._n]), np.array(b[0 : self._n])))
