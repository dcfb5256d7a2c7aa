# SPDX-License-Identifier: Apache-2.0
"""Find an object and plan how to grasp and place it: frames until it can be trusted, then both arms. Base frame, m."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from openarm_common.detection import Detection, gap
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.hand import HandParts
from openarm_common.wanted import EASIEST, EASIEST_LEFT, EASIEST_RIGHT, describe
from openarm_grasp.evidence.verdicts import Verdict
from openarm_grasp.perception.detections import (
    NEXT_TO,
    Frame,
    Sighting,
    UntrustedError,
    distance_to,
    in_view,
    on_table,
)
from openarm_grasp.perception.sightings import object_points
from openarm_grasp.planning import retries
from openarm_grasp.planning.arms import out_of_reach, sides
from openarm_grasp.planning.candidates import GraspCandidate, PlaceTarget, little_turns, shorter
from openarm_grasp.planning.neighbours import crowded, standing_boxes
from openarm_grasp.planning.options import NO_WAY, NoWayError, not_placeable, options_of, planned
from openarm_grasp.planning.place import check_position, free_spots, other_grasps, place_targets, spots_on
from openarm_grasp.requests.confirm import GRASP, PLACE, agree, outdated
from openarm_grasp.requests.request import GraspRequest
from openarm_grasp.requests.states import State
from openarm_grasp.requests.task import Grasp
from openarm_grasp.robot.interface import Planned
from openarm_grasp.robot.skills import reraise_stop
from openarm_grasp.sampling.slabs import EASED, eased

if TYPE_CHECKING:
    from openarm_grasp.strategies.run import Run

#: Share of the straight way to a grasp that is tried where none reaches.
_SHORTEST = 0.35
#: A grasp that costs so much more than another for its distance from the weight comes after it, on any line.
_FAR_FROM_WEIGHT = 0.8
#: The middle of two things is that of the one where it is no farther off, m; things so near to them are a heap, m.
_ONE_MIDDLE, _AMONG = 0.01, 0.15
#: What is seen this near to the height of the table is table, m.
_TABLE = 0.015
#: An object that is observed so may be trusted in the next frames.
_NOT_TRUSTED = (Code.NOTHING_DETECTED, Code.UNKNOWN_OBJECT, Code.STALE_DATA)


class NoGraspError(OpenArmError):
    """No grasp, or no place for what is grasped, could be planned."""


async def find_grasp(run: Run, why: str) -> tuple[Grasp, Planned | None, str]:
    """Find an object and plan how to grasp it; without a plan, for what the hand holds already.

    Returns:
        The grasp, its trajectories, and why it was chosen.

    Raises:
        OpenArmError: When the object is refused.
    """
    while True:
        sighting = await detect(run, why)
        if run.kept is not None:
            places = grasp_of(run, run.kept.arm, sighting, run.kept.candidate).places
            grasp = run.grasp = replace(run.kept, sighting=sighting, places=places)
            why = f"the {grasp.arm} hand holds {run.label!r}; {len(grasp.places)} ways to place it"
            if run.request.dry_run:
                _, target = await plan_place(run, grasp, grasp.places, why)
                why = f"place {target}"
            return grasp, None, why
        try:
            return await plan(run, sighting)
        except NoGraspError as error:
            run.fail(error.code, error.message)
            run.plans_failed += 1
            # next to another request that is carried out there may be other things to do
            if run.plans_failed >= run.config.limits.plan_attempts or len(run.task.session.runs) > 1:
                raise
            run.forget()
            why = error.message


async def detect(run: Run, why: str) -> Sighting:
    """Clear the camera's view and observe until an object can be trusted.

    Raises:
        OpenArmError: When there is none after the rounds that are allowed, or no frame at all.
    """
    while True:
        run.enter(State.DETECT, why)
        await _clear_view(run)
        seen = await run.robot.observe(run.config.detect.frames)
        text = f"in view: {describe([d for frame in seen for d in frame.detections])}"
        if run.kept is not None:
            text = f"holding {run.label!r}; {text}"
        elif missing := _missing(run, seen):
            run.enter(State.IDLE, run.missed_round(missing.code, missing.message))
            why = "the next frame has come"
            try:
                await run.robot.observe(1)
            except OpenArmError as error:
                reraise_stop(error)
                why = error.message  # the next round observes all the same
            continue
        run.enter(State.TRANSFORM, text)
        run.robot.stop_observing()
        try:
            return _locate(run, seen)
        except OpenArmError as error:
            if error.code not in _NOT_TRUSTED:
                raise
            why = run.missed_round(error.code, error.message)
            run.forget()


def _missing(run: Run, seen: Sequence[Frame]) -> OpenArmError | None:
    """Why nothing in view is what is asked for; None when something is."""
    try:
        in_view(seen, run.request.label)
    except OpenArmError as error:
        return error if error.code in (Code.NOTHING_DETECTED, Code.UNKNOWN_OBJECT) else None
    return None


async def _clear_view(run: Run) -> None:
    """Send the arms home that may hide something; one that finds no way home stays where it is.

    A dry run moves nothing, nor does what is not confirmed yet.
    """
    if run.request.dry_run or run.request.confirm or run.missed > 0 or run.plans_failed > 0:
        return
    kept, robot = run.task.session.kept, run.robot
    # A hand that holds something stays where it is; it may be among the objects.
    below = run.context.clear_of_objects if run.kept is None else -inf
    for arm in (arm for arm in robot.description.arm_names if arm not in kept):
        try:
            await robot.go_home((arm,), back_off_below=below)
        except OpenArmError as error:
            if error.code not in NO_WAY:
                raise
            robot.warn(f"{error.message}; it stays where it is")


def _locate(run: Run, frames: Sequence[Frame]) -> Sighting:
    """The object and its neighbours in frames of the base frame.

    Raises:
        OpenArmError: One of `_NOT_TRUSTED`, when it cannot be trusted.
    """
    limits, top_z, kept = run.config.detect, run.context.table.top_z, run.kept
    if kept is not None:
        newest, target = frames[-1], kept.sighting.target
        hand = run.robot.T_base_tcp(kept.arm)[:2, 3]
        reach = float(np.linalg.norm(target.size[:2]))
        # what hangs in the hand may be seen there
        others = (d for d in newest.detections if d.label != target.label or distance_to(d, hand) > reach)
        sighting = replace(kept.sighting, others=_standing(others, top_z), t_ns=newest.t_ns)
    else:
        try:
            found = _beside_others(run).find(frames, limits)
        except UntrustedError as error:
            run.seen_at = error.where
            raise
        run.seen_at = found.target.p_base
        target = on_table(found.target, top_z)
        others = run.task.session.staying(run, found.others)
        sighting = replace(found, target=target, others=_standing(others, top_z))
    age = (run.robot.now_ns - sighting.t_ns) * 1e-9
    if age > limits.max_age:
        text = f"the newest detection is {age:.2f} s old, expected at most {limits.max_age:g} s"
        raise OpenArmError(Code.STALE_DATA, text)
    run.findings.sighting = sighting
    if kept or run.size is None or any(d.label == sighting.target.label for d in sighting.others):
        run.size = sighting.target.size
    return sighting


def _beside_others(run: Run) -> GraspRequest:
    """The request, for what no other one is at.

    For the easiest an arm by name takes the outermost easy one on its side: the arms come together last.
    """
    request, shoulders = run.task.session.excluding_others(run, run.request), run.context.shoulders
    side = sides(request.arm, shoulders) if request.arm in shoulders else ()
    if len(side) != 1 or request.selection != EASIEST:
        return request
    return replace(request, selection=EASIEST_LEFT if side[0] > 0.0 else EASIEST_RIGHT)


def _standing(found: Iterable[Detection], table_z: float) -> tuple[Detection, ...]:
    """What stands on the table; what is flat on it is no obstacle."""
    return tuple(on_table(d, table_z) for d in found if d.top > table_z + 0.005)


async def plan(run: Run, sighting: Sighting) -> tuple[Grasp, Planned, str]:
    """Plan the grasp, and the place where one is asked for or nothing may move; with each arm that may reach.

    Raises:
        NoGraspError: the reason of each arm.
        OpenArmError: When the place is not one, or the object does not fit into a hand.
    """
    request, target, table = run.request, sighting.target, run.context.table
    if request.place is not None:
        check_position(request.place, target, sighting.others, table)
    if request.place_on:
        spots_on(request.place_on, sighting, run.config.place)
    run.options, why = {}, ""
    arms = run.context.arm_order(request.arm, float(target.p_base[1]))
    arms = retries.arms_to_try(arms, run.failed)
    ways: dict[str, retries.Ways] = {}
    widths = {arm: run.context.config_of(arm).approach.max_width for arm in arms}
    for arm in arms:
        try:
            ways[arm] = run.ways(arm, sighting)
        except OpenArmError as error:
            too_wide = error.code is Code.TOO_WIDE and (crowded(sighting) or widths[arm] < max(widths.values()))
            if error.code is not Code.IN_COLLISION and not too_wide:
                raise  # it fits into no hand wherever it stands; what seems one thing in a crowd may be several
            run.findings.refusals[arm] = Verdict(error.code, error.message)
    where = "({:.3f}, {:.3f}, {:.3f}) m".format(*target.p_base)
    for (note, tier), short, run.arm in product(_tiers(ways), (False, True), ways):
        offered = tier[run.arm]
        if short:
            refused = run.findings.refusals.get(run.arm)
            far = refused is not None and refused.code is Code.UNREACHABLE and not run.findings.place_refused
            offered = _farther(offered, run.context.parts(run.arm)) if far else ()
        if not offered:
            continue
        # also those far from the weight, whether they are needed or not
        options = options_of(run.arm, (*ways[run.arm].fresh, *offered), target, run.context.config_of(run.arm).approach)
        run.options |= {key: option for key, option in options.items() if key not in run.options}
        text = f"{why}; trying the {run.arm} arm" if why else f"{target.label!r} stands at {where}"
        text += f"; {len(offered)} ways to grasp it{note}"
        text += " on shorter lines" if short else ""
        try:
            return await _plan_with(run, sighting, offered, text)
        except NoGraspError as error:
            run.findings.refusals[run.arm] = Verdict(error.code, error.message)
            why = error.message
    run.arm = ""
    refusals = run.findings.refusals
    codes = {refusal.code for refusal in refusals.values()}
    why = "; ".join(f"{arm} arm: {v.reason.removeprefix(f'{arm} arm: ')}" for arm, v in refusals.items())
    if codes == {Code.UNREACHABLE} and not run.findings.place_refused:
        run.enter(State.PLAN, "out of reach; asking how near the arms come")
        try:
            distances = await run.robot.reach(arms, run.offered[0].T_base_tcp)
        except OpenArmError as error:
            reraise_stop(error)
            distances = {}
        why = f"{out_of_reach(f'{target.label!r} at {where}', distances)} ({why})"
    raise NoGraspError(codes.pop() if len(codes) == 1 else Code.NO_PLAN, why)


def _tiers(ways: Mapping[str, retries.Ways]) -> tuple[tuple[str, Mapping[str, tuple[GraspCandidate, ...]]], ...]:
    """Grasps by arm, in the order in which they are tried, with a note for the status.

    Those near the weight of the object, on any line; those far from it; those that would repeat a failed one.
    """
    best = max((retries.weight_cost(one) for way in ways.values() for one in way.fresh), default=0.0)

    def split(way: retries.Ways, *, far: bool) -> tuple[GraspCandidate, ...]:
        return tuple(one for one in way.fresh if (retries.weight_cost(one) < best - _FAR_FROM_WEIGHT) is far)

    return (
        ("", {arm: split(way, far=False) for arm, way in ways.items()}),
        (" far from its weight", {arm: split(way, far=True) for arm, way in ways.items()}),
        ("; all that is left has failed before", {arm: way.repeats for arm, way in ways.items()}),
    )


def _farther(offered: Sequence[GraspCandidate], hand: HandParts) -> tuple[GraspCandidate, ...]:
    """The same grasps as arms come farther: on shorter lines, those of clouds with the hand turned a little, too."""
    short = [shorter(one) for one in offered]
    shapes = [one for one in short if one.apertures is not None]  # what is no box gives way to pads that are not square
    every = [*short, *little_turns(shapes, hand), *(shorter(one, _SHORTEST) for one in offered if one.apertures)]
    return tuple(sorted(every, key=lambda one: -one.score))


async def _plan_with(
    run: Run, sighting: Sighting, offered: tuple[GraspCandidate, ...], why: str
) -> tuple[Grasp, Planned, str]:
    """Plan with one arm; a grasp after which the object cannot be placed is replaced by another."""
    arm, request = run.arm, run.request
    while True:
        run.offered = offered
        run.enter(State.PLAN, why)
        try:
            found = await run.robot.plan_grasp(arm, offered, sighting)
        except OpenArmError as error:
            reraise_stop(error)
            refusals = error.refusals if isinstance(error, NoWayError) else {}
            run.options = planned(run.options, arm, offered, -1, refusals, ())
            raise NoGraspError(error.code, error.message) from error
        run.options = planned(run.options, arm, offered, found.chosen, found.refusals, found.limit_margins)
        candidate = offered[found.chosen]
        # Also without a place that is asked for: no free spot is a reason not to lift.
        grasp = run.grasp = grasp_of(run, arm, sighting, candidate)
        chosen = f"grasp {candidate.id} with the {arm} arm"
        # a hand that leans may find no way to a spot among other things, nor one that passes what it has cleared
        raised = sighting.target.bottom > run.context.table.top_z + _TABLE
        among = (grasp.of_cloud or raised) and bool(sighting.others) and request.phase == "all"
        shown = request.dry_run or (request.confirm and request.phase == "all")
        if request.place is None and not (request.place_on or among or shown):
            return grasp, found, chosen
        run.enter(State.PLAN, f"{chosen}; planning the place")
        try:
            # From the end of the lift; PLACE plans from where the arm then is.
            end = await run.robot.plan_place(arm, grasp.places, sighting, candidate, found.retreat)
        except OpenArmError as error:
            reraise_stop(error)
            run.findings.place_refused = True
            why = f"it could grasp, but not place: {error.message.removeprefix(f'{arm} arm: ')}"
            # Held by other faces or leaning otherwise, it may come to stand where it is wanted.
            left = other_grasps(offered, candidate, error.code, sighting.target, request.place_yaw)
            dropped = [c for c in offered if c not in left]
            run.options = not_placeable(run.options, arm, dropped, candidate, Verdict(error.code, why))
            run.grasp = None
            if not left:
                raise NoGraspError(error.code, why) from error
            offered, why = left, f"{why}; trying another grasp"
            continue
        run.place_target = grasp.places[end.chosen]
        run.place_plan = end if request.confirm and request.phase == "all" else None
        return grasp, found, f"{chosen}, place {run.place_target}"


def grasp_of(run: Run, arm: str, sighting: Sighting, candidate: GraspCandidate) -> Grasp:
    """A grasp with the ways to put the object down: where it was asked for, or on free spots."""
    request, target, others, table = run.request, sighting.target, sighting.others, run.context.table
    if request.place_on:
        spots = spots_on(request.place_on, sighting, run.config.place)
    elif request.place is not None:
        spots = (run.context.on_table(check_position(request.place, target, others, table)),)
    else:
        # what a hand has kept because it could not be put down has to go somewhere
        every, shoulders = run.kept is not None, run.context.shoulders
        seen = [cloud.points[np.abs(cloud.points[:, 2] - table.top_z) < _TABLE] for cloud in sighting.clouds[-1:]]
        flat = free_spots(
            arm, target, others, run.config, shoulders, request.place_choices, seen=next(iter(seen), None), every=every
        )
        spots = tuple(map(run.context.on_table, flat))
    places = place_targets(target, candidate, spots, run.config, run.used_places, yaw=request.place_yaw)
    adjacent = tuple(d for d in sighting.beside if d.measured and gap(d, target) < NEXT_TO)
    return Grasp(arm, sighting, candidate, places, adjacent=adjacent)


def regrasped(run: Run, grasp: Grasp, sighting: Sighting) -> Grasp:
    """A grasp of an object of which other points turned out to be its own."""
    candidate, label, table_gap = grasp.candidate, sighting.target.label, run.config.approach.table_gap
    if candidate.held:
        made = standing_boxes(label, object_points(sighting.clouds[-1:]), sighting.target.bottom, table_gap)
        # up to a column too high, besides
        candidate = replace(candidate, held=tuple(eased(box, 2.0 * EASED) for box in made))
    run.findings.sighting, run.place_plan = sighting, None
    before, now, merged = grasp.sighting, sighting.target, tuple[Detection, ...]()
    shift = float(np.linalg.norm((now.p_base - before.target.p_base)[:2]))
    if shift > _ONE_MIDDLE and any(gap(d, now) < _AMONG for d in sighting.beside):
        merged = tuple(d for d in before.others if d.measured and all(d is not one for one in sighting.others))
    return replace(grasp_of(run, grasp.arm, sighting, candidate), closed=grasp.closed, merged=merged)


async def plan_place(run: Run, grasp: Grasp, ways: tuple[PlaceTarget, ...], why: str) -> tuple[Planned, PlaceTarget]:
    """Plan from where the arm is how to put the object down in one of these ways, unless that is planned already."""
    run.enter(State.PLACE, why)
    run.robot.stop_observing()
    ready, run.place_plan = run.place_plan, None
    if ready is not None:
        why = await outdated(run.robot, (ready,), ready.start, run.config.confirm.joints)
        if not why:
            return ready, ways[ready.chosen]
        run.enter(State.PLACE, f"the place has to be planned again: {why}")
    while True:
        plan = await run.robot.plan_place(
            grasp.arm, ways, grasp.sighting, grasp.candidate, turned=grasp.turned, in_part=grasp.in_part
        )
        target = ways[plan.chosen]
        why = await agreed(run, State.PLACE, grasp, f"place {target} with the {grasp.arm} arm", place=plan)
        if not why:
            return plan, target
        run.enter(State.PLACE, why)


async def agreed(
    run: Run, state: State, grasp: Grasp, why: str, plan: Planned | None = None, place: Planned | None = None
) -> str:
    """Let a person confirm what is planned; returns why it has to be planned again, "" when it has not."""
    plans = [(names, part) for names, part in ((GRASP, plan), (PLACE, place)) if part is not None]
    standing = (grasp.sighting.target, *grasp.sighting.others) if state is State.PLAN else ()
    return await agree(
        run.task, grasp.arm, why, plans, lambda text, shown: run.enter(state, text, shown), standing=standing
    )
