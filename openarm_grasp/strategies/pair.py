# SPDX-License-Identifier: Apache-2.0
"""Two objects at once: observe both, an arm for each, then both strategies at the same time, each with its own arm.

An arm is given to each object by planning: both grasps must be possible. Where they are not, or the places are so near
to each other that the arms would only wait, the objects are picked one after the other. Base frame, m.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice, permutations

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.config import DetectConfig
from openarm_grasp.perception.detections import SAME_PLACE, Frame, Sighting, on_table
from openarm_grasp.planning.feasibility import FeasibilityCheck
from openarm_grasp.requests.request import GraspOutcome, GraspRequest, PairOutcome
from openarm_grasp.requests.states import State
from openarm_grasp.requests.task import GraspSession, Report, Status, Task
from openarm_grasp.robot.coordination import ArmCoordination, coordinated
from openarm_grasp.robot.interface import RobotInterface
from openarm_grasp.robot.skills import Skills
from openarm_grasp.strategies.pick_and_place import pick_and_place

Requests = tuple[GraspRequest, GraspRequest]

#: Places nearer to each other than this are served one after the other, m.
_APART = 0.20
#: Pairs of objects that are tried where words fit several.
_TRIED = 4
#: These end a request, and one that runs concurrently; no other strategy is tried.
ENDS = (Code.CANCELLED, Code.TIMEOUT, Code.ROBOT_LOST, Code.STOPPED)


@dataclass
class Pair:
    """Two requests of a user while strategies carry them out.

    Attributes:
        session: Session that outlives the requests.
        robot: Carries out what is done with one arm at a time.
        robots: Interface for each arm while both work.
        requests: Both requests.
        report: Called at each state that is entered.
        carry_out: Carries out one of the requests alone, by whatever strategy.
        reason: Why both are, or are not, carried out at the same time.
    """

    session: GraspSession
    robot: Skills
    robots: Mapping[str, RobotInterface]
    requests: Requests
    report: Report
    carry_out: Callable[[Task], Awaitable[GraspOutcome]]
    reason: str = ""

    def __post_init__(self) -> None:
        """Begin to measure the time."""
        self.began_ns = self.robot.now_ns

    def check(self) -> None:
        """Refuse what is no pair, and what would drop an object that a hand keeps.

        Raises:
            OpenArmError: INVALID_ARGUMENT; NOT_READY.
        """
        check_pair(self.requests, self.robot.description.arm_names)
        for request in self.requests:
            self.session.check_hands(self.robot, request)

    def note(self, reason: str) -> None:
        """Report what is done before either request is begun."""
        self.report(Status(State.IDLE, State.IDLE, reason))

    def task(self, i: int, robot: Skills, **changes: str) -> Task:
        """One of the requests, with what is left of its time.

        Raises:
            OpenArmError: TIMEOUT, when nothing is.
        """
        request = replace(self.requests[i], **changes)
        if request.timeout > 0.0:
            left = request.timeout - self.seconds
            if left <= 0.0:
                raise OpenArmError(Code.TIMEOUT, f"the {request.timeout:g} s were over before it began")
            request = replace(request, timeout=left)
        return Task(self.session, robot, request, self.report, i)

    async def alone(self, i: int) -> GraspOutcome:
        """Carry one of the requests out alone."""
        try:
            return await self.carry_out(self.task(i, self.robot))
        except OpenArmError as error:
            return GraspOutcome(error.code, error.message, self.requests[i].label)

    @property
    def seconds(self) -> float:
        """Robot time since both were asked for, s."""
        return (self.robot.now_ns - self.began_ns) * 1e-9

    def answer(self, answers: tuple[GraspOutcome, GraspOutcome], *, simultaneous: bool) -> PairOutcome:
        """The answer to both."""
        codes = [answer.code for answer in answers if not answer.success]
        code = Code.CANCELLED if Code.CANCELLED in codes else next(iter(codes), Code.OK)
        text = "; ".join(f"{answer.label}: {answer.message}" for answer in answers)
        return PairOutcome(answers, code, f"{self.reason}. {text}", simultaneous, self.seconds)


# --- strategies
async def simultaneous(pair: Pair) -> PairOutcome | None:
    """Both at the same time, each with its own arm, when planning finds an arm for each.

    Raises:
        OpenArmError: CANCELLED, TIMEOUT or ROBOT_LOST, when they ended before an object was touched.
    """
    first, second = pair.requests
    pair.note(f"asked for {first.label!r} and {second.label!r} at once: observing both")
    arms, pair.reason = await _arms_for_both(pair)
    pair.note(pair.reason)
    if not arms:
        return None
    config, coordination = pair.session.context.config, ArmCoordination()
    outcomes: dict[int, GraspOutcome] = {}

    async def work(i: int) -> None:
        arm = arms[i]
        robot = coordinated(arm, pair.robots[arm], coordination, config)
        with coordination.taking((arm,), pair.requests[i].label):
            try:
                task = pair.task(i, robot, arm=arm, why=pair.reason)
                outcome = await pick_and_place(task, task.request)
                outcomes[i] = replace(outcome, route="direct" if outcome.success else "")
            except OpenArmError as error:
                outcomes[i] = GraspOutcome(error.code, error.message, pair.requests[i].label)

    await pair.robot.robot.together([lambda: work(0), lambda: work(1)])
    for i, outcome in sorted(outcomes.items()):
        # What was not touched next to the other arm may be reached when that is home.
        if outcome.kind == "REFUSED" and not pair.session.kept:
            outcomes[i] = await pair.alone(i)
    return pair.answer((outcomes[0], outcomes[1]), simultaneous=True)


async def in_turn(pair: Pair) -> PairOutcome:
    """One after the other; the second is not begun when the first was stopped or its object is still in the hand."""
    first = await pair.alone(0)
    if first.code in ENDS or first.held:
        text = f"not begun: {first.label!r} ended with {first.code}: {first.message}"
        second = GraspOutcome(first.code, text, pair.requests[1].label)
    else:
        if first.success:  # words that fit both are not for what was placed
            pair.requests = (pair.requests[0], pair.requests[1].without(first.place_position[:2]))
        second = await pair.alone(1)
    return pair.answer((first, second), simultaneous=False)


# --- which arm
async def _arms_for_both(pair: Pair) -> tuple[tuple[str, ...], str]:
    """Observe once, and give an arm to each object; none, with the reason, when they go one after the other."""
    requests, shoulders = pair.requests, pair.session.context.shoulders
    if len(shoulders) < 2:
        return (), "the robot has one arm: one after the other"
    places = [request.place for request in requests if request.place is not None]
    if len(places) == 2 and float(np.hypot(*(np.subtract(places[0][:2], places[1][:2])))) < _APART:
        return (), "the places are close to each other: one after the other"
    try:
        frames = await _observe(pair)
        candidates = list(islice(_pairs(requests, frames, pair.session.context.config.detect), _TRIED))
    except OpenArmError as error:
        if error.code not in ENDS:
            return (), f"{error.message}: one after the other"
        if error.code is Code.CANCELLED:
            pair.task(0, pair.robot)  # a deadline ends work as a cancel does; here it gets its own name
        raise
    faults: dict[str, None] = {}
    for first, second in candidates:
        arms, fault = await _assigned(pair, (first, second))
        if arms:
            pair.requests = (requests[0].about(first), requests[1].about(second))
            return arms, f"both at once: {first.target.label!r} {arms[0]}, {second.target.label!r} {arms[1]}"
        faults[fault] = None
    first, second = candidates[0]
    pair.requests = (requests[0].about(first), requests[1].about(second))
    return (), f"not both at once ({'; '.join(faults)}): one after the other"


async def _assigned(pair: Pair, found: tuple[Sighting, Sighting]) -> tuple[tuple[str, ...], str]:
    """An arm for each object; none, with the reason, where they cannot be picked at the same time."""
    context, faults = pair.session.context, list[str]()
    shoulders = context.shoulders

    def crossing(arms: tuple[str, str]) -> float:
        """Least for the arms that stand on the sides of their objects."""
        return -sum(shoulders[arm][1] * float(one.target.p_base[1]) for arm, one in zip(arms, found, strict=True))

    standing = [replace(one, target=on_table(one.target, context.table.top_z)) for one in found]
    for arms in sorted(permutations(shoulders, 2), key=crossing):
        if all(request.arm in ("", "auto", arm) for request, arm in zip(pair.requests, arms, strict=True)):
            fault = await _fault(pair, standing, arms)
            if not fault:
                return arms, ""
            faults.append(fault)
    return (), "; ".join(faults) or "the same arm is asked for"


async def _observe(pair: Pair) -> tuple[Frame, ...]:
    """Frames of both objects. A dry run moves nothing."""
    context, robot = pair.session.context, pair.robot
    robot.set_deadline(pair.requests[0].timeout)
    robot.set_speed(pair.requests[0].velocity_scale)
    if not pair.requests[0].dry_run:
        await robot.go_home(robot.description.arm_names, back_off_below=context.clear_of_objects)
    return (await robot.observe_in_base(context.config.detect.frames)).frames


def _pairs(requests: Requests, frames: Sequence[Frame], limits: DetectConfig) -> Iterator[tuple[Sighting, Sighting]]:
    """Two objects, the best for each request first; then others that the words of the second request fit.

    Raises:
        OpenArmError: Same as `GraspRequest.find`; UNKNOWN_OBJECT, when both requests fit one object alone.
    """
    first, second = (request.find(frames, limits) for request in requests)
    if first.target.id == second.target.id:
        others = [request.without(_spot(first)) for request in requests]
        try:
            second = others[1].find(frames, limits)
        except OpenArmError:
            first, second = others[0].find(frames, limits), first
    left = requests[1].without(_spot(first))
    with suppress(OpenArmError):
        while True:
            yield first, second
            left = left.without(_spot(second))
            second = left.find(frames, limits)


def _spot(found: Sighting) -> tuple[float, float]:
    x, y = found.target.p_base[:2]
    return float(x), float(y)


async def _fault(pair: Pair, found: Sequence[Sighting], arms: tuple[str, str]) -> str:
    """Why the arms cannot do this; "" when they can."""
    feasible = FeasibilityCheck(pair.robot, pair.session.context)
    for request, one, arm in zip(pair.requests, found, arms, strict=True):
        refusal = await feasible.refusal(arm, one, request.place, yaw=request.place_yaw)
        if refusal is not None:
            return refusal.message
    return ""


def check_pair(requests: Requests, arms: Collection[str]) -> None:
    """Refuse what is no pair.

    Raises:
        OpenArmError: INVALID_ARGUMENT.
    """
    for request in requests:
        request.check(arms)
        if request.phase != "all":
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"two at once are picked and placed; phase {request.phase!r} is of one alone"
            )
    first, second = requests
    if not first.label or not second.label:
        labels = f"{first.label!r} and {second.label!r}"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"two at once need a label each, got {labels}")
    if first.label != second.label or first.object_at is None or second.object_at is None:
        return
    apart = float(np.hypot(*np.subtract(first.object_at[:2], second.object_at[:2])))
    if apart <= 2.0 * SAME_PLACE:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{first.label!r} is asked for at two places {apart * 1e3:.0f} mm apart, expected more than"
            f" {2e3 * SAME_PLACE:.0f} mm: it may be one object",
        )
