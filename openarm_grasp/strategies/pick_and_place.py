# SPDX-License-Identifier: Apache-2.0
"""Pick an object with one arm and place it: detect, plan, approach, close, lift, place, retreat, verify.

`_attempts` is the strategy from beginning to end; the functions below it are its steps, in their order. A step that
does not succeed raises. What fails with the arm ends the attempt: the hand goes home, and the next attempt observes
again and prefers another grasp. Success is said in one place, `succeeded`, from the verdicts on gripper and camera.
Base frame, m.
"""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.evidence.camera import heavier_end, judge_gone, judge_held, judge_unmoved
from openarm_grasp.evidence.verdicts import CameraVerdict, HandVerdict, Verdict, judge_lift
from openarm_grasp.perception.clouds import lifted, risen_points
from openarm_grasp.perception.detections import Frame, apart
from openarm_grasp.perception.sightings import first_points, object_points, points_around
from openarm_grasp.planning.candidates import PlaceTarget
from openarm_grasp.planning.neighbours import columns
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.planning.place import other_spots, place_targets
from openarm_grasp.requests.request import Feasible, GraspOutcome, GraspRequest, Proof
from openarm_grasp.requests.states import Hand, State
from openarm_grasp.requests.task import Grasp, Placed, Task
from openarm_grasp.robot.interface import Planned
from openarm_grasp.robot.skills import STOPS, reraise_stop
from openarm_grasp.strategies.find import agreed, find_grasp, grasp_of, plan_place, regrasped
from openarm_grasp.strategies.retreat import retreat, still_held
from openarm_grasp.strategies.run import Run
from openarm_grasp.strategies.second_look import second_look
from openarm_grasp.strategies.verify import verify

#: After these another observation would wait for frames that do not come.
_BLIND = (Code.NOT_READY, Code.STALE_DATA, Code.TIMEOUT)
#: Frames that must not show the object in its old place after the lift: a detector may miss it in one.
_LIFT_FRAMES = 2
#: The camera looks from when the hand is so near to the top of the lift, m.
_ARRIVING = 0.005
#: What meets something on its way down to its place is let go this high above it, m; what has turned, anywhere.
_MET_AT = 0.015


class ObjectKeptError(OpenArmError):
    """The object can be put down nowhere: the arm holds, and the hand keeps it."""


# --- the strategy
async def pick_and_place(task: Task, request: GraspRequest) -> GraspOutcome:
    """Carry out a request with one arm, from beginning to end.

    Args:
        task: Task that it is a part of.
        request: Request.

    Raises:
        OpenArmError: INVALID_ARGUMENT or NOT_READY, when the request is not taken; TIMEOUT, when no time is left.
    """
    request, robot, session = task.in_time(request), task.robot, task.session
    session.check_hands(robot, request)
    request.check(task.robot.description.arm_names)
    kept = session.to_place(request) if request.phase == "place" else None
    run = Run(task, replace(request, label=kept.sighting.target.label) if kept else request, kept)
    robot.set_deadline(request.timeout)
    robot.set_speed(request.velocity_scale)
    try:
        outcome = await _attempts(run)
    except OpenArmError as error:
        if run.tried and not run.holding and error.code not in (*STOPS, *_BLIND):
            await _see_where_it_is(run)
        late = error.code is Code.CANCELLED and 0.0 < request.timeout <= (robot.now_ns - run.began_ns) * 1e-9
        outcome = run.answer(Code.TIMEOUT if late else error.code, error.message)
    except Exception as error:
        # A defect of this program: the request must still be answered, and the next one served.
        robot.warn(traceback.format_exc())
        text = f"{type(error).__name__}: {error}; see the log of the grasp node"
        outcome = run.answer(Code.INTERNAL, text)
    if run.holding and run.grasp is not None:
        session.kept[run.arm] = run.grasp
    elif not run.holding and not request.dry_run:
        session.kept.pop(run.arm, None)
    task.outcome, task.findings, task.attempts = outcome, run.findings, max(task.attempts, outcome.attempts)
    return run.end(outcome)


