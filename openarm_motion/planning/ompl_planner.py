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
        # this reference must outlive the search: OMPL holds a plain pointer
        motion = _Motion(information, edges, n)
        information.setStateValidityChecker(lambda state: not query.collides(np.array(state[0:n])))
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
            simplifier = og.PathSimplifier(information)
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
        path = problem.getSolutionPath()
        simplifier.reduceVertices(path)
        simplifier.partialShortcutPath(path, SHORTENINGS)
        simplifier.reduceVertices(path)
        return np.array([list(s[0:n]) for s in path.getStates()], dtype=np.float64)


class _Counter:
    """Counts the lines that are checked, and remembers the answers: simplification asks for some again."""

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


class _Motion(ob.MotionValidator):
    def __init__(self, information: Any, edges: _Counter, n: int) -> None:
        super().__init__(information)
        self._edges, self._n = edges, n

    def checkMotion(self, a: Any, b: Any) -> bool:
        return bool(self._edges.free(np.array(a[0 : self._n]), np.array(b[0 : self._n])))
