# SPDX-License-Identifier: Apache-2.0
"""Plan what is not carried out yet: could an arm pick an object that stood somewhere, and put it somewhere else?

Nothing moves. Strategies with several parts are planned to their end so before their first part begins. Base frame, m,
rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_grasp.context import GraspContext
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.planning.candidates import GraspCandidate, PlaceTarget
from openarm_grasp.planning.offers import offers
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.planning.place import other_grasps, place_targets

if TYPE_CHECKING:
    from openarm_grasp.robot.interface import Planned
    from openarm_grasp.robot.skills import Skills


class FeasibilityCheck:
    """Ask the planner.

    Args:
        robot: Robot whose planner is asked.
        context: Parameters and where the arms stand.
    """

    def __init__(self, robot: Skills, context: GraspContext) -> None:
        self._robot, self._context = robot, context

    async def refusal(
        self,
        arm: str,
        found: Sighting,
        place: Sequence[float] | None = None,
        *,
        yaw: float | None = None,
        now: Sighting | None = None,
        offered: tuple[GraspCandidate, ...] | None = None,
    ) -> OpenArmError | None:
        """Why an arm cannot pick the object, and put it where it is wanted; None when it can.

        Args:
            arm: Arm to plan for.
            found: The object and its neighbours.
            place: Footprint centre (x, y), base frame, m; None: the grasp alone is planned.
            yaw: Yaw of the object there; None: unconstrained.
            now: The object where it stands until then, when that is elsewhere; for a grasp alone.
            offered: Grasps of it there; None: they are searched.

        Raises:
            OpenArmError: Error of the robot, when it was not found out.
        """
        try:
            if place is None:
                ways = offers(self._context, arm, found) if offered is None else offered
                await self._robot.plan_grasp(arm, ways, found, now)
            else:
                await self.pick_and_place(arm, found, (self._context.on_table(place),), yaw=yaw)
        except OpenArmError as error:
            if error.code not in NO_WAY:
                raise
            return error
        return None

    async def grasp(self, arm: str, found: Sighting, *, at_height: float | None = None) -> Planned:
        """Plan a grasp; `at_height`: with the lift at another position, m.

        Raises:
            OpenArmError: One of `NO_WAY`; what the robot raises.
        """
        return await self._robot.plan_grasp(arm, offers(self._context, arm, found), found, at_height=at_height)

    async def pick_and_place(
        self,
        arm: str,
        found: Sighting,
        spots: Sequence[Array],
        *,
        yaw: float | None = None,
        used: Sequence[PlaceTarget] = (),
    ) -> PlaceTarget:
        """Plan a grasp, and how it ends on one of the spots; others are tried when one cannot be put down.

        Args:
            arm: Arm to plan for.
            found: The object and its neighbours.
            spots: (3,) footprint centres on what it is to stand on, best first.
            yaw: Yaw of the object there; None: unconstrained.
            used: Ways to put it down that are of no use.

        Raises:
            OpenArmError: One of `NO_WAY`; what the robot raises.
        """
        target, left = found.target, offers(self._context, arm, found)
        refused: OpenArmError | None = None
        while True:
            try:
                plan = await self._robot.plan_grasp(arm, left, found)
            except OpenArmError as error:
                if refused is None or error.code not in NO_WAY:
                    raise
                raise refused from error
            candidate = left[plan.chosen]
            offered = place_targets(target, candidate, spots, self._context.config, yaw=yaw)
            ways = [way for way in offered if not any(_same(way, other, any_turn=target.round) for other in used)]
            try:
                if not ways:
                    raise OpenArmError(Code.UNREACHABLE, "no other way to put it down is left")
                end = await self._robot.plan_place(arm, ways, found, candidate, plan.retreat)
                return ways[end.chosen]
            except OpenArmError as error:
                left = other_grasps(left, candidate, error.code, target, yaw)
                if error.code not in NO_WAY or not left:
                    raise
                refused = error


def _same(a: PlaceTarget, b: PlaceTarget, *, any_turn: bool) -> bool:
    there = float(np.linalg.norm(a.position[:2] - b.position[:2])) < 1e-6
    return there and (any_turn or abs(a.yaw_offset - b.yaw_offset) < 1e-6)
