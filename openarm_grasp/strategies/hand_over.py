# SPDX-License-Identifier: Apache-2.0
"""Hand-over through the middle: one arm puts the object down where both reach, the other takes it from there.

It is planned before anything moves: the giver's grasp and a place in the middle, and from that place the taker's
grasp and the place that was asked for. An object is seldom put down exactly at its target, so the taker must be
able to go on from around that place, too. Base frame, m, rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from math import radians

import numpy as np

from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_grasp.config import HandOverConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.perception.sightings import seen_at
from openarm_grasp.planning.candidates import PlaceTarget
from openarm_grasp.planning.feasibility import FeasibilityCheck
from openarm_grasp.planning.options import NO_WAY, refusals
from openarm_grasp.planning.place import clear_spots, grid
from openarm_grasp.requests.request import Feasible, GraspOutcome
from openarm_grasp.requests.task import Task
from openarm_grasp.strategies.pick_and_place import pick_and_place


@dataclass(frozen=True)
class HandOver:
    """A way through the middle that was planned to its end.

    Attributes:
        giver: The arm that brings the object to the middle.
        taker: The arm that takes it from there.
        spot: (3,) where it stands in between.
        yaw: Yaw of its x axis there, rad.
    """

    giver: str
    taker: str
    spot: Array
    yaw: float

    def __str__(self) -> str:
        """Sentence for the status."""
        x, y, _ = self.spot
        return (
            f"the {self.giver} arm brings it to the middle, ({x:.3f}, {y:.3f}) m, and the {self.taker} arm from there"
            " to its place"
        )


async def hand_over(task: Task) -> GraspOutcome | None:
    """From hand to hand by way of the middle, when an arm can pick the object and only another reaches its place.

    When the taker is refused after all, again from where the object then is.
    """
    asked, known = task.request, task.outcome
    if known is None or asked.place is None or not task.findings.place_refused or len(task.context.shoulders) < 2:
        return None
    refused, most = None, task.context.config.hand_over.rounds
    for number in range(1, most + 1):
        found = task.findings.need_sighting()
        try:
            way = await plan_hand_over(task, found)
        except OpenArmError as error:
            if refused is None or error.code not in (*NO_WAY, Code.PLACE_FAILED):
                raise
            return replace(refused, message=f"{refused.message}; {error.message}")
        if asked.dry_run:
            x, y, _ = found.target.p_base
            text = f"can be done from ({x:.3f}, {y:.3f}) m: {way}"
            return replace(known, code=Code.OK, message=text, arm=way.taker, proof=Feasible(str(way)))
        again = "" if number == 1 else f", at try number {number}"
        x, y, _ = (float(v) for v in way.spot)
        why = f"hand-over, 1 of 2: {way}"
        bring = replace(asked.about(found), arm=way.giver, place=(x, y), place_yaw=way.yaw, why=why)
        brought = await pick_and_place(task, bring)
        if not brought.success:
            return replace(brought, message=f"on the way to the middle: {brought.message}")
        task.displaced = f"brought to the middle{again}"
        there = seen_at(found, way.spot)
        take = replace(asked.about(there), arm=way.taker, why=f"hand-over, 2 of 2: {way}")
        taken = await pick_and_place(task, take)
        if taken.success:
            text = f"{taken.message}; the {way.giver} arm had brought it to the middle, ({x:.3f}, {y:.3f}) m{again}"
            return replace(taken, message=text)
        refused = replace(taken, arm=way.taker)
        if not task.may_go_on(taken):
            break
        if number < most:
            task.note(f"{taken.message}; searching for another way from where it stands now")
    return refused


def middle_spots(target: Detection, others: Sequence[Detection], context: GraspContext) -> tuple[Array, ...]:
    """Free spots that both arms reach, those with most room first, then the nearest to the object.

    Raises:
        OpenArmError: PLACE_FAILED, when none is free.
    """
    config, place = context.config.hand_over, context.config.place
    xs, ys = grid(*config.x, config.step), grid(-config.abs_y, config.abs_y, config.step)
    ranked = [(cost, x, y) for cost, _, x, y in clear_spots(product(xs, ys), target, others, place)]
    if not ranked:
        raise OpenArmError(
            Code.PLACE_FAILED,
            f"no free spot in the middle (x {config.x[0]:g} to {config.x[1]:g}, |y| up to {config.abs_y:g} m): none is"
            f" {place.neighbour_distance * 1e3:.0f} mm from {len(others)} other objects",
        )
    return tuple(np.array([x, y]) for _, x, y in sorted(ranked))


async def plan_hand_over(task: Task, seen: Sighting) -> HandOver:
    """Find a way through the middle.

    The giver says where and how it can set the object down; what the taker cannot use is left out, and it is asked
    again. A place from which the taker could go on, but not from all around it, is the last resort.

    Args:
        task: Request.
        seen: The object and its neighbours.

    Raises:
        OpenArmError: NO_PLAN or PLACE_FAILED, with what each arm lacks; what the robot raises.
    """
    spots = [task.context.on_table(xy) for xy in middle_spots(seen.target, seen.others, task.context)]
    shoulders, y, faults = task.context.shoulders, seen.target.p_base[1], list[str]()
    for giver, taker in sorted(permutations(shoulders, 2), key=lambda two: abs(shoulders[two[0]][1] - y)):
        with refusals(faults, f"{giver} to {taker}: "):
            return await _between(task, seen, giver, taker, spots)
    raise OpenArmError(Code.NO_PLAN, f"no hand-over through the middle: {'; '.join(faults)}")


async def _between(task: Task, seen: Sighting, giver: str, taker: str, spots: Sequence[Array]) -> HandOver:
    feasible, config, asked = FeasibilityCheck(task.robot, task.context), task.context.config.hand_over, task.request
    useless: list[PlaceTarget] = []
    best: tuple[int, HandOver] | None = None
    fault = ""
    for _ in range(config.tries):
        try:
            way = await feasible.pick_and_place(giver, seen, spots, used=useless)
        except OpenArmError as error:
            if error.code not in NO_WAY or not fault:
                raise
            break
        found = HandOver(giver, taker, way.position, seen.target.yaw + way.yaw_offset)
        there = seen_at(seen, way.position, way.yaw_offset)
        refusal, copes = None, -1
        for stands in (there, *_around(there, config)):
            copes += 1
            refusal = await feasible.refusal(taker, stands, asked.place, yaw=asked.place_yaw)
            if refusal is not None:
                break
        if refusal is None:
            return found
        fault = refusal.message
        useless.append(way)
        if copes and (best is None or copes > best[0]):
            best = (copes, found)
    if best is not None:
        return best[1]
    raise OpenArmError(Code.NO_PLAN, f"the {taker} arm could not go on from {len(useless)} places: {fault}")


def _around(there: Sighting, config: HandOverConfig) -> tuple[Sighting, ...]:
    """The object as it may stand instead: a little off to each side, and turned."""
    off, turn = config.margin, radians(config.margin_deg)
    ways = ((off, 0.0, turn), (-off, 0.0, -turn), (0.0, off, -turn), (0.0, -off, turn)) if off or turn else ()
    return tuple(seen_at(there, there.target.p_base[:2] + np.array([dx, dy]), by) for dx, dy, by in ways)
