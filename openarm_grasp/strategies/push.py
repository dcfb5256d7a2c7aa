# SPDX-License-Identifier: Apache-2.0
"""Push an object into reach, or away from its neighbours.

A closed hand goes behind it, low, and along a straight line; an observation follows.

A hand comes to more places than it can grasp at: a grasp also needs room above, and one of a few yaws. Where an object
can be pushed is not written down but planned: the way behind the object, straight down, and the line itself, with the
object as what the hand carries, so that both keep clear of everything else. What stands in a crowd has no such place:
there the hand pushes it together with what it meets, and what comes of it is observed. Base frame, m, rad.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_common.wanted import EASIEST
from openarm_grasp.context import GraspContext
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.perception.sightings import seen_at
from openarm_grasp.planning.candidates import GraspCandidate, displaced, target_boxes
from openarm_grasp.planning.feasibility import FeasibilityCheck
from openarm_grasp.planning.neighbours import cornered, crowded
from openarm_grasp.planning.offers import offers
from openarm_grasp.planning.options import NO_WAY, refusals
from openarm_grasp.planning.pushes import closed_hand, destinations, push_ways
from openarm_grasp.requests.confirm import PUSH, agree_once
from openarm_grasp.requests.request import Feasible, GraspOutcome
from openarm_grasp.requests.task import Task
from openarm_grasp.strategies.pick_and_place import pick_and_place
from openarm_grasp.strategies.pushing import Push, carry_out_push, is_open, plan_sweep


async def push(task: Task) -> GraspOutcome | None:
    """Push an object that no arm can grasp where it is into reach, observe, and pick it; several times if need be."""
    refused = task.outcome
    if refused is None or task.findings.place_refused:
        return None
    found = task.findings.need_sighting()
    if task.request.selection == EASIEST and crowded(found) and not found.target.kind:
        return None  # others may be taken first, after which it may stand alone
    avoid: list[Array] = []
    for number in range(1, task.context.config.push.most + 1):
        found = task.findings.need_sighting()
        if not (found.target.measured or _may_sweep(task, found)):
            return None  # how far it reaches is not known
        try:
            planned = await _plan(task, found, avoid)
        except OpenArmError as error:
            if number == 1 or error.code not in NO_WAY:
                raise
            return replace(refused, message=f"{refused.message}; after {number - 1} pushes {error.message}")
        if task.request.dry_run:
            return replace(refused, code=Code.OK, message=f"can be done: {planned}", proof=Feasible(str(planned)))
        await agree_once(task, planned.arm, str(planned), PUSH, planned.plan, found)
        try:
            pushed, observed, *_ = await carry_out_push(task, planned, found, number)
        except OpenArmError as error:
            return replace(refused, code=error.code, message=error.message)
        task.displaced = "after the pushes"
        avoid.append(-planned.ahead if planned.moves(found.target, pushed.target) else planned.ahead)
        refused = await pick_and_place(task, replace(task.request.about(pushed), why=observed))
        if refused.success:
            return replace(refused, message=f"{refused.message}; {observed}")
        if not task.may_go_on(refused) or task.findings.place_refused:
            break
    return refused


def _may_sweep(task: Task, found: Sighting) -> bool:
    """Whether the object may be pushed with what the hand meets there; what comes of it is not known beforehand.

    It stands in a crowd; or it leaves no room for a hand and has corners, so that it lies badly, or is several things.
    For the easiest object nothing else is moved, and what fits into no hand is pushed in phase aside alone.
    """
    code = None if task.outcome is None else task.outcome.code
    if task.request.dry_run or task.request.selection == EASIEST or code is Code.TOO_WIDE:
        return False
    return crowded(found) or (code is Code.IN_COLLISION and cornered(found))


async def _plan(task: Task, found: Sighting, avoid: Sequence[Array]) -> Push:
    """A push into reach; in a crowd, where there is none, one through it.

    Args:
        task: Task that it is a part of.
        found: The object and its neighbours.
        avoid: (2,) directions in which a push did not move it, or from which one has.

    Raises:
        OpenArmError: UNREACHABLE, with the reason, when there is none; what the robot raises.
    """
    fault = ""
    if found.target.measured:
        try:
            return await plan_push(task, found, avoid)
        except OpenArmError as error:
            if error.code not in NO_WAY or not _may_sweep(task, found):
                raise
            fault = f"{error.message}; "
    try:
        return await plan_sweep(task, found, avoid, task.context.config.push.lengths)
    except OpenArmError as error:
        raise OpenArmError(error.code, f"{fault}{error.message}") from error


async def plan_push(task: Task, found: Sighting, avoid: Sequence[Array]) -> Push:
    """Find a push after which the object can be grasped; arguments as `_plan`.

    Raises:
        OpenArmError: UNREACHABLE, with the reason, when there is none; what the robot raises.
    """
    faults: list[str] = []
    start = found.target.p_base[:2]
    ends = [end for end in destinations(found.target, found.others, task.context) if is_open(end - start, avoid)]
    ways = _ways_alone(task.context, found) if ends else {}
    for end in ends:
        x, y = end
        with refusals(faults, f"to ({x:.3f}, {y:.3f}) m: "):
            return await _push_to(task, found, end, await _taker(task, found, end, ways))
    why = f"{faults[0]} ({len(faults) - 1} other pushes refused)" if faults else "there is no free place around it"
    raise OpenArmError(Code.UNREACHABLE, f"it cannot be pushed into reach either: {why}")


def _ways_alone(context: GraspContext, found: Sighting) -> Mapping[str, tuple[GraspCandidate, ...]]:
    """Grasps of the object without its neighbours by arm: they are the same wherever it stands alone.

    Raises:
        OpenArmError: UNREACHABLE, with the reason, when no hand fits around it even then.
    """
    clouds = (replace(c, points=c.points[c.labels != 2], labels=c.labels[c.labels != 2]) for c in found.clouds)
    alone = replace(found, others=(), clouds=tuple(clouds))
    ways: dict[str, tuple[GraspCandidate, ...]] = {}
    faults = list[str]()
    for arm in context.shoulders:
        with refusals(faults):
            ways[arm] = offers(context, arm, alone)
    if not ways:
        raise OpenArmError(Code.UNREACHABLE, f"a push would not help either: {faults[-1]}")
    return ways


async def _taker(task: Task, found: Sighting, end: Array, ways: Mapping[str, tuple[GraspCandidate, ...]]) -> str:
    """The arm that grasps the object there, by its grasps where the object stands now."""
    feasible, fault = FeasibilityCheck(task.robot, task.context), OpenArmError(Code.UNREACHABLE, "no arm")
    there, step = seen_at(found, end), np.array([*(end - found.target.p_base[:2]), 0.0])
    for arm in (arm for arm in task.context.arm_order("auto", float(end[1])) if arm in ways):
        offered = tuple(displaced(one, step) for one in ways[arm])
        refusal = await feasible.refusal(arm, there, now=found, offered=offered)
        if refusal is None:
            return arm
        fault = refusal
    raise fault


async def _push_to(task: Task, found: Sighting, end: Array, taker: str) -> Push:
    """The other arm is asked first: it comes from the other side."""
    config, robot, faults = task.context.config, task.robot, list[str]()
    for arm in sorted(robot.description.arm_names, key=lambda arm: arm == taker):
        ways = push_ways(found.target, end, config, closed_hand(robot.description, arm), task.context.hand)
        if not ways:
            faults.append(f"{arm} hand: {found.target.label!r} is too thin for it, or would tip over")
            continue
        with refusals(faults):
            plan = await robot.plan_push(arm, ways, found, target_boxes(found.target, ways[0], config))
            return Push(arm, found.target.p_base[:2], end, ways[plan.chosen], plan, "into reach")
    raise OpenArmError(Code.UNREACHABLE, f"no hand comes behind it: {'; '.join(faults)}")