async def _attempts(run: Run) -> GraspOutcome:
    why = f"asked for {run.request.label or 'any object'!r}"
    why += f"; {run.request.why}" if run.request.why else ""
    while True:
        grasp, plan, why = await find_grasp(run, why)
        if run.request.dry_run:
            return run.answer(Code.OK, f"can be done: {why}", Feasible(why))
        if plan is not None and (changed := await agreed(run, State.PLAN, grasp, why, plan, run.place_plan)):
            run.forget()
            why = changed
            continue
        placed = None
        try:
            if plan is not None:
                grasp, plan, why = await approach(run, grasp, plan, why)
                grasp, why = await close(run, grasp, why)
                grasp, gripper, camera, why = await lift(run, grasp, plan, why)
                if run.request.phase == "pick":
                    return succeeded(run, f"{why}; the {run.arm} hand keeps it", hand=gripper, camera=camera)
            placed = await place(run, grasp, why)
            run.enter(State.RESET, placed.reason)
        except ObjectKeptError:
            raise
        except OpenArmError as error:
            reraise_stop(error)
            grasp = run.grasp or grasp  # corrected by the second observation
            run.fail(error.code, error.message)
            run.enter(State.RESET, error.message)
        frames = await retreat(run, grasp, placed)
        if placed is not None and placed.failure is None:
            seen = await verify(run, grasp, placed, frames)
            if seen.ok:
                text = f"{seen.reason}, placed by the {run.arm} arm"
                return succeeded(run, text, hand=placed.gripper, camera=seen)
            run.failure = seen
        why = run.start_again(grasp, placed)
        run.robot.set_speed(run.request.velocity_scale, run.tried)


async def _see_where_it_is(run: Run) -> None:
    """Note where an object is that an arm has moved in vain; what is not seen is where it was seen last."""
    with suppress(OpenArmError):  # what went wrong with the arm says more
        frames = await run.robot.look(run.config.detect.frames)
        run.seen_at = run.request.find(frames, run.config.detect).target.p_base


def succeeded(run: Run, message: str, *, hand: HandVerdict, camera: CameraVerdict) -> GraspOutcome:
    """Say that what was asked for has happened: the only place that can.

    Args:
        run: The request.
        message: A sentence on how it was done.
        hand: Verdict that the hand held the object, or pushed it along.
        camera: Verdict that the object has left its place, or is seen where it was to be placed.

    Raises:
        OpenArmError: INTERNAL, when one of them says otherwise.
    """
    return run.answer(Code.OK, message, Proof(hand, camera))


# --- approach
async def approach(run: Run, grasp: Grasp, plan: Planned, why: str) -> tuple[Grasp, Planned, str]:
    """Bring the open hand around the object.

    A hand that carries a camera observes the object again from the pre-grasp. Before the last straight part the camera
    over the table observes whether the object is still where it was: the camera on the hand is not everywhere, and time
    has passed.

    Returns:
        The grasp and its trajectories, corrected where the second observation said so, and how well it was reached.

    Raises:
        OpenArmError: GRASP_MISSED, when the object has moved; HAND_COLLISION, when the hand leaves its straight line or
            stops short of the grasp.
    """
    arm, config, robot = grasp.arm, run.config, run.robot
    run.tried += 1
    run.enter(State.MOVE_TO_PREGRASP, why)
    what = "move to the pre-grasp"
    camera = run.context.looks.get(arm, "")
    if camera:
        robot.expect_near(camera)
    await robot.follow_and_grip(arm, plan.transfer, what, "open", grasp.candidate.opened)
    why = "the open hand is before the object"
    if camera:
        grasp, plan, why = await _correct(run, grasp, plan, camera)
    run.enter(State.MOVE_TO_GRASP, why)
    target = grasp.sighting.target
    still, why = judge_unmoved(first_points(grasp.sighting), await robot.observe(1))
    if not still and run.suspected is not None and apart(target, run.suspected) < config.detect.agree_within:
        still, why = True, f"{why}; so it seemed before, and it had not: the hand hides a part of it"
    run.suspected = target
    if not still:
        raise OpenArmError(Code.GRASP_MISSED, why)
    run.enter(State.MOVE_TO_GRASP, why)
    robot.stop_observing()
    run.hand = Hand.AT_OBJECT
    c = grasp.candidate
    p = c.T_base_tcp[:3, 3]
    into = plan.transfer if plan.approach is None else plan.approach
    await robot.follow(arm, into, "move to the grasp", line=(p + c.approach_offset, p))
    error, limit = (await robot.measure(arm, c.width, c.T_base_tcp)).tcp_error, config.held.max_tcp_error
    if error > limit:
        text = f"the hand stopped {error * 1e3:.1f} mm from the grasp, expected at most {limit * 1e3:.0f} mm"
        raise OpenArmError(Code.HAND_COLLISION, text)
    return grasp, plan, f"the hand is at the grasp, off by {error * 1e3:.1f} mm"


