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
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_common.wanted import EASIEST
from openarm_grasp.context import GraspContext
from openarm_grasp.perception.detections import Sighting, apart
from openarm_grasp.perception.sightings import seen_at
from openarm_grasp.planning.candidates import GraspCandidate, displaced
from openarm_grasp.planning.feasibility import FeasibilityCheck
from openarm_grasp.planning.neighbours import cornered, crowded
from openarm_grasp.planning.offers import offers
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.planning.pushes import closed_hand, destinations, direction, push_ways, sweeps
from openarm_grasp.requests.confirm import PUSH, agree
from openarm_grasp.requests.request import Feasible, GraspOutcome
from openarm_grasp.requests.task import Task
from openarm_grasp.robot.interface import Planned
from openarm_grasp.robot.skills import STOPS, reraise_stop
from openarm_grasp.strategies.pick_and_place import pick_and_place

#: Lines through a crowd that are planned at most, by arm and length.
_SWEEPS = 5
#: Turns of a hand that meets things of any shape, deg.
_TURNS = (0.0, 30.0, -30.0)
#: What moves by a smaller share of a push than this has not gone along; directions so near (cosine) are the same.
_FOLLOWS, _SAME_WAY = 1.0 / 3.0, 0.5


@dataclass(frozen=True)
class Push:
    """A push that was planned.

    Attributes:
        arm: Whose hand.
        start: (2,) where the object stands.
        end: (2,) where it should stand afterwards.
        way: How the hand stands behind it, and its line.
        plan: The trajectories.
        why: What it is good for.
    """

    arm: str
    start: Array
    end: Array
    way: GraspCandidate
    plan: Planned
    why: str

    def __str__(self) -> str:
        """Sentence for the status."""
        (x0, y0), (x1, y1) = self.start, self.end
        return f"the {self.arm} hand pushes it from ({x0:.3f}, {y0:.3f}) to ({x1:.3f}, {y1:.3f}) m, {self.why}"

    @property
    def ahead(self) -> Array:
        """(2,) direction."""
        return direction(self.end - self.start)

    def moves(self, before: Detection, after: Detection) -> bool:
        """Whether the object went along, and did not stay or slide past the hand."""
        return apart(before, after) >= _FOLLOWS * float(np.linalg.norm(self.end - self.start))


async def push(task: Task) -> GraspOutcome | None:
    """Push an object that no arm can grasp where it is into reach, observe, and pick it; several times if need be."""
    refused = task.outcome
    if refused is None or task.findings.place_refused:
        return None
    found = task.findings.need_sighting()
    if _easiest(task) and crowded(found) and not found.target.kind:
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
        await agree_to_push(task, planned, found)
        try:
            pushed, observed = await carry_out_push(task, planned, found, number)
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


def _is_open(way: Array, avoid: Sequence[Array]) -> bool:
    """Whether (2,) leads elsewhere than directions to avoid."""
    return all(float(direction(way) @ one) < _SAME_WAY for one in avoid)


def _easiest(task: Task) -> bool:
    return EASIEST in task.request.label.casefold().split()


def _may_sweep(task: Task, found: Sighting) -> bool:
    """Whether the object may be pushed with what the hand meets there; what comes of it is not known beforehand.

    It stands in a crowd; or it leaves no room for a hand and has corners, so that it lies badly, or is several things.
    For the easiest object nothing else is moved, and what fits into no hand is pushed in phase aside alone.
    """
    code = None if task.outcome is None else task.outcome.code
    if task.request.dry_run or _easiest(task) or code is Code.TOO_WIDE:
        return False
    return crowded(found) or (code is Code.IN_COLLISION and cornered(found))


