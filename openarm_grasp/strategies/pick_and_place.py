# SPDX-License-Identifier: Apache-2.0
"""Pick an object with one arm and place it: detect, plan, approach, close, lift, place, retreat, verify.

`_attempts` is the strategy from beginning to end; the functions below it are its steps, in their order. A step that
does not succeed raises. What fails with the arm ends the attempt: the hand goes home, and the next attempt observes
again and prefers another grasp. Success is said in one place, `succeeded`, from the verdicts on gripper and camera.
Base frame, m.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import product

from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_common.wanted import describe
from openarm_grasp.evidence import verdicts
from openarm_grasp.evidence.verdicts import CameraVerdict, GripperVerdict, Verdict
from openarm_grasp.perception.detections import Frame, Sighting, apart, in_view, on_table
from openarm_grasp.planning import retries
from openarm_grasp.planning.arms import ARMS, arm_order, out_of_reach
from openarm_grasp.planning.candidates import GraspCandidate, PlaceTarget
from openarm_grasp.planning.feasibility import standing_at
from openarm_grasp.planning.options import NoWayError, Options, not_placeable, options_of, planned
from openarm_grasp.planning.place import check_position, free_spots, other_grasps, place_targets, placing_error
from openarm_grasp.robot.interface import Frames, Planned
from openarm_grasp.robot.skills import reraise_stop
from openarm_grasp.strategies.confirm import GRASP, PLACE, ShownPlan, agree, outdated
from openarm_grasp.strategies.request import Feasible, GraspOutcome, GraspRequest, Proof
from openarm_grasp.strategies.retreat import Hand, Placed, retreat, still_held
from openarm_grasp.strategies.second_look import second_look
from openarm_grasp.strategies.states import State, check_transition
from openarm_grasp.strategies.task import Findings, Grasp, Status, Task

#: Frames that must not show the object in its old place after the lift: a detector may miss it in one.
_LIFT_FRAMES = 2
#: An object that is observed so may be trusted in the next frames.
_NOT_TRUSTED = (Code.NOTHING_DETECTED, Code.UNKNOWN_OBJECT, Code.STALE_DATA)


class NoGraspError(OpenArmError):
    """No grasp, or no place for what is grasped, could be planned."""


class ObjectKeptError(OpenArmError):
    """The object can be put down nowhere: the arm holds, and the hand keeps it."""


class Run:
    """What has been learned since the request came.

    Args:
        task: That this is a part of.
        request: What is asked for; a retry keeps to the same object.
        kept: What a hand kept from an earlier request, when it is this one's to place.
    """

    def __init__(self, task: Task, request: GraspRequest, kept: Grasp | None) -> None:
        self.task, self.request, self.kept = task, request, kept
        self.robot, self.context, self.config = task.robot, task.context, task.context.config
        self.began_ns = task.robot.now_ns
        self.state = State.IDLE
        self.attempt = 1
        #: Attempts in which the arm moved.
        self.tried = 0
        #: Rounds of frames without a trusted object, and detections planned for in vain, this attempt.
        self.missed = self.plans_failed = 0
        #: The newest failure; None while nothing has failed.
        self.failure: Verdict | None = None
        #: Grasps that have failed, and places that could not be reached with the object in the hand.
        self.failed: tuple[retries.FailedGrasp, ...] = ()
        self.used_places: tuple[PlaceTarget, ...] = ()
        #: The object and its neighbours, and why arms were refused for it.
        self.findings = Findings()
        #: (3,) edges of the object when it was first observed, m.
        self.size: Array | None = None
        #: The object where it was when the hand was last about to go down.
        self.suspected: Detection | None = None
        #: Candidates that the planner chooses from, and the results of those that it was offered before.
        self.offered: tuple[GraspCandidate, ...] = ()
        self.options: Options = {}
        self.arm = kept.arm if kept else ""
        self.grasp: Grasp | None = None
        self.place_target: PlaceTarget | None = None
        #: How to put it down, confirmed with the grasp.
        self.place_plan: Planned | None = None
        self.hand = Hand.CARRYING if kept else Hand.FREE

    @property
    def label(self) -> str:
        """What is picked, once it is known; before that, what is asked for."""
        return self.findings.sighting.target.label if self.findings.sighting else self.request.label

    @property
    def holding(self) -> bool:
        """Whether the hand holds the object, as far as known."""
        return self.hand in (Hand.HOLDING, Hand.CARRYING)

    def enter(self, state: State, reason: str, plan: ShownPlan | None = None) -> None:
        """Enter a state and report it, with the plan that waits for a person.

        Raises:
            OpenArmError: INTERNAL, when that state may not follow.
        """
        check_transition(self.state, state)
        previous, self.state = self.state, state
        failed = self.failure is not None
        status = Status(state, previous, reason, self.attempt, self.label, self.arm, self.task.index, failed, plan=plan)
        if state in (State.PLAN, State.MOVE_TO_PREGRASP):
            mine = (option for option in self.options.values() if option.arm == self.arm)
            refused = frozenset(option.id for option in mine if option.code not in ("", Code.OK))
            chosen = self.grasp.candidate.id if self.grasp else ""
            status = replace(status, candidates=self.offered, chosen=chosen, refused=refused)
        self.task.report(status)

    def fail(self, code: Code, reason: str, *, final: bool = False) -> Verdict:
        """Write a failure down; after a `final` one another attempt would not help."""
        self.failure = Verdict(code, reason, final)
        return self.failure

    def missed_round(self, code: Code, reason: str) -> str:
        """Count a round of frames without a trusted object; returns the reason to observe again.

        Raises:
            OpenArmError: When it was the last round.
        """
        self.missed += 1
        last = self.missed >= self.config.detect.attempts
        if self.attempt > 1 and self.failure is not None:
            # What went wrong with the arm says more than the object that is missing since.
            code = self.failure.code
            reason = f"{self.failure.reason}; then {reason}" if last else self.failure.reason
        self.fail(code, reason)
        if last:
            raise OpenArmError(code, reason)
        return reason

    def forget(self) -> None:
        """Start over from the camera."""
        self.findings, self.offered = Findings(), ()
        self.grasp = self.place_target = self.place_plan = None
        if self.kept is None:
            self.arm, self.hand = "", Hand.FREE

    def ways(self, arm: str, sighting: Sighting) -> retries.Ways:
        """Grasps for an arm; those that have failed apart from the others."""
        shoulder = self.context.shoulders.get(arm, (0.0, 0.0))
        return retries.ways(sighting.target, self.config, self.failed, shoulder_xy=shoulder, others=sighting.others)

    def start_again(self, grasp: Grasp, placed: Placed | None) -> str:
        """Begin the next attempt at the same object, the failed grasp remembered; returns why.

        Args:
            grasp: That has failed.
            placed: Where the object was put down, when it was.

        Raises:
            OpenArmError: With the failure, when no attempt is left or another would not help.
        """
        failure = self.failure or Verdict(Code.INTERNAL, "an attempt ended without a failure")
        if failure.final or self.attempt >= self.config.limits.max_attempts:
            raise OpenArmError(failure.code, failure.reason)
        same = grasp.sighting
        self.failed += (retries.FailedGrasp.of(failure.code, grasp.arm, grasp.candidate, same.target),)
        if placed is not None:
            same = replace(same, target=standing_at(same.target, placed.target.position))
        phase = "all" if self.kept else self.request.phase
        self.request = replace(self.request.about(same), phase=phase)
        self.attempt += 1
        self.missed = self.plans_failed = 0
        self.kept = None
        self.forget()
        return failure.reason

    def answer(self, code: Code, message: str, proof: Proof | Feasible | None = None) -> GraspOutcome:
        """The answer to the request."""
        x, y, z = (float(v) for v in (self.place_target.position if self.place_target else (0.0, 0.0, 0.0)))
        return GraspOutcome(
            code=code,
            message=message,
            label=self.label,
            arm=self.arm,
            attempts=self.tried,
            place_position=(x, y, z),
            duration=(self.robot.now_ns - self.began_ns) * 1e-9,
            held=self.holding,
            options=tuple(self.options.values()),
            state_times=self.task.clock.times(self.robot.now_ns),
            proof=proof,
        )


# --- the strategy
async def pick_and_place(task: Task, request: GraspRequest) -> GraspOutcome:
    """Carry out a request with one arm, from beginning to end.

    Args:
        task: That it is a part of.
        request: What is asked for.

    Raises:
        OpenArmError: INVALID_ARGUMENT or NOT_READY, when the request is not taken; TIMEOUT, when no time is left.
    """
    request, robot, session = task.in_time(request), task.robot, task.session
    session.check_hands(robot, request)
    request.check()
    kept = session.to_place(request) if request.phase == "place" else None
    run = Run(task, replace(request, label=kept.sighting.target.label) if kept else request, kept)
    robot.set_deadline(request.timeout)
    try:
        outcome = await _attempts(run)
    except OpenArmError as error:
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
    check_transition(run.state, State.IDLE)
    about = Status(State.IDLE, run.state, outcome.message, label=outcome.label, arm=outcome.arm, request=task.index)
    task.report(replace(about, code=outcome.code.value))
    return outcome


async def _attempts(run: Run) -> GraspOutcome:
    why = f"asked for {run.request.label or 'any object'!r}"
    why += f"; {run.request.why}" if run.request.why else ""
    while True:
        grasp, plan, why = await find_grasp(run, why)
        if run.request.dry_run:
            return run.answer(Code.OK, f"can be done: {why}", Feasible(why))
        if plan is not None and (changed := await _agree(run, State.PLAN, grasp, why, plan, run.place_plan)):
            run.forget()
            why = changed
            continue
        placed = None
        try:
            if plan is not None:
                grasp, plan, why = await approach(run, grasp, plan, why)
                why = await close(run, grasp, why)
                gripper, camera, why = await lift(run, grasp, plan, why)
                if run.request.phase == "pick":
                    return succeeded(run, f"{why}; the {run.arm} hand keeps it", gripper=gripper, camera=camera)
            placed = await place(run, grasp, why)
            run.enter(State.RESET, placed.reason)
        except ObjectKeptError:
            raise
        except OpenArmError as error:
            reraise_stop(error)
            grasp = run.grasp or grasp  # corrected by the second observation
            run.fail(error.code, error.message)
            run.enter(State.RESET, error.message)
        await retreat(run, grasp, placed)
        if placed is not None and placed.failure is None:
            seen = await verify(run, placed)
            if seen.ok:
                text = f"{seen.reason}, placed by the {run.arm} arm"
                return succeeded(run, text, gripper=placed.gripper, camera=seen)
            run.failure = seen
        why = run.start_again(grasp, placed)


def succeeded(run: Run, message: str, *, gripper: GripperVerdict, camera: CameraVerdict) -> GraspOutcome:
    """Say that what was asked for has happened: the only place that can.

    Args:
        run: The request.
        message: How, in a sentence.
        gripper: That the hand held the object.
        camera: That the object has left its place, or is seen where it was to be placed.

    Raises:
        OpenArmError: INTERNAL, when one of them says otherwise.
    """
    return run.answer(Code.OK, message, Proof(gripper, camera))


# --- detect and plan
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
            grasp = run.grasp = _grasp(run, run.kept.arm, sighting, run.kept.candidate)
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
            if run.plans_failed >= run.config.limits.plan_attempts:
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
        text = f"in view: {describe([d for frame in seen.frames for d in frame.detections])}"
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
            return _locate(run, run.robot.in_base(seen).frames)
        except OpenArmError as error:
            if error.code not in _NOT_TRUSTED:
                raise
            why = run.missed_round(error.code, error.message)
            run.forget()


def _missing(run: Run, seen: Frames) -> OpenArmError | None:
    """Why nothing in view is what is asked for; None when something is."""
    try:
        in_view(run.robot.in_base(seen).frames, run.request.label)
    except OpenArmError as error:
        return error if error.code in (Code.NOTHING_DETECTED, Code.UNKNOWN_OBJECT) else None
    return None


async def _clear_view(run: Run) -> None:
    """Send the arms home that may hide something. A dry run moves nothing, nor does what nobody has confirmed yet."""
    if run.request.dry_run or run.request.confirm or run.missed > 0 or run.plans_failed > 0:
        return
    if run.kept is not None:
        # A hand that holds something stays where it is; it may be among the objects.
        await run.robot.go_home([arm for arm in ARMS if arm not in run.task.session.kept])
    else:
        await run.robot.go_home(ARMS, back_off_below=run.context.clear_of_objects)


def _locate(run: Run, frames: Sequence[Frame]) -> Sighting:
    """The object and its neighbours in frames of the base frame.

    Raises:
        OpenArmError: One of `_NOT_TRUSTED`, when it cannot be trusted.
    """
    request, limits, top_z, kept = run.request, run.config.detect, run.context.table.top_z, run.kept
    if kept is not None:
        newest = frames[-1]
        others = (d for d in newest.detections if d.label != kept.sighting.target.label)
        sighting = Sighting(kept.sighting.target, _standing(others, top_z), newest.t_ns)
    else:
        found = request.find(frames, limits)
        target = on_table(found.target, top_z)
        sighting = replace(found, target=target, others=_standing(found.others, top_z))
    age = (run.robot.now_ns - sighting.t_ns) * 1e-9
    if age > limits.max_age:
        text = f"the newest detection is {age:.2f} s old, expected at most {limits.max_age:g} s"
        raise OpenArmError(Code.STALE_DATA, text)
    run.findings.sighting = sighting
    if kept or run.size is None or any(d.label == sighting.target.label for d in sighting.others):
        run.size = sighting.target.size
    return sighting


def _standing(found: Iterable[Detection], table_z: float) -> tuple[Detection, ...]:
    """What stands on the table; what is flat on it is no obstacle."""
    return tuple(on_table(d, table_z) for d in found if d.top > table_z + 0.005)


async def plan(run: Run, sighting: Sighting) -> tuple[Grasp, Planned, str]:
    """Plan the grasp, and the place where one is asked for or nothing may move; with each arm that may reach.

    Raises:
        NoGraspError: With what each arm lacks.
        OpenArmError: When the place is not one, or the object does not fit into a hand.
    """
    request, target, table = run.request, sighting.target, run.context.table
    if request.place is not None:
        check_position(request.place, target, sighting.others, table)
    run.options, why = {}, ""
    arms = arm_order(request.arm, float(target.p_base[1]), run.config.approach.overlap_half_width)
    arms = retries.arms_to_try(arms, run.failed)
    ways = {arm: run.ways(arm, sighting) for arm in arms}
    where = "({:.3f}, {:.3f}, {:.3f}) m".format(*target.p_base)
    for repeats, run.arm in product((False, True), arms):
        offered = ways[run.arm].repeats if repeats else ways[run.arm].fresh
        if not offered:
            continue
        run.options |= options_of(run.arm, offered, target, run.config.approach)
        text = f"{why}; trying the {run.arm} arm" if why else f"{target.label!r} stands at {where}"
        text += f"; {len(offered)} ways to grasp it" + ("; all that is left has failed before" if repeats else "")
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
        grasp = run.grasp = _grasp(run, arm, sighting, candidate)
        chosen = f"grasp {candidate.id} with the {arm} arm"
        if request.place is None and not (request.dry_run or (request.confirm and request.phase == "all")):
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


def _grasp(run: Run, arm: str, sighting: Sighting, candidate: GraspCandidate) -> Grasp:
    """A grasp with the ways to put the object down: where it was asked for, or on free spots."""
    request, target, others, table = run.request, sighting.target, sighting.others, run.context.table
    if request.place is not None:
        spots = (check_position(request.place, target, others, table),)
    else:
        spots = free_spots(arm, target, others, run.config)
    yaw = request.place_yaw
    return Grasp(
        arm, sighting, candidate, place_targets(target, candidate, spots, run.config, run.used_places, yaw=yaw)
    )


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
    what, opening = "move to the pre-grasp", config.hand.opening
    second = config.near.enabled and arm == config.near.arm
    if second:
        robot.expect_near()
    await robot.follow_and_grip(arm, plan.transfer, what, position=opening, how="open")
    why = "the open hand is before the object"
    if second:
        grasp, plan, why = await _correct(run, grasp, plan)
    run.enter(State.MOVE_TO_GRASP, why)
    target = grasp.sighting.target
    still, why = verdicts.judge_still(target, (await robot.observe(1)).frames, config.held)
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
    await robot.follow(arm, plan.approach, "move to the grasp", line=(p + c.approach_offset, p))
    error, limit = (await robot.measure(arm, c.width, c.T_base_tcp)).tcp_error, config.held.max_tcp_error
    if error > limit:
        text = f"the hand stopped {error * 1e3:.1f} mm from the grasp, expected at most {limit * 1e3:.0f} mm"
        raise OpenArmError(Code.HAND_COLLISION, text)
    return grasp, plan, f"the hand is at the grasp, off by {error * 1e3:.1f} mm"


async def _correct(run: Run, grasp: Grasp, plan: Planned) -> tuple[Grasp, Planned, str]:
    """Observe with the camera on the hand, and go where the object is seen from there.

    Whatever keeps the second observation from helping, the grasp goes on with what is known.
    """
    config, near, robot = run.config, run.config.near, run.robot
    run.enter(State.MOVE_TO_PREGRASP, f"the open hand is before the object; observing with the {near.camera} camera")
    corrected, why = await second_look(run, grasp, config.confirm.correction if run.request.confirm else near.least)
    if corrected is None:
        return grasp, plan, why
    run.findings.sighting, run.offered = corrected.sighting, (corrected.candidate,)
    run.enter(State.MOVE_TO_PREGRASP, f"{why}; correcting")
    robot.stop_observing()
    try:
        plan = await robot.plan_grasp(grasp.arm, run.offered, corrected.sighting)
    except OpenArmError as error:
        reraise_stop(error)
        if run.request.confirm:
            raise
        uncorrected = replace(grasp, sighting=corrected.sighting)
        return uncorrected, plan, f"the correction cannot be planned, going on without: {error.message}"
    run.grasp, run.place_plan, why = corrected, None, f"correcting to {corrected.candidate.id}"
    if changed := await _agree(run, State.MOVE_TO_PREGRASP, corrected, why, plan):
        raise OpenArmError(Code.GRASP_MISSED, changed)
    run.enter(State.MOVE_TO_PREGRASP, why)
    await robot.follow(grasp.arm, plan.transfer, "correct the pre-grasp")
    return corrected, plan, "the open hand is before the object"


# --- grasp
async def close(run: Run, grasp: Grasp, why: str) -> str:
    """Pause, close until the fingers stop, let them settle, and judge by them whether they hold the object.

    Raises:
        OpenArmError: With the code of the grip, when they do not hold it.
    """
    arm, c, robot, timing = grasp.arm, grasp.candidate, run.robot, run.config.timing
    run.enter(State.CLOSE_GRIPPER, why)
    # Fingers that close may have the object between them when the request is stopped.
    run.hand = Hand.HOLDING
    try:
        await robot.wait(timing.pause_at_grasp)
        await robot.grip(arm, 0.0, "close", run.config.hand.close_effort)
        await robot.wait(timing.after_close)
        evidence = await robot.measure(arm, c.width, c.T_base_tcp, settle=timing.settle_limit)
        gripper = verdicts.judge_grip(evidence, run.config.held)
        if not gripper.ok:
            raise OpenArmError(gripper.code, gripper.reason)
    except OpenArmError as error:
        reraise_stop(error)
        run.hand = Hand.AT_OBJECT
        raise
    return gripper.reason


async def lift(run: Run, grasp: Grasp, plan: Planned, why: str) -> tuple[GripperVerdict, CameraVerdict, str]:
    """Lift straight up, then judge by gripper and camera whether the object has come along.

    Returns:
        Both verdicts, and the reason.

    Raises:
        OpenArmError: When they do not agree that it has.
    """
    arm, robot, config, sighting = grasp.arm, run.robot, run.config, grasp.sighting
    run.enter(State.LIFT, why)
    try:
        await robot.follow(arm, plan.retreat, "lift", carrying=True)
    except OpenArmError as error:
        if error.code is Code.GRASP_LOST:
            run.hand = Hand.AT_OBJECT
        raise
    evidence = await robot.measure(arm, grasp.candidate.width, settle=config.timing.settle_limit)
    frames = (await robot.observe(_LIFT_FRAMES)).frames
    gripper = verdicts.judge_grip(evidence, config.held, was_held=True)
    camera = verdicts.judge_sight(
        sighting.target,
        frames,
        config.held,
        match_radius=config.detect.match_radius,
        others=sighting.others,
        lift=float(grasp.candidate.retreat_offset[2]),
    )
    verdict = verdicts.judge_lift(gripper, camera)
    if not verdict.ok:
        run.hand = Hand.HOLDING if gripper.ok else Hand.AT_OBJECT
        raise OpenArmError(verdict.code, verdict.reason)
    run.hand = Hand.CARRYING
    return gripper, camera, verdict.reason


# --- place
async def place(run: Run, grasp: Grasp, why: str) -> Placed:
    """Put the object down; back where it came from when its place cannot be reached.

    Raises:
        ObjectKeptError: When it cannot be put back either.
        OpenArmError: GRASP_LOST.
    """
    run.tried += run.kept is not None
    ways, failure = grasp.places, None
    while True:
        try:
            return replace(await _put_down(run, grasp, ways, why), failure=failure)
        except OpenArmError as error:
            reraise_stop(error)
            if error.code is Code.GRASP_LOST:
                raise
            if run.kept is not None or failure is not None:
                raise ObjectKeptError(Code.PLACE_FAILED, still_held(run, error)) from error
            text = f"{run.label!r} could not be placed ({error.code}): {error.message}"
            # What kept it from its place may not do so at the next attempt.
            passing = error.code in (Code.EXECUTION_FAILED, Code.TIMEOUT)
            failure = run.fail(Code.PLACE_FAILED, text, final=not passing)
            why = f"{error.message}; putting it back"
        run.place_target = None
        target = grasp.sighting.target
        ways = place_targets(target, grasp.candidate, (target.p_base[:2],), run.config)


async def plan_place(run: Run, grasp: Grasp, ways: tuple[PlaceTarget, ...], why: str) -> tuple[Planned, PlaceTarget]:
    """Plan from where the arm is how to put the object down in one of these ways, unless that is confirmed already."""
    run.enter(State.PLACE, why)
    run.robot.stop_observing()
    ready, run.place_plan = run.place_plan, None
    if ready is not None:
        why = await outdated(run.robot, (ready,), ready.start, run.config.confirm.joints)
        if not why:
            return ready, ways[ready.chosen]
        run.enter(State.PLACE, f"the confirmed place has to be planned anew: {why}")
    while True:
        plan = await run.robot.plan_place(grasp.arm, ways, grasp.sighting, grasp.candidate)
        target = ways[plan.chosen]
        why = await _agree(run, State.PLACE, grasp, f"place {target} with the {grasp.arm} arm", place=plan)
        if not why:
            return plan, target
        run.enter(State.PLACE, why)


async def _agree(
    run: Run, state: State, grasp: Grasp, why: str, plan: Planned | None = None, place: Planned | None = None
) -> str:
    """Let a person confirm what is planned; returns why it has to be planned anew, "" when it has not."""
    plans = [(names, part) for names, part in ((GRASP, plan), (PLACE, place)) if part is not None]
    standing = (grasp.sighting.target, *grasp.sighting.others) if state is State.PLAN else ()
    return await agree(
        run.task, grasp.arm, why, plans, lambda text, shown: run.enter(state, text, shown), standing=standing
    )


async def _put_down(run: Run, grasp: Grasp, ways: tuple[PlaceTarget, ...], why: str) -> Placed:
    """Plan, carry, see that the hand still holds the object, put it down, let go, leave."""
    arm, robot, config = grasp.arm, run.robot, run.config
    plan, target = await plan_place(run, grasp, ways, why)
    if ways is grasp.places:
        run.place_target = target
    run.enter(State.PLACE, f"carrying to {target.id}")
    try:
        await robot.follow(arm, plan.transfer, "carry", carrying=True)
        evidence = await robot.measure(arm, grasp.candidate.width, settle=config.timing.settle_limit)
        gripper = verdicts.judge_grip(evidence, config.held, was_held=True)
        if not gripper.ok:
            raise OpenArmError(Code.GRASP_LOST, f"lost on the way: {gripper.reason}")
        run.enter(State.PLACE, gripper.reason)
        await robot.follow(arm, plan.approach, "put down", carrying=True)
        await robot.grip(arm, config.hand.opening, "release")
    except OpenArmError as error:
        if error.code is Code.GRASP_LOST:
            run.hand = Hand.FREE
        else:
            run.used_places = (*run.used_places, target)
        raise
    run.hand = Hand.RELEASED
    reason = "put down and let go" if ways is grasp.places else "put back where it stood"
    try:
        await robot.wait(config.timing.after_release)
        await robot.follow(arm, plan.retreat, "leave")
    except OpenArmError as error:
        reraise_stop(error)
        reason = error.message
    else:
        run.hand = Hand.CLEAR
    return Placed(target, gripper, reason)


# --- verify
async def verify(run: Run, placed: Placed) -> CameraVerdict:
    """Judge by the camera, from home, whether the object is at its place.

    Raises:
        OpenArmError: PLACE_FAILED, when no frame comes.
    """
    config, robot, text = run.config, run.robot, "home; observing the place"
    frames: tuple[Frame, ...] = ()
    for _ in range(config.detect.attempts):
        run.enter(State.RESET, text)
        try:
            frames = (await robot.observe(config.detect.frames)).frames
        except OpenArmError as error:
            reraise_stop(error)
            raise OpenArmError(Code.PLACE_FAILED, f"put down, but not seen since: {error.message}") from error
        if any(d.label == run.label for frame in frames for d in frame.detections):
            break
        text = f"{run.label!r} is not in view after the place; observing again"
    error = placing_error(run.label, placed.target, frames[-1]) if frames else None
    if error is not None:
        run.task.session.drift.add(*error)
    p_target, yaw = placed.target.position, run.request.place_yaw
    height, footprint = (None, None) if run.size is None else (float(run.size[2]), run.size[:2])
    tolerance = config.place.tolerance
    return verdicts.judge_place(run.label, p_target, frames, tolerance, yaw, height, footprint)