async def _correct(run: Run, grasp: Grasp, plan: Planned, camera: str) -> tuple[Grasp, Planned, str]:
    """Observe with the camera on the hand, and plan to where the object is seen from there.

    Whatever keeps the second observation from helping, the grasp goes on with what is known.
    """
    config, robot = run.config, run.robot
    run.enter(State.MOVE_TO_PREGRASP, f"the open hand is before the object; observing with the {camera} camera")
    least = config.confirm.correction if run.request.confirm else config.near.least
    corrected, why = await second_look(run, grasp, camera, least)
    if corrected is None:
        return grasp, plan, why
    if grasp.of_cloud:  # held elsewhere, so that the hand stands elsewhere at the place
        corrected = grasp_of(run, grasp.arm, corrected.sighting, corrected.candidate)
    run.findings.sighting, run.offered = corrected.sighting, (corrected.candidate,)
    run.enter(State.MOVE_TO_PREGRASP, f"{why}; correcting")
    robot.stop_observing()
    try:
        plan = await robot.plan_grasp(grasp.arm, run.offered, corrected.sighting, blend=True)
    except OpenArmError as error:
        reraise_stop(error)
        if run.request.confirm:
            raise
        uncorrected = replace(grasp, sighting=corrected.sighting)
        return uncorrected, plan, f"the correction cannot be planned, going on without: {error.message}"
    run.grasp, run.place_plan, why = corrected, None, f"correcting to {corrected.candidate.id}"
    if changed := await agreed(run, State.MOVE_TO_PREGRASP, corrected, why, plan):
        raise OpenArmError(Code.GRASP_MISSED, changed)
    return corrected, plan, why


# --- grasp
async def close(run: Run, grasp: Grasp, why: str) -> tuple[Grasp, str]:
    """Pause, close until the fingers stop, let them settle, and judge by them whether they hold the object.

    Returns:
        The grasp, with the aperture after closing when the object is no box, and the reason.

    Raises:
        OpenArmError: the code of the grip, when they do not hold it.
    """
    arm, c, robot, timing = grasp.arm, grasp.candidate, run.robot, run.config.timing
    run.enter(State.CLOSE_GRIPPER, why)
    # Fingers that close may have the object between them when the request is stopped.
    run.hand = Hand.HOLDING
    try:
        await robot.wait(timing.pause_at_grasp)
        await robot.close(arm, "close", run.config.hand.close_effort)
        await robot.wait(timing.after_close)
        evidence = await robot.measure(arm, c.width, c.T_base_tcp, settle=timing.settle_limit)
        gripper = grasp.judge(evidence, run.config.held)
        if not gripper.ok:
            raise OpenArmError(gripper.code, gripper.reason)
    except OpenArmError as error:
        reraise_stop(error)
        run.hand = Hand.AT_OBJECT
        raise
    if c.apertures is not None:
        run.grasp = grasp = replace(grasp, closed=evidence.gap)
    return grasp, gripper.reason


