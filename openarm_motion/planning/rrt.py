# SPDX-License-Identifier: Apache-2.0
"""The planner in use: straight lines, then RRT-Connect towards many goals, all on the fast collision layer. rad.

What the fast layer can't prove to be free (a start in a tight place, say) is left to another planner on the exact one.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from openarm_common.types import Array
from openarm_motion.collision.clearance_kernels import workspace
from openarm_motion.collision.fast import FastScene
from openarm_motion.planning import search_kernels as kernels
from openarm_motion.planning.ompl_planner import OmplPlanner
from openarm_motion.planning.planner import RANGE, SHORTENINGS, PlannedPath, PlanQuery, cancelled

#: Two configurations nearer than this in every joint are one, rad.
_SAME = 1e-6
#: Configurations a tree has room for, and samples between two checks of the clock.
_ROOM = 20_000
_CHUNK = 500
#: Way points that a path may grow by while it is shortened.
_SPARE = 8
#: How many times longer the steps of a first search are than those of the final check, and how long the turns of the
#: joints in it are at least, rad.
_COARSE, _ROUGH = 3.0, 0.15
#: Share of the time after which the exact layer gets its turn.
_SHARE = 0.5


class FastPlanner:
    """See the module's head."""

    def plan(self, query: PlanQuery) -> PlannedPath:
        """See `Planner`."""
        if query.fast is None:
            return OmplPlanner().plan(query)
        begin = time.monotonic()
        scene = query.fast()
        step, travel = query.resolution
        if query.stopped():
            raise cancelled()
        for i, goal in enumerate(query.goals):
            if float(np.max(np.abs(goal - query.start))) < _SAME or scene.edge_free(query.start, goal, step, travel):
                return PlannedPath(np.stack([query.start, goal]), i, i + 1)
        end = begin + _SHARE * query.time_limit
        # a coarse search first; what it finds counts only when a fine check agrees
        for factor in sorted({1.0, _COARSE, max(_COARSE, _ROUGH / step)}, reverse=True):
            found = self._search(query, scene, (step * factor, travel * factor), end)
            if found is None:
                break
            if all(scene.edge_free(a, b, step, travel) for a, b in itertools.pairwise(found.waypoints)):
                return found
        left = max(query.time_limit - (time.monotonic() - begin), 0.05)
        return OmplPlanner().plan(replace(query, time_limit=left))

    def _search(self, query: PlanQuery, scene: FastScene, steps: tuple[float, float], end: float) -> PlannedPath | None:
        roots = np.flatnonzero(scene.free_many(query.goals))
        if not roots.size or not scene.free(query.start):
            return None
        n = query.start.size
        trees = np.empty((2, _ROOM + roots.size, n))
        parents = np.full((2, _ROOM + roots.size), -1, np.int64)
        counts = np.array([1, roots.size], np.int64)
        trees[0, 0], trees[1, : roots.size] = query.start, query.goals[roots]
        bounds, resolution = np.stack([query.lower, query.upper]), np.array(steps)
        work, edges, chunk = workspace(scene.model), 0, 0
        while True:
            seed = (query.seed + 7919 * chunk) % 2**31
            a, b, checked = kernels.grow(
                trees, parents, counts, bounds, RANGE, resolution, scene.levers, scene.model, work, _CHUNK, seed
            )
            edges, chunk = edges + checked, chunk + 1
            if a >= 0:
                break
            if query.stopped():
                raise cancelled()
            spent = chunk * _CHUNK >= query.iterations if query.iterations else time.monotonic() > end
            if spent or int(counts.max()) >= _ROOM:
                return None
        there, back = _branch(parents[0], a), _branch(parents[1], b)
        path = np.concatenate([trees[0, there[::-1]], trees[1, back[1:]]])
        points = np.empty((len(path) + _SPARE, n))
        points[: len(path)] = path
        limits = np.ones((3, n)) if query.limits is None else np.stack(query.limits)
        count = kernels.shorten(
            points, len(path), SHORTENINGS, query.seed, limits, resolution, scene.levers, scene.model, work
        )
        return PlannedPath(points[:count].copy(), int(roots[back[-1]]), edges + len(query.goals))


def warm_search(scene: FastScene, q: Array) -> None:
    """Run every kernel of the fast layer once, so that it is compiled."""
    scene.edge_free(q, q)
    ends = np.stack([q, q + 0.01])
    scene.free_many(ends)
    trees, parents = np.stack([ends, ends]), np.full((2, 2), -1, np.int64)
    grid, work = np.array((0.05, 0.02)), workspace(scene.model)
    counts = np.array([1, 1], np.int64)
    kernels.grow(trees, parents, counts, ends, RANGE, grid, scene.levers, scene.model, work, 1, 1)
    kernels.shorten(ends, 2, 1, 1, np.ones((3, q.size)), grid, scene.levers, scene.model, work)


def _branch(parents: NDArray[np.int64], k: int) -> list[int]:
    """Indices from a configuration to the root of its tree."""
    out = [k]
    while parents[out[-1]] >= 0:
        out.append(int(parents[out[-1]]))
    return out
