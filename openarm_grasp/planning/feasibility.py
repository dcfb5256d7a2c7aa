# SPDX-License-Identifier: Apache-2.0
"""Plan what is not carried out yet: could an arm pick an object that stood somewhere, and put it somewhere else?

Nothing moves. Strategies with several parts are planned to their end so before their first part begins. Base frame, m,
rad.
"""

from __future__ import annotations

from collections.abc import Awaitable, Sequence
from dataclasses import replace

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_grasp.config import GraspConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.planning.candidates import GraspCandidate, PlaceTarget, held_box, obstacle_boxes, propose, target_box
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.planning.place import other_grasps, place_targets
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace, Trajectory
from openarm_grasp.robot.skills import Skills


def grasp_request(
    arm: str,
    offered: Sequence[GraspCandidate],
    target: Detection,
    others: Sequence[Detection],
    config: GraspConfig,
    now: Detection | None = None,
) -> PlanGrasp:
    """What the planner is asked for a grasp.

    Args:
        arm: Whose.
        offered: The candidates.
        target: The object.
        others: What else stands on the table.
        config: Parameters.
        now: The object where it stands until then, when that is elsewhere: the map shows it there.
    """
    gone = () if now is None else (target_box(now, config),)
    return PlanGrasp(arm, tuple(offered), obstacle_boxes(others, config), target_box(target, config), gone)


def place_request(
    arm: str,
    ways: Sequence[PlaceTarget],
    target: Detection,
    others: Sequence[Detection],
    candidate: GraspCandidate,
    config: GraspConfig,
    after: Trajectory | None = None,
) -> PlanPlace:
    """What the planner is asked for a place; the map may still show the object where it was.

    Args:
        arm: Whose.
        ways: To put the object down.
        target: The object before the grasp.
        others: What else stands on the table.
        candidate: How the hand holds it.
        config: Parameters.
        after: Trajectory whose end is the start; None starts at the present joints.
    """
    held, stood = held_box(target, candidate, config), (target_box(target, config),)
    return PlanPlace(arm, tuple(ways), obstacle_boxes(others, config), held, after, stood)


async def refusal_of(work: Awaitable[object]) -> OpenArmError | None:
    """Await a plan; return why it cannot be done, None when it can.

    Raises:
        OpenArmError: When it was not found out.
    """
    try:
        await work
    except OpenArmError as error:
        if error.code not in NO_WAY:
            raise
        return error
    return None


class FeasibilityCheck:
    """Ask the planner.

    Args:
        robot: Whose planner.
        context: Parameters and where the arms stand.
    """

    def __init__(self, robot: Skills, context: GraspContext) -> None:
        self._robot, self._context = robot, context

    async def pick(
        self,
        arm: str,
        target: Detection,
        others: Sequence[Detection],
        offered: Sequence[GraspCandidate] | None = None,
        now: Detection | None = None,
    ) -> tuple[GraspCandidate, Planned]:
        """Plan a grasp of an object that stands there.

        Args:
            arm: Whose.
            target: The object.
            others: What else stands on the table.
            offered: The grasps to choose from; every one when not given.
            now: The object where it stands until then, when that is elsewhere.

        Returns:
            The grasp that can be made, and its plan.

        Raises:
            OpenArmError: One of `NO_WAY`; what the robot raises.
        """
        config = self._context.config
        offered = self._offered(arm, target, others) if offered is None else tuple(offered)
        plan = await self._robot.plan(grasp_request(arm, offered, target, others, config, now))
        return offered[plan.chosen], plan

    def _offered(self, arm: str, target: Detection, others: Sequence[Detection]) -> tuple[GraspCandidate, ...]:
        shoulder = self._context.shoulders.get(arm, (0.0, 0.0))
        return propose(target, self._context.config, shoulder_xy=shoulder, others=others)

    async def pick_and_place(
        self,
        arm: str,
        target: Detection,
        others: Sequence[Detection],
        spots: Sequence[Array],
        *,
        yaw: float | None = None,
        used: Sequence[PlaceTarget] = (),
    ) -> PlaceTarget:
        """Plan a grasp, and how it ends on one of the spots; others are tried when one cannot be put down.

        Args:
            arm: Whose.
            target: The object.
            others: What else stands on the table.
            spots: (2,) footprint centres, best first.
            yaw: Of the object there; None: unconstrained.
            used: Ways to put it down that are of no use.

        Raises:
            OpenArmError: As `pick`.
        """
        config, left = self._context.config, self._offered(arm, target, others)
        refused: OpenArmError | None = None
        while True:
            try:
                candidate, plan = await self.pick(arm, target, others, left)
            except OpenArmError as error:
                if refused is None or error.code not in NO_WAY:
                    raise
                raise refused from error
            offered = place_targets(target, candidate, spots, config, yaw=yaw)
            ways = [way for way in offered if not any(_same(way, other, any_turn=target.round) for other in used)]
            try:
                if not ways:
                    raise OpenArmError(Code.UNREACHABLE, "no other way to put it down is left")
                request = place_request(arm, ways, target, others, candidate, config, plan.retreat)
                end = await self._robot.plan(request)
                return ways[end.chosen]
            except OpenArmError as error:
                left = other_grasps(left, candidate, error.code, target, yaw)
                if error.code not in NO_WAY or not left:
                    raise
                refused = error


def standing_at(target: Detection, xy: Sequence[float] | Array, turn: float = 0.0) -> Detection:
    """The object as it would be observed elsewhere, turned by `turn` about the vertical unless it is round."""
    p = np.array([xy[0], xy[1], target.p_base[2]])
    turn = 0.0 if target.round else turn
    return replace(target, T_base_object=se3.make(se3.rot_z(turn) @ target.T_base_object[:3, :3], p))


def _same(a: PlaceTarget, b: PlaceTarget, *, any_turn: bool) -> bool:
    there = float(np.linalg.norm(a.position[:2] - b.position[:2])) < 1e-6
    return there and (any_turn or abs(a.yaw_offset - b.yaw_offset) < 1e-6)