async def lift(run: Run, grasp: Grasp, plan: Planned, why: str) -> tuple[Grasp, HandVerdict, CameraVerdict, str]:
    """Lift straight up and plan the place, then judge by gripper and camera whether the object has come along.

    Returns:
        The grasp, of all that has come along as one body; both verdicts, and the reason.

    Raises:
        OpenArmError: When they do not agree that it has.
    """
    arm, robot, config = grasp.arm, run.robot, run.config
    run.enter(State.LIFT, why)
    top = grasp.candidate.T_base_tcp[:3, 3] + grasp.candidate.retreat_offset

    def sag() -> float:
        return float(np.linalg.norm(robot.T_base_tcp(arm)[:3, 3] - top))

    async def rise() -> None:
        try:
            await robot.follow(arm, plan.retreat, "lift", carrying=True)
        except OpenArmError as error:
            if error.code is Code.GRASP_LOST:
                run.hand = Hand.AT_OBJECT
            if error.code is not Code.EXECUTION_FAILED or sag() > config.held.sag:
                raise
            robot.warn(f"lift: the {arm} arm gives way to the weight by {sag() * 1e3:.0f} mm")

    async def plan_ahead() -> None:
        # of what is no box or cylinder more is known after the lift; and a person confirms what is planned
        if run.request.phase == "all" and not (grasp.of_cloud or run.request.confirm):
            with suppress(OpenArmError):  # it is planned from where the arm then is
                run.place_plan = await robot.plan_place(
                    arm, grasp.places, grasp.sighting, grasp.candidate, plan.retreat
                )

    async def watched() -> None:
        seen.extend(await robot.observe_towards_end(rise, lambda: sag() <= _ARRIVING, _LIFT_FRAMES))

    seen = list[Frame]()
    await robot.robot.together([watched, plan_ahead])
    frames = tuple(seen)
    evidence = await robot.measure(arm, grasp.candidate.width, settle=config.timing.settle_limit)
    gripper = grasp.judge(evidence, config.held, was_held=True)
    grasp, camera = _judge_lifted(run, grasp, frames)
    verdict = judge_lift(gripper, camera)
    # what is hidden after the lift may be seen at the place
    hidden = bool(frames) and verdict.code is Code.STALE_DATA and run.request.phase == "all"
    if not verdict.ok and not hidden:
        run.hand = Hand.HOLDING if gripper.ok else Hand.AT_OBJECT
        raise OpenArmError(verdict.code, verdict.reason)
    run.hand = Hand.CARRYING
    return grasp, gripper, camera, verdict.reason


def _judge_lifted(run: Run, grasp: Grasp, frames: Sequence[Frame]) -> tuple[Grasp, CameraVerdict]:
    """Judge by the camera whether the object has left its place, and hangs where the hand should hold it.

    Args:
        run: The request.
        grasp: Hold of the hand on the object.
        frames: Taken after the lift.

    Returns:
        The grasp, of all that has come along as one body, and the verdict.
    """
    sighting, T_before = grasp.sighting, grasp.candidate.T_base_tcp
    T = run.robot.T_base_tcp(grasp.arm)
    T_now_before = T @ se3.inverse(T_before)
    points = risen_points(frames, sighting, run.config.held.rise)
    thing = lifted(frames, sighting, points, T_now_before, T_before[:3, 3])
    if thing is not sighting:
        grasp = run.grasp = regrasped(run, grasp, thing)
    gone = judge_gone(first_points(thing), frames, (T - T_before)[:3, 3])
    if not gone.ok:
        return grasp, gone  # also where no points of it are known
    before = np.concatenate([object_points(sighting.clouds), points_around(sighting.clouds)])
    held = judge_held(columns(before, run.context.table.top_z), points, T_now_before, run.config.held)
    if held.ok:
        return grasp, gone
    run.grasp = grasp = replace(grasp, turned=True, heavy=heavier_end(object_points(thing.clouds), points, T))
    return grasp, held


# --- place
async def place(run: Run, grasp: Grasp, why: str) -> Placed:
    """Put the object down; back where it came from when its place cannot be reached.

    Raises:
        ObjectKeptError: When it cannot be put back either.
        OpenArmError: GRASP_LOST.
    """
    run.tried += run.kept is not None
    ways, failure, met = grasp.places, None, False
    while True:
        try:
            placed = await _put_down(run, grasp, ways, why, last=run.kept is not None or failure is not None)
            return placed if failure is None else replace(placed, failure=failure)
        except OpenArmError as error:
            reraise_stop(error)
            if error.code is Code.GRASP_LOST:
                raise
            if run.kept is not None or failure is not None:
                if error.code is Code.EXECUTION_FAILED and not met:
                    # what it has met on the way there it may not meet on the way to another spot
                    met, ways = True, other_spots(ways, run.used_places)
                elif grasp.turned or error.code not in NO_WAY:
                    raise ObjectKeptError(Code.PLACE_FAILED, still_held(run, error)) from error
                # with its hand in the way, or other things: it may hang otherwise than is known
                grasp, why = replace(grasp, turned=True), f"{error.message}; as what has turned in the hand"
                continue
            text = f"{run.label!r} could not be placed ({error.code}): {error.message}"
            # What kept it from its place may not do so at the next attempt.
            passing = error.code in (Code.EXECUTION_FAILED, Code.TIMEOUT)
            failure = run.fail(Code.PLACE_FAILED, text, final=not passing)
            why = f"{error.message}; putting it back"
        run.place_target = None
        target = grasp.sighting.target
        back = place_targets(target, grasp.candidate, (target.foot,), run.config)
        # first from where the lift has brought it: it has come that way, between things that stand close to it
        lifted = grasp.candidate.retreat_offset
        ways = (*(replace(way, id=f"{way.id}/lifted", approach_offset=lifted) for way in back), *back)