async def _plan(task: Task, found: Sighting, avoid: Sequence[Array]) -> Push:
    """A push into reach; in a crowd, where there is none, one through it.

    Args:
        task: That it is a part of.
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
    ends = [end for end in destinations(found.target, found.others, task.context) if _is_open(end - start, avoid)]
    ways = _ways_alone(task.context, found) if ends else {}
    for end in ends:
        x, y = end
        try:
            return await _push_to(task, found, end, await _taker(task, found, end, ways))
        except OpenArmError as error:
            if error.code not in NO_WAY:
                raise
            faults.append(f"to ({x:.3f}, {y:.3f}) m: {error.message}")
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
    fault = ""
    for arm in context.shoulders:
        try:
            ways[arm] = offers(context, arm, alone)
        except OpenArmError as error:
            if error.code not in NO_WAY:
                raise
            fault = error.message
    if not ways:
        raise OpenArmError(Code.UNREACHABLE, f"a push would not help either: {fault}")
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
        try:
            plan = await robot.plan_grasp(arm, ways, found)
        except OpenArmError as error:
            if error.code not in NO_WAY:
                raise
            faults.append(error.message)
            continue
        return Push(arm, found.target.p_base[:2], end, ways[plan.chosen], plan, "into reach")
    raise OpenArmError(Code.UNREACHABLE, f"no hand comes behind it: {'; '.join(faults)}")


async def plan_sweep(
    task: Task, found: Sighting, avoid: Sequence[Array], lengths: Sequence[float], *, longest: bool = False
) -> Push:
    """Find a line that pushes an object along with what it meets.

    Args:
        task: That it is a part of.
        found: The object and its neighbours.
        avoid: (2,) directions in which a push did not move it, or from which one has.
        lengths: Of its way, m.
        longest: Of lines that move as many things the longest is tried first, else short ones that lead outwards.

    Raises:
        OpenArmError: UNREACHABLE, with the reason, when there is none; what the robot raises.
    """
    context, robot, faults = task.context, task.robot, list[str]()
    start = found.target.p_base[:2]
    for arm in context.arm_order("auto", float(start[1])):
        hand = closed_hand(robot.description, arm)
        lines = (
            one for one in sweeps(found, hand, context, lengths, longest=longest) if _is_open(one.freed - start, avoid)
        )
        for sweep in islice(lines, _SWEEPS * len(lengths)):
            ways = push_ways(sweep.met, sweep.end, context.config, hand, context.hand, _TURNS)
            if not ways:
                faults.append(f"{arm} hand: what stands there is too thin for it")
                continue
            try:
                plan = await robot.plan_sweep(arm, ways, replace(found, others=sweep.rest), sweep.heap)
            except OpenArmError as error:
                if error.code not in NO_WAY:
                    raise
                faults.append(error.message)
                continue
            return Push(arm, start, sweep.freed, ways[plan.chosen], plan, "through what is near it")
    why = f"{faults[0]} ({len(faults) - 1} other lines refused)" if faults else "there is no room around it"
    raise OpenArmError(Code.UNREACHABLE, f"no line pushes it out of what is near it: {why}")


async def agree_to_push(task: Task, planned: Push, found: Sighting) -> None:
    """Let a person confirm a push, where that is asked for.

    Raises:
        OpenArmError: STALE_DATA, when the scene has changed meanwhile; CANCELLED, when it is rejected.
    """
    standing = (found.target, *found.others)
    changed = await agree(task, planned.arm, str(planned), [(PUSH, planned.plan)], task.note, standing)
    if changed:
        raise OpenArmError(Code.STALE_DATA, f"{changed.removesuffix('; planning again')}; ask again")


async def carry_out_push(task: Task, planned: Push, found: Sighting, number: int) -> tuple[Sighting, str]:
    """Push, go home and observe; returns the object as it was observed, and a sentence.

    Args:
        task: That it is a part of.
        planned: The push.
        found: The object and its neighbours before.
        number: Of the push, 1-based.

    Raises:
        OpenArmError: EXECUTION_FAILED or HAND_COLLISION, when the hand did not do it; what observing raises, when the
            object is not seen any more.
    """
    config, robot, arm, way = task.context.config, task.robot, planned.arm, planned.way
    task.attempts = max(task.attempts, 1)
    task.note(f"push {number} of at most {config.push.most}: {planned}")
    T_base_back, fault, short = way.T_base_tcp, None, ""
    try:
        await _go_behind(task, planned)
        try:
            await robot.follow(arm, planned.plan.retreat, "push")
        except OpenArmError as error:
            if error.code is not Code.EXECUTION_FAILED:
                raise
            short = f"; {error.message}"  # what was pushed has moved all the same: that is observed
        T_base_back = se3.make(p=-config.push.gap * direction(way.retreat_offset)) @ robot.T_base_tcp(arm)
    except OpenArmError as error:
        fault = error
    if fault is None or fault.code not in STOPS:
        try:
            await _go_home(task, arm, T_base_back)
        except OpenArmError as error:
            fault = fault or error
    if fault is not None:
        raise OpenArmError(fault.code, f"push {number}: {fault.message}")
    try:
        frames = (await robot.observe_in_base(config.detect.frames)).frames
    except OpenArmError as error:
        text = f"push {number}: {found.target.label!r} was not seen since: {error.message}"
        raise OpenArmError(error.code, text) from error
    there = seen_at(found, planned.end)
    pushed = task.request.about(there).find(frames, config.detect)
    x, y = p = pushed.target.p_base[:2]
    moved, off = (float(np.hypot(*(p - q))) for q in (planned.start, planned.end))
    text = (
        f"push {number} by the {arm} hand moved it {moved * 1e3:.0f} mm to ({x:.3f}, {y:.3f}) m, {off * 1e3:.0f} mm"
        f" from its destination{short}"
    )
    task.note(text)
    return pushed, text


async def _go_behind(task: Task, planned: Push) -> None:
    """Close the hand and bring it behind the object."""
    arm, robot, T_base_tcp = planned.arm, task.robot, planned.way.T_base_tcp
    what = "move behind the object"
    await robot.follow_and_grip(arm, planned.plan.transfer, what, "close")
    await robot.follow(arm, planned.plan.approach, "move down behind the object")
    error = (await robot.measure(arm, 0.0, T_base_tcp)).tcp_error
    if error > task.context.config.held.max_tcp_error:
        text = f"the {arm} hand stopped {error * 1e3:.0f} mm from its place behind the object"
        raise OpenArmError(Code.HAND_COLLISION, text)


async def _go_home(task: Task, arm: str, T_base_back: Array) -> None:
    """Leave the object the way the hand came, and go home."""
    try:
        await task.robot.move_linear(arm, T_base_back, "leave the object")
    except OpenArmError as error:
        reraise_stop(error)
        task.robot.warn(error.message)  # the free path home may still be there
    await task.robot.go_home((arm,), back_off_below=task.context.clear_of_objects)
