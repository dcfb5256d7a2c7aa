# SPDX-License-Identifier: Apache-2.0
"""Two objects at once: one look at both, an arm for each, then two machines side by side, each with its own arm.

An arm is given to each object by planning: both grasps must be possible. Where they are not, or the places lie so near
to each other that the arms would only wait, the objects are picked one after the other. Base frame, m.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import Side
from openarm_grasp.evidence.observation import SAME_PLACE, Sighting, find, on_table
from openarm_grasp.planning.rehearsal import NO_WAY, Rehearsal
from openarm_grasp.planning.routing import ARMS, arm_order
from openarm_grasp.strategy.beside import BesideLink, Company
from openarm_grasp.strategy.effects import Frames, GoHome, GraspOutcome, GraspRequest
from openarm_grasp.strategy.legs import STOPS, run_task
from openarm_grasp.strategy.link import Link
from openarm_grasp.strategy.machine import GraspMachine
from openarm_grasp.strategy.performer import Performer, run_request

#: Places nearer to each other than this are served one after the other, m.
_APART = 0.20


@dataclass(frozen=True)
class Pair:
    """How two requests are carried out.

    Attributes:
        arms: Of the first and the second request; empty: one after the other.
        reason: Why so.
    """

    arms: tuple[Side, ...]
    reason: str


@dataclass(frozen=True)
class PairOutcome:
    """The answer to two requests.

    Attributes:
        answers: To each, in their order; none when they were not taken.
        code: OK, or of the first that failed; CANCELLED, when one of them was.
        message: What happened to each.
        at_once: Both arms worked at the same time.
        duration: s of robot time.
    """

    answers: tuple[GraspOutcome, ...]
    code: Code
    message: str
    at_once: bool = False
    duration: float = 0.0

    @property
    def success(self) -> bool:
        """Whether both happened."""
        return self.code is Code.OK

    @property
    def kind(self) -> str:
        """What both are; else CANCELLED when one is, PARTIAL when one has come somewhere, FAILED."""
        kinds = {answer.kind for answer in self.answers} or {"REFUSED"}
        if len(kinds) == 1:
            return kinds.pop()
        if "CANCELLED" in kinds:
            return "CANCELLED"
        return "PARTIAL" if kinds & {"SUCCESS", "PARTIAL"} else "FAILED"


class PairRunner:
    """Carries two requests out at the same time.

    Args:
        machines: Of the first and the second request.
        links: Of each arm.
        alone: Performer of what is carried out alone.
        tell: Called after each transition, with the machine.
    """

    def __init__(
        self,
        machines: tuple[GraspMachine, GraspMachine],
        links: Mapping[Side, Link],
        alone: Performer,
        tell: Callable[[GraspMachine], None],
    ) -> None:
        self._machines, self._alone, self._tell = machines, alone, tell
        self._around = machines[0].around
        config = self._around.config
        self._company = Company()
        self._performers = {
            arm: Performer(BesideLink(arm, link, self._company, config), config, arms=(arm,))
            for arm, link in links.items()
        }
        self._began_ns = 0

    async def run(self, requests: tuple[GraspRequest, GraspRequest]) -> PairOutcome:
        """Carry both out.

        Raises:
            OpenArmError: INVALID_ARGUMENT or NOT_READY, when a request is not taken; CANCELLED, TIMEOUT or ROBOT_LOST,
                when both ended before an object was touched.
        """
        check_pair(requests)
        for machine in self._machines:
            for request in requests:
                self._alone.check_hands(machine, request)
        self._began_ns = self._alone.link.now_ns
        self._note(f"asked for {requests[0].label!r} and {requests[1].label!r} at once: looking at both")
        how = await self._shared_out(requests)
        self._note(how.reason)
        if how.arms:
            outcomes = await self._at_once(requests, how)
            # What was not touched beside the other arm may go when that is home.
            first = await self._again(0, requests[0], outcomes[0])
            answers = (first, await self._again(1, requests[1], outcomes[1]))
        else:
            answers = await self._in_turn(requests)
        return self._whole(answers, how)

    def _whole(self, answers: tuple[GraspOutcome, GraspOutcome], how: Pair) -> PairOutcome:
        codes = [answer.code for answer in answers if not answer.success]
        code = Code.CANCELLED if Code.CANCELLED in codes else next(iter(codes), Code.OK)
        text = "; ".join(f"{answer.label}: {answer.message}" for answer in answers)
        return PairOutcome(answers, code, f"{how.reason}. {text}", bool(how.arms), self._seconds())

    def _note(self, reason: str) -> None:
        """Say what is done before the machines are asked."""
        machine = self._machines[0]
        machine.outcome = None  # of a request before these
        machine.note(reason)
        self._tell(machine)

    # --- which arm
    async def _shared_out(self, requests: tuple[GraspRequest, GraspRequest]) -> Pair:
        """Look once, and give an arm to each object."""
        places = [request.place for request in requests if request.place is not None]
        if len(places) == 2 and float(np.hypot(*(np.subtract(places[0][:2], places[1][:2])))) < _APART:
            return Pair((), "the places are close to each other: one after the other")
        try:
            frames = await self._look(requests)
            seen = [self._find(frames, request) for request in requests]
        except OpenArmError as error:
            if error.code in STOPS:
                raise self._late(requests, error) from error
            return Pair((), f"{error.message}: one after the other")
        straight: tuple[Side, Side] = ("left", "right")
        crossed: tuple[Side, Side] = ("right", "left")
        further_left = seen[0].target.p_base[1] >= seen[1].target.p_base[1]
        faults: list[str] = []
        for arms in (straight, crossed) if further_left else (crossed, straight):
            asked = [request.arm in ("", "auto", arm) for request, arm in zip(requests, arms, strict=True)]
            if not all(asked):
                continue
            fault = await self._cannot(requests, seen, arms)
            if not fault:
                return Pair(arms, f"both at once: {requests[0].label!r} {arms[0]}, {requests[1].label!r} {arms[1]}")
            faults.append(fault)
        return Pair((), f"not both at once ({'; '.join(faults) or 'the same arm is asked for'}): one after the other")

    async def _look(self, requests: tuple[GraspRequest, GraspRequest]) -> Frames:
        """Frames that show both, in the base frame. A dry run moves nothing."""
        config, request = self._around.config, requests[0]
        self._alone.link.deadline_ns = self._began_ns + round(request.timeout * 1e9) if request.timeout > 0.0 else 0
        home = GoHome(ARMS, back_off_below=self._around.table.top_z + 2.0 * config.approach.lift_height)
        return await self._alone.look(config.detect.frames, after=() if request.dry_run else (home,))

    def _find(self, frames: Frames, request: GraspRequest) -> Sighting:
        sighting = find(
            frames.frames, request.label, self._around.config.detect, at=request.object_at, leave=request.leave
        )
        return replace(sighting, target=on_table(sighting.target, self._around.table.top_z))

    async def _cannot(
        self, requests: tuple[GraspRequest, GraspRequest], seen: list[Sighting], arms: tuple[Side, Side]
    ) -> str:
        """Why the arms cannot do this; "" when they can."""
        rehearsal = Rehearsal(self._alone.link, self._around)
        for request, sighting, arm in zip(requests, seen, arms, strict=True):
            try:
                if request.place is None:
                    await rehearsal.pick(arm, sighting.target, sighting.others)
                else:
                    place = np.array(request.place[:2], dtype=np.float64)
                    await rehearsal.pick_and_place(
                        arm, sighting.target, sighting.others, (place,), yaw=request.place_yaw
                    )
            except OpenArmError as error:
                if error.code not in NO_WAY:
                    raise
                return error.message
        return ""

    # --- doing
    async def _at_once(
        self, requests: tuple[GraspRequest, GraspRequest], how: Pair
    ) -> tuple[GraspOutcome, GraspOutcome]:
        outcomes: dict[int, GraspOutcome] = {}
        self._company.done.clear()

        async def work(i: int) -> None:
            arm, machine = how.arms[i], self._machines[i]
            try:
                asked = replace(self._in_time(requests[i]), arm=arm, why=how.reason)
                outcome = await run_request(machine, self._performers[arm], asked, lambda: self._tell(machine))
                outcomes[i] = replace(outcome, route="direct" if outcome.success else "")
            except OpenArmError as error:
                outcomes[i] = GraspOutcome(error.code, error.message, requests[i].label)
            finally:
                self._company.done.add(arm)

        await self._alone.link.together([lambda: work(0), lambda: work(1)])
        return outcomes[0], outcomes[1]

    async def _in_turn(self, requests: tuple[GraspRequest, GraspRequest]) -> tuple[GraspOutcome, GraspOutcome]:
        first = await self._one(0, requests[0])
        if first.code in STOPS or first.held:
            text = f"not begun: {first.label!r} ended with {first.code}: {first.message}"
            return first, GraspOutcome(first.code, text, requests[1].label)
        return first, await self._one(1, requests[1])

    async def _again(self, i: int, request: GraspRequest, outcome: GraspOutcome) -> GraspOutcome:
        held = any(machine.kept is not None for machine in self._machines)
        return await self._one(i, request) if outcome.kind == "REFUSED" and not held else outcome

    async def _one(self, i: int, request: GraspRequest) -> GraspOutcome:
        """A request alone, by whatever way, in what is left of the time."""
        machine = self._machines[i]
        try:
            return await run_task(machine, self._alone, self._in_time(request), lambda: self._tell(machine))
        except OpenArmError as error:
            return GraspOutcome(error.code, error.message, request.label)

    # --- time
    def _seconds(self) -> float:
        """Robot time since both were asked for, s."""
        return (self._alone.link.now_ns - self._began_ns) * 1e-9

    def _in_time(self, request: GraspRequest) -> GraspRequest:
        """The request with what is left of its time.

        Raises:
            OpenArmError: TIMEOUT, when nothing is.
        """
        if request.timeout <= 0.0:
            return request
        left = request.timeout - self._seconds()
        if left <= 0.0:
            raise OpenArmError(Code.TIMEOUT, f"the {request.timeout:g} s were over before it began")
        return replace(request, timeout=left)

    def _late(self, requests: tuple[GraspRequest, GraspRequest], error: OpenArmError) -> OpenArmError:
        """A deadline ends work as a cancel does; here it gets its own name."""
        try:
            self._in_time(requests[0])
        except OpenArmError as late:
            return late if error.code is Code.CANCELLED else error
        return error


def check_pair(requests: tuple[GraspRequest, GraspRequest]) -> None:
    """Refuse what is no pair.

    Raises:
        OpenArmError: INVALID_ARGUMENT.
    """
    for request in requests:
        arm_order(request.arm, 0.0, 0.0)
        if request.phase != "all":
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"two at once are picked and placed; phase {request.phase!r} is of one alone"
            )
    first, second = requests
    if not first.label or not second.label:
        labels = f"{first.label!r} and {second.label!r}"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"two at once need a label each, got {labels}")
    if first.label != second.label:
        return
    if first.object_at is None or second.object_at is None:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{first.label!r} is asked for twice: say of each where it stands, or ask for another object",
        )
    apart = float(np.hypot(*np.subtract(first.object_at[:2], second.object_at[:2])))
    if apart <= 2.0 * SAME_PLACE:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{first.label!r} is asked for at two places {apart * 1e3:.0f} mm apart, expected more than"
            f" {2e3 * SAME_PLACE:.0f} mm: it may be one object",
        )
