# SPDX-License-Identifier: Apache-2.0
"""Free joint paths: what a planner is asked, and planners by name, so that configuration selects another one. rad.

What a planner knows of the world is two questions: does this configuration collide, is this straight joint line free?
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

if TYPE_CHECKING:
    from openarm_motion.collision.fast import FastScene


#: Planners of the suite.
_PLANNERS = {
    "fast": "openarm_motion.planning.rrt:FastPlanner",
    "ompl": "openarm_motion.planning.ompl_planner:OmplPlanner",
}
#: Longest edge of the searches' trees, rad: small is better in clutter.
RANGE = 0.8
#: Attempts to shorten what a search found.
SHORTENINGS = 60


def never() -> bool:
    """Never stop a query."""
    return False


@dataclass(frozen=True, eq=False)
class PlanQuery:
    """What to plan.

    Attributes:
        start: (n,) rad.
        goals: (k, n) rad; any of them will do, an earlier one is preferred.
        lower: (n,) bounds of the search; start and goals lie within or are moved in by rounding only.
        upper: (n,) bounds.
        collides: Whether a configuration collides.
        edge_free: Whether the straight joint line between two configurations is free, ends included.
        time_limit: Wall clock, s.
        iterations: Samples of the search, in place of the time limit; 0 leaves it to the time. The same query then ends
            the same way on a busy machine.
        seed: Seed of the random numbers: the same query gives the same path.
        stopped: Asked often; planning ends with CANCELLED when it says True.
        fast: Makes the fast layer's view of the same; None leaves the two questions above.
        resolution: Turn of a joint (rad) and travel of a point (m) between two checks of a line.
        limits: Velocity, acceleration and jerk (n,) of the joints, which say how long a segment takes.
    """

    start: Array
    goals: Array
    lower: Array
    upper: Array
    collides: Callable[[Array], bool]
    edge_free: Callable[[Array, Array], bool]
    time_limit: float = 5.0
    iterations: int = 0
    seed: int = 1
    stopped: Callable[[], bool] = field(default=never)
    fast: Callable[[], FastScene] | None = None
    resolution: tuple[float, float] = (0.05, 0.02)
    limits: tuple[Array, Array, Array] | None = None


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """Way points (m, n) from the start to goal number `goal`; `edges` is how many lines were checked."""

    waypoints: Array
    goal: int
    edges: int


class Planner(Protocol):
    """Anything that finds free joint paths."""

    def plan(self, query: PlanQuery) -> PlannedPath:
        """Find a path.

        Raises:
            OpenArmError: NO_PLAN, when none was found in the time limit; CANCELLED, when the query was stopped.
        """
        ...


def cancelled() -> OpenArmError:
    """Return the error of a query that was stopped."""
    return OpenArmError(Code.CANCELLED, "planning was stopped")


def make_planner(name: str) -> Planner:
    """The planner of a name: fast, ompl, or `package.module:Class`, whose class is made without arguments.

    Whatever it answers is timed, checked against the limits and validated on the exact layer like our own paths.

    Raises:
        OpenArmError: CONFIG_INVALID, when there is no such class, or it can't plan.
    """
    module, _, attribute = _PLANNERS.get(name, name).partition(":")
    valid = "valid: fast, ompl, or package.module:Class with a method plan(query)"
    try:
        found: Any = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"planning.planner {name!r}: {error}; {valid}") from error
    if not callable(getattr(found, "plan", None)):
        raise OpenArmError(Code.CONFIG_INVALID, f"planning.planner {name!r} has no method plan; {valid}")
    return found()