async def _put_down(run: Run, grasp: Grasp, ways: tuple[PlaceTarget, ...], why: str, *, last: bool) -> Placed:
    """Plan, carry, see that the hand still holds the object, put it down, let go, and leave while the hand opens wide.

    Args:
        run: The request.
        grasp: Grasp that holds it.
        ways: Ways to put it down.
        why: Reason, for the report.
        last: The hand keeps it when this fails: it is let go where it meets something on its way down, too.
    """
    arm, robot = grasp.arm, run.robot
    plan, target = await plan_place(run, grasp, ways, why)
    if ways is grasp.places:
        run.place_target = target
    run.enter(State.PLACE, f"carrying to {target.id}")
    reason, opened = (
        "put down and let go" if ways is grasp.places else "put back where it stood",
        grasp.candidate.opened,
    )

    async def leave() -> None:
        nonlocal reason
        run.hand = Hand.RELEASED
        try:
            await robot.follow(arm, plan.retreat, "leave")
            if opened is not None:
                await robot.open(arm, "open")
        except OpenArmError as error:
            reraise_stop(error)
            reason = error.message
        else:
            run.hand = Hand.CLEAR

    try:
        gripper, failure = await _carry(run, grasp, plan, target, last=last)
        held = robot.aperture(arm)
        let_go = held + run.config.hand.lets_go
        release = partial(robot.open, arm, "release", opened, held=held)
        await robot.towards_end(release, lambda: robot.aperture(arm) >= let_go, leave)
    except OpenArmError as error:
        if error.code is Code.GRASP_LOST:
            run.hand = Hand.FREE
        else:
            run.used_places = (*run.used_places, target)
        raise
    return Placed(target, gripper, reason, failure)


async def _carry(
    run: Run, grasp: Grasp, plan: Planned, target: PlaceTarget, *, last: bool
) -> tuple[HandVerdict, Verdict | None]:
    """Carry the object to its place and put it down; judge by the gripper as the hand comes to the line down.

    What meets something a little above the place is let go there, at the last try anywhere.

    Returns:
        That the hand holds it, and why it is not where it should be, when it was let go higher up; None, when it is.

    Raises:
        OpenArmError: GRASP_LOST, with the arm above the place; EXECUTION_FAILED, when it meets something on the way or
            higher up, and may be put back yet.
    """
    arm, robot, config = grasp.arm, run.robot, run.config
    found, lost = list[HandVerdict](), list[OpenArmError]()
    line = float(np.linalg.norm(target.approach_offset))

    def above() -> bool:
        return float(np.linalg.norm((robot.T_base_tcp(arm) - target.T_base_tcp)[:3, 3])) <= line

    async def judge() -> None:
        evidence = await robot.measure(arm, grasp.candidate.width, settle=config.timing.settle_limit)
        gripper = grasp.judge(evidence, config.held, was_held=True)
        if not gripper.ok:
            lost.append(OpenArmError(Code.GRASP_LOST, f"lost on the way: {gripper.reason}"))
        run.enter(State.PLACE, gripper.reason)
        found.append(gripper)

    def check() -> None:
        if lost:
            raise lost[0]

    async def carry() -> None:
        await robot.follow(arm, plan.transfer, "carry", carrying=True, check=check)

    failure = None
    try:
        await robot.towards_end(carry, above, judge)
    except OpenArmError as error:
        if error.code is not Code.EXECUTION_FAILED or not above():
            raise
        height = float((robot.T_base_tcp(arm) - target.T_base_tcp)[2, 3])
        high = height > _MET_AT and not grasp.turned
        if high and not last:
            raise
        text = f"{error.message}: what the hand holds meets something below, and is let go there"
        robot.warn(text)
        if high:
            failure = run.fail(Code.PLACE_FAILED, f"{text}, {height * 1e3:.0f} mm above its place")
        if not found:
            await judge()
    check()
    return found[0], failure
