# SPDX-License-Identifier: Apache-2.0
"""A request while it is carried out: what was asked, what has been learned, and what is reported of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_common.wanted import fits
from openarm_grasp.config import HeldConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.evidence.drift import DriftWatch
from openarm_grasp.evidence.verdicts import Evidence, HandVerdict, Verdict, judge_grip
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.perception.sightings import object_points
from openarm_grasp.planning.candidates import GraspCandidate, PlaceTarget
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.planning.place import SAME_SPOT
from openarm_grasp.requests.confirm import PlanGate, ShownPlan
from openarm_grasp.requests.request import GraspOutcome, GraspRequest, Spot
from openarm_grasp.requests.state_times import StateClock
from openarm_grasp.requests.states import Hand, State

if TYPE_CHECKING:
    from openarm_grasp.robot.skills import Skills
    from openarm_grasp.strategies.run import Run

#: Objects whose places are remembered, and the edge of a cell of their points, m.
_REMEMBERED, _CELL = 50, 0.01


# --- what outlives a request
@dataclass(frozen=True)
class Grasp:
    """A grasp that was chosen.

    Attributes:
        arm: Arm of the hand.
        sighting: The object and its neighbours before the grasp.
        candidate: Pose and aperture of the hand.
        places: Ways to put the object down.
        closed: Aperture after the hand had closed on what is no box, m; None: it was not, or it is a box.
        turned: The camera has seen it turned or slipped in the hand, which does not put it where it should be then.
        heavy: (2,) direction of the end that hung lower than it should, base frame, as the object lay; None: not seen.
        adjacent: Objects that lay so near that they may be parts of it.
        merged: Objects that were seen as others and rose with it: they may be one with it, or be held together.
    """

    arm: str
    sighting: Sighting
    candidate: GraspCandidate
    places: tuple[PlaceTarget, ...]
    closed: float | None = None
    turned: bool = False
    heavy: Array | None = None
    adjacent: tuple[Detection, ...] = ()
    merged: tuple[Detection, ...] = ()

    @property
    def in_part(self) -> bool:
        """Whether there may be more of it than was seen."""
        return bool(self.adjacent) or not self.sighting.target.measured

    def motion_to(self, target: PlaceTarget) -> Array:
        """(4, 4) how the hand moves the object from where it takes hold of it to a place, base frame."""
        return target.T_base_tcp @ se3.inverse(self.candidate.T_base_tcp)

    @property
    def of_cloud(self) -> bool:
        """Whether it was found on the cloud of the object, of which no box is known."""
        return self.candidate.apertures is not None and bool(self.sighting.clouds)

    def judge(self, evidence: Evidence, config: HeldConfig, *, was_held: bool = False) -> HandVerdict:
        """What the gripper says: of a box by its width, of any other shape by the interval and by `closed`."""
        apertures = self.candidate.apertures
        return judge_grip(evidence, config, was_held=was_held, apertures=apertures, closed=self.closed)


@dataclass(frozen=True)
class Placed:
    """An object that was put down.

    Attributes:
        target: Target of the place.
        gripper: Verdict that the hand held it above that place.
        reason: Sentence on how it was put down.
        failure: Why it was put back where it came from, or let go on the way; None when it was put where it belongs.
    """

    target: PlaceTarget
    gripper: HandVerdict
    reason: str
    failure: Verdict | None = None


@dataclass(frozen=True, eq=False)
class _Stand:
    """An object that was placed.

    Attributes:
        spot: (x, y), base frame, m.
        points: (n, 2) where its points are, as far as known, m.
        began_ns: Robot time at which the request began that has placed it.
        ended_ns: Robot time at which it stood there.
    """

    spot: Spot
    points: Array
    began_ns: int
    ended_ns: int


class GraspSession:
    """What outlives a request: the objects that hands keep, and what grasps show about the camera.

    Args:
        context: Parameters, table and arms.
    """

    def __init__(self, context: GraspContext) -> None:
        self.context = context
        self.gate = PlanGate()
        self.drift = DriftWatch(context.config.drift, context.config.camera)
        #: What hands kept when their requests ended, by arm.
        self.kept: dict[str, Grasp] = {}
        #: Requests that are being carried out.
        self.runs: list[Run] = []
        #: The newest objects that were placed.
        self._placed: list[_Stand] = []

    def parts_of(self, stay: Sequence[Spot]) -> tuple[tuple[Spot, ...], tuple[Array, ...]]:
        """Return positions at which nothing known was placed, and points (n, 2) of what was placed at others, m.

        Who names what a request has placed may not have heard yet of what was placed since that began: it stays, too.
        """
        named = [one.began_ns for one in self._placed if any(math.dist(one.spot, spot) < SAME_SPOT for spot in stay)]
        since = (one.spot for one in self._placed if named and one.ended_ns >= named[-1])
        spots = dict.fromkeys((*stay, *since))
        known = {spot: one.points for one in self._placed for spot in spots if math.dist(one.spot, spot) < SAME_SPOT}
        known = {spot: points for spot, points in known.items() if len(points)}
        return tuple(spot for spot in spots if spot not in known), tuple(known.values())

    def end(self, run: Run, outcome: GraspOutcome) -> None:
        """End a request; what it has placed is remembered, and no other takes it that runs."""
        self.runs.remove(run)
        if outcome.success and run.tried and not outcome.held:
            x, y, _ = outcome.place_position
            points = np.empty((0, 3))
            if run.grasp is not None and run.place_target is not None:
                points = se3.apply(run.grasp.motion_to(run.place_target), object_points(run.grasp.sighting.clouds))
            cells = np.unique(np.round(points[:, :2] / _CELL), axis=0) * _CELL
            kept = [one for one in self._placed if math.dist(one.spot, (x, y)) >= SAME_SPOT]
            self._placed = [*kept[1 - _REMEMBERED :], _Stand((x, y), cells, run.began_ns, run.robot.now_ns)]
            for other in self.runs:
                other.request = other.request.without((x, y))

    def excluding_others(self, run: Run, request: GraspRequest) -> GraspRequest:
        """Return a request for what no other request is at: neither where it takes it nor where it puts it."""
        ends = [
            spot for r in self.runs if r is not run for spot in (r.seen_at, r.place_target and r.place_target.position)
        ]
        return request.without(*((float(p[0]), float(p[1])) for p in ends if p is not None))

    def staying(self, run: Run, others: Sequence[Detection]) -> tuple[Detection, ...]:
        """Return objects without those that other hands are at; the map knows when they have been lifted."""
        taken = [r.findings.sighting for r in self.runs if r is not run and r.hand is not Hand.FREE]
        held = {one.target.id for one in taken if one is not None}
        return tuple(d for d in others if d.id not in held)

    def check_hands(self, robot: Skills, request: GraspRequest) -> None:
        """Refuse what would drop an object that an ended request left in a hand; forget one that is gone.

        Raises:
            OpenArmError: NOT_READY.
        """
        if request.dry_run:
            return
        for arm, kept in list(self.kept.items()):
            if not self.partly_open(robot, arm):
                del self.kept[arm]  # taken or dropped meanwhile
            elif request.phase != "place" and request.arm in ("", "auto", arm):
                label, aperture = kept.sighting.target.label, robot.aperture(arm)
                raise OpenArmError(
                    Code.NOT_READY,
                    f"the {arm} hand still holds {label!r} (gap {aperture * 1e3:.0f} mm); put it down with phase place"
                    f" (`openarm pick --phase place`), or {release_command(arm)}",
                )

    def partly_open(self, robot: Skills, arm: str) -> bool:
        """Whether something may be between the fingers: they are neither closed on nothing nor wide open.

        A hand that is as wide as when it closed on the object that it kept still holds it, even within the tolerance of
        a wide open one.
        """
        aperture, slip, kept = robot.aperture(arm), self.context.config.held.slip, self.kept.get(arm)
        if kept is not None and kept.closed is not None and abs(aperture - kept.closed) <= slip:
            return True
        return not robot.is_closed(arm) and not robot.is_open(arm)

    async def release(self, robot: Skills, arm: str) -> str:
        """Open a hand where it is, and forget what it held; return what was done, in a sentence.

        Args:
            robot: Carries out.
            arm: Arm of the hand; "": of the one arm that holds something.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for no arm or when both hold something; NOT_READY, when no hand does.
        """
        arms = robot.description.arm_names
        holding = [name for name in arms if name in self.kept or self.partly_open(robot, name)]
        if arm not in ("", *arms):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"arm is {arm!r}; valid: {', '.join(arms)}, or none")
        if not arm and len(holding) != 1:
            raise OpenArmError(
                Code.INVALID_ARGUMENT if holding else Code.NOT_READY,
                f"several hands hold something: say which, {' or '.join(holding)}"
                if holding
                else "no hand holds anything",
            )
        arm = arm or holding[0]
        await robot.open(arm, "release", held=robot.aperture(arm))
        kept = self.kept.pop(arm, None)
        return f"the {arm} hand is open" + (f"; it held {kept.sighting.target.label!r}" if kept else "")

    def to_place(self, request: GraspRequest) -> Grasp:
        """What a request for phase place is about.

        Raises:
            OpenArmError: NOT_READY, when no hand holds anything; INVALID_ARGUMENT, when none holds that.
        """
        kept = list(self.kept.values())
        if not kept:
            raise OpenArmError(Code.NOT_READY, "no hand holds anything that was picked; ask for phase pick first")
        for one in kept:
            if fits(request.label, one.sighting.target) and request.arm in ("", "auto", one.arm):
                return one
        held = ", ".join(f"the {one.arm} hand that holds {one.sighting.target.label!r}" for one in kept)
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"asked to place {request.label or 'an object'!r} with arm {request.arm!r}, but it is {held}",
        )


def release_command(arm: str) -> str:
    """Sentence that names the command that opens a hand."""
    return f"open the hand where it is with `openarm grasp release --arm {arm}`: what it holds falls from there"


# --- what is reported
@dataclass(frozen=True)
class Status:
    """What is reported when a state is entered.

    Attributes:
        state: The state.
        previous: The state before.
        reason: Why it was entered.
        attempt: 1-based number of the attempt, 0 when none runs.
        label: Label of the object, "" while none is known.
        arm: The arm in use, "" while none is chosen.
        failed: The attempt, or what was observed for it, has failed.
        candidates: Grasps that the planner chooses from; in PLAN and MOVE_TO_PREGRASP.
        chosen: Id of the one that was chosen, or "".
        refused: Ids of those that were refused.
        plan: Plan that waits for a person.
        code: Code of the request, when it has ended.
        budget: Longest time that this state is expected to take, s; 0: none.
        late: Sentence that the state before took longer than expected, or "".
    """

    state: State
    previous: State
    reason: str
    attempt: int = 0
    label: str = ""
    arm: str = ""
    failed: bool = False
    candidates: tuple[GraspCandidate, ...] = ()
    chosen: str = ""
    refused: frozenset[str] = frozenset()
    plan: ShownPlan | None = None
    code: str = ""
    budget: float = 0.0
    late: str = ""


Report = Callable[[Status], None]


@dataclass
class Findings:
    """What was found out about an object, for the next strategy when this one refuses it.

    Attributes:
        sighting: The object and its neighbours; None while none is trusted.
        refusals: Why each arm could not be planned for.
        place_refused: One of them could grasp, but not place.
    """

    sighting: Sighting | None = None
    refusals: dict[str, Verdict] = field(default_factory=dict[str, Verdict])
    place_refused: bool = False

    def need_sighting(self) -> Sighting:
        """The sighting, where a strategy only goes on with one."""
        if self.sighting is None:
            raise OpenArmError(Code.INTERNAL, "a strategy needs an object that was observed, and there is none")
        return self.sighting


# --- the request
class Task:
    """A request of a user while strategies carry it out.

    Args:
        session: Session that outlives the request.
        robot: Carries out.
        request: Request.
        report: Called at each state that is entered.
    """

    def __init__(self, session: GraspSession, robot: Skills, request: GraspRequest, report: Report) -> None:
        self.session, self.robot, self.request, self._report = session, robot, request, report
        self.began_ns = robot.now_ns
        self.clock = StateClock(session.context.config.budget, self.began_ns)
        #: Physical attempts so far.
        self.attempts = 0
        #: What the newest part of the request found out about the object.
        self.findings = Findings()
        #: The newest answer to a part of the request.
        self.outcome: GraspOutcome | None = None
        #: How a strategy has moved the object so far without placing it as asked, for the answer.
        self.displaced = ""

    @property
    def context(self) -> GraspContext:
        """Parameters, table and arms."""
        return self.session.context

    @property
    def seconds(self) -> float:
        """Robot time since it was asked for, s."""
        return (self.robot.now_ns - self.began_ns) * 1e-9

    def report(self, status: Status) -> None:
        """Report a state that was entered, and that the one before took longer than expected."""
        late = self.clock.enter(status.state, self.robot.now_ns, waits=status.plan is not None)
        if late:
            self.robot.warn(late)
        self._report(replace(status, budget=self.clock.budget(status.state), late=late))

    def note(self, reason: str, plan: ShownPlan | None = None) -> None:
        """Report what is done between two parts of the request, or a plan that waits there."""
        label, arm = self.request.label, plan.arm if plan else ""
        self.report(Status(State.IDLE, State.IDLE, reason, label=label, arm=arm, plan=plan))

    def may_go_on(self, outcome: GraspOutcome) -> bool:
        """Whether another strategy may try: planning has refused the object where it is, with any arm."""
        free = self.request.phase == "all" and self.request.arm in ("", "auto")
        refused = outcome.kind == "REFUSED" and outcome.code in NO_WAY
        return free and refused and self.findings.sighting is not None and bool(self.findings.refusals)

    def in_time(self, request: GraspRequest) -> GraspRequest:
        """A part of the request, with what is left of the time.

        Raises:
            OpenArmError: TIMEOUT, when nothing is.
        """
        if request.timeout <= 0.0:
            return request
        left = request.timeout - self.seconds
        if left <= 0.0:
            raise OpenArmError(Code.TIMEOUT, f"the {request.timeout:g} s for the request are over; the arms hold")
        return replace(request, timeout=left)

    def answer(self, outcome: GraspOutcome, route: str) -> GraspOutcome:
        """The answer to all of the request; of an object that is neither where it was nor where it should be, where."""
        route = route if outcome.success else ""
        times = self.clock.times(self.robot.now_ns)
        outcome = replace(outcome, attempts=self.attempts, duration=self.seconds, route=route, state_times=times)
        if outcome.success or not self.displaced:
            return outcome
        sighting, text = self.findings.sighting, outcome.message
        if sighting is not None and not outcome.held:
            x, y, _ = sighting.target.p_base
            text = f"{text}; {self.displaced} {outcome.label!r} was seen at ({x:.3f}, {y:.3f}) m"
        return replace(outcome, message=text, moved=True)
