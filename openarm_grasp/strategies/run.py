# SPDX-License-Identifier: Apache-2.0
"""What has been learned since a request came: the state, the object, failures, and where the hand is. Base frame, m."""

from __future__ import annotations

from dataclasses import replace

from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_grasp.evidence.verdicts import Verdict
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.perception.sightings import standing_at
from openarm_grasp.planning import retries
from openarm_grasp.planning.candidates import GraspCandidate, PlaceTarget
from openarm_grasp.planning.offers import asked, offers
from openarm_grasp.planning.options import Options
from openarm_grasp.requests.confirm import ShownPlan
from openarm_grasp.requests.request import Feasible, GraspOutcome, GraspRequest, Proof
from openarm_grasp.requests.states import Hand, State, check_transition
from openarm_grasp.requests.task import Findings, Grasp, Placed, Status, Task
from openarm_grasp.robot.interface import Planned
from openarm_grasp.sampling.samplers import Sampling


class Run:
    """What has been learned since the request came.

    Args:
        task: Task that this is a part of.
        request: Request; a retry keeps to the same object.
        kept: Grasp of an earlier request that still holds, when it is this one's to place.
    """

    def __init__(self, task: Task, request: GraspRequest, kept: Grasp | None) -> None:
        self.task, self.kept = task, kept
        near, parts = task.session.parts_of(request.exclude_near)
        self.request = replace(request, exclude_near=near, exclude_parts=(*request.exclude_parts, *parts))
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
        #: (3,) where the object was seen last, m; None before.
        self.seen_at: Array | None = None
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
        task.session.runs.append(self)

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
        status = Status(state, previous, reason, self.attempt, self.label, self.arm, failed, plan=plan)
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
        offered = offers(self.context, arm, sighting, self.failed)
        return retries.among(offered, sighting.target, self.failed)

    def asked(self, arm: str, sighting: Sighting) -> Sampling:
        """Return what a sampler is given."""
        return asked(self.context, arm, sighting, self.failed)

    def start_again(self, grasp: Grasp, placed: Placed | None) -> str:
        """Begin the next attempt at the same object, the failed grasp remembered; returns why.

        Args:
            grasp: Grasp that has failed.
            placed: Place where the object was put down, when it was.

        Raises:
            OpenArmError: the failure, when no attempt is left or another would not help.
        """
        failure = self.failure or Verdict(Code.INTERNAL, "an attempt ended without a failure")
        same = grasp.sighting
        if placed is not None:
            same = replace(same, target=standing_at(same.target, placed.target.position))
        phase = "all" if self.kept else self.request.phase
        self.request = replace(self.request.about(same), phase=phase)
        if failure.final or self.attempt >= self.config.limits.max_attempts:
            raise OpenArmError(failure.code, failure.reason)
        target = grasp.sighting.target
        self.failed += (retries.FailedGrasp.of(failure.code, grasp.arm, grasp.candidate, target, grasp.heavy),)
        self.attempt += 1
        self.missed = self.plans_failed = 0
        self.kept = None
        self.forget()
        return failure.reason

    def end(self, outcome: GraspOutcome) -> GraspOutcome:
        """Report that the request has ended; returns the answer.

        Raises:
            OpenArmError: INTERNAL, when it may not end in this state.
        """
        self.task.session.end(self, outcome)
        check_transition(self.state, State.IDLE)
        about = Status(State.IDLE, self.state, outcome.message, label=outcome.label, arm=outcome.arm)
        self.task.report(replace(about, code=outcome.code.value))
        return outcome

    def answer(self, code: Code, message: str, proof: Proof | Feasible | None = None) -> GraspOutcome:
        """The answer to the request."""
        x, y, z = (float(v) for v in (self.place_target.position if self.place_target else (0.0, 0.0, 0.0)))
        seen = (
            None if self.seen_at is None else (float(self.seen_at[0]), float(self.seen_at[1]), float(self.seen_at[2]))
        )
        return GraspOutcome(
            code=code,
            message=message,
            label=self.label,
            arm=self.arm,
            attempts=self.tried,
            place_position=(x, y, z),
            object_position=seen,
            duration=(self.robot.now_ns - self.began_ns) * 1e-9,
            held=self.holding,
            options=tuple(self.options.values()),
            state_times=self.task.clock.times(self.robot.now_ns),
            proof=proof,
        )
