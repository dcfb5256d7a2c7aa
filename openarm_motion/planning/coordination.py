# SPDX-License-Identifier: Apache-2.0
"""An arm starts while another is under way: how long it must rest first so that they keep apart all the way.

Both are checked as they go on and where they end, at moments between which their points move no further than a
few millimetres, on the exact layer. The rest is found on a grid of 0.1 s. Base frame, m, rad, s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.collision.exact import Clearance, CollisionContext, CollisionScene, Contact
from openarm_motion.collision.solids import Box
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.planning.planner import never
from openarm_motion.timing.trajectory import Motion
from openarm_motion.timing.validation import ends_first, subdivided

if TYPE_CHECKING:
    from openarm_motion.planning.arm import Arm

#: Distance of two arms under way that is proven, m.
APART = 0.020
#: The points of both arms together move no further between two checks, m; half of it may be missed between them.
_TRAVEL = 0.004
#: Asked for at each check, m: what is missed between two, and a little for arms that lag behind.
_SEEN = APART + 0.5 * _TRAVEL + 0.002
#: What is between two samples of a motion is taken for straight when they are no further apart, s.
_GRID = 0.05
#: Rests that are tried are this far apart, s.
_STEP = 0.1


@dataclass(frozen=True, eq=False)
class ActiveMotion:
    """What an arm has before it: a motion whose time 0 is now, and the boxes that it holds on it, tool frame."""

    arm: Arm
    motion: Motion
    held: Sequence[Box] = ()

    @classmethod
    def standing(cls, arm: Arm, state: Mapping[str, float], held: Sequence[Box] = ()) -> ActiveMotion:
        """An arm that stays where it is."""
        q = np.array([[state[name] for name in arm.names]])
        return cls(arm, Motion(arm.names, np.zeros(1), q), held)


def least_delay(
    mine: ActiveMotion,
    others: Sequence[ActiveMotion],
    state: Mapping[str, float],
    longest: float = np.inf,
    stopped: Callable[[], bool] = never,
) -> float:
    """Shortest rest before a motion that keeps the arm 20 mm from the others, all the way and at the ends, s.

    Arms that are nearer to each other now may stay as near as they are.

    Args:
        mine: The arm that is to start, its motion beginning now.
        others: The other arms.
        state: Present positions of the robot's joints.
        longest: It may rest no longer, s.
        stopped: Whether to give up.

    Raises:
        PlanFailedError: IN_COLLISION, with the pair, the time, and whether a longer rest would help.
        OpenArmError: CANCELLED.
    """
    pair = _Pair(mine, others, state)
    if pair.overlaps:
        return 0.0  # any way out is better than none, and the plan has checked it
    over = max([0.0, *(float(other.motion.t[-1]) for other in others)])  # the others stand still from then on
    last = min(over, longest)
    hit: tuple[float, Array] = (0.0, mine.motion.q[0])
    for wait in np.append(np.arange(0.0, last, _STEP), last):
        if stopped():
            raise OpenArmError(Code.CANCELLED, "planning was stopped")
        found = pair.first_hit(float(wait))
        if found is None:
            return float(wait)
        hit = found
    contact = pair.contact(*hit)
    hope = "" if last >= over else f" within {longest:g} s; it would have to wait longer"
    text = f"{mine.arm.name} arm after {hit[0]:.1f} s: {contact}, and no rest before it helps{hope}"
    raise PlanFailedError(Code.IN_COLLISION, text, "execution", contact)


class _Pair:
    """One arm and others under way, and nothing else."""

    def __init__(self, mine: ActiveMotion, others: Sequence[ActiveMotion], state: Mapping[str, float]) -> None:
        self._mine, self._others = mine, others
        carried = [box for other in others for box in other.arm.robot.on_tool(other.held)]
        self._scene = self._made(mine, state, _SEEN, carried)
        self._levers = [self._made(other, state, _SEEN).levers for other in others]
        self._put(0.0, mine.motion.q[0])
        arm = mine.arm.robot.arm
        links = frozenset(mine.arm.robot.links) - arm.fixed - arm.moving | self._scene.carried
        gap = self._scene.gap(mine.motion.q[0], links)
        self.overlaps = gap <= 0.0
        if 0.0 < gap < _SEEN:
            self._scene = self._made(mine, state, max(gap - 0.001, 0.0), carried)

    @staticmethod
    def _made(
        course: ActiveMotion, state: Mapping[str, float], apart: float, carried: Sequence[tuple[int, Box]] = ()
    ) -> CollisionScene:
        keep = Clearance(arms=apart)
        around = CollisionContext(state, held=course.held, carried=carried, clearance=keep, own=False)
        return CollisionScene(course.arm.robot, around)

    def first_hit(self, wait: float) -> tuple[float, Array] | None:
        """A moment at which the arms are too near when the arm rests first, and the arm's joints then; or None."""
        mine = self._mine.motion.later(wait)
        times = self._times(mine)
        q = mine.states(times)
        ways = [other.motion.states(times) for other in self._others]
        for k in ends_first(len(times)):
            for other, way in zip(self._others, ways, strict=True):
                self._scene.put_other(other.arm.robot, way[k])
            if self._scene.collides(q[k]):
                return float(times[k]), q[k]
        return None

    def contact(self, t: float, q: Array) -> Contact:
        """The pair that is nearest to each other then."""
        self._put(t, q)
        return self._scene.contacts(q)[0]

    def _put(self, t: float, q: Array) -> None:
        for other in self._others:
            self._scene.put_other(other.arm.robot, other.motion.states(np.array([t]))[0])

    def _times(self, mine: Motion) -> Array:
        """Moments from now to the end of all, between which the points of all arms move no further than `_TRAVEL`."""
        motions = [mine, *(other.motion for other in self._others)]
        levers = [self._scene.levers, *self._levers]
        end = max(0.0, *(float(motion.t[-1]) for motion in motions))
        inner = np.concatenate([motion.t for motion in motions])
        grid = np.unique(np.concatenate([np.arange(0.0, end, _GRID), inner[(inner > 0.0) & (inner < end)], [end]]))
        ways = [np.abs(np.diff(m.states(grid), axis=0)) @ lever for m, lever in zip(motions, levers, strict=True)]
        return subdivided(grid, np.sum(ways, axis=0), _TRAVEL)
