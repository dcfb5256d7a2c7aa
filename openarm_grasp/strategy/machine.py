# SPDX-License-Identifier: Apache-2.0
"""The grasp as a state machine: no ROS, no clock, no sleeping.

One call of `GraspMachine.step` handles one state: the outcome of the state's recipe is judged (`judges`), the judgement
is an event, the table in `states` says which state follows, and that state's recipe (`recipes`) is returned. Time is
passed in; waiting is an effect.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.evidence.drift import DriftWatch
from openarm_grasp.evidence.evidence import Verdict
from openarm_grasp.evidence.judges import JUDGES, start_over
from openarm_grasp.planning.routing import arm_order
from openarm_grasp.strategy.effects import Effects, GraspOutcome, GraspRequest, Outcome
from openarm_grasp.strategy.memory import Hand, Judgement, Kept, Known, Memory, Surroundings
from openarm_grasp.strategy.recipes import RECIPES
from openarm_grasp.strategy.states import TRANSITIONS, Event, State, load_transitions

#: What a request may ask for.
PHASES = ("all", "pick", "place")
#: These end a request wherever it stands, with the arm where it is.
_STOPS = {Code.CANCELLED: Event.CANCEL, Code.ROBOT_LOST: Event.LOST, Code.INTERNAL: Event.LOST}


class GraspMachine:
    """Decides what a grasp does next.

    Args:
        around: Parameters, table and arms.
        drift: What grasps say about the camera, when another machine's do, too.
    """

    def __init__(self, around: Surroundings, drift: DriftWatch | None = None) -> None:
        self._around = around
        path = around.config.transitions
        self._transitions = load_transitions(Path(path)) if path else TRANSITIONS
        self._memory: Memory | None = None
        self.state = State.IDLE
        self.previous = State.IDLE
        self.reason = "waiting for a request"
        #: How the last request ended; None while one runs.
        self.outcome: GraspOutcome | None = None
        #: What grasps say about the camera.
        self.drift = drift or DriftWatch(around.config.drift)
        #: What stayed in a hand when the last request ended.
        self.kept: Kept | None = None
        #: What was seen of the last object, and why arms were refused for it, when its request ended.
        self.known: Known | None = None

    @property
    def around(self) -> Surroundings:
        """Parameters, table and arms."""
        return self._around

    def note(self, reason: str) -> None:
        """Say what is done between two requests that belong together."""
        self.previous, self.reason = self.state, reason

    @property
    def carrying(self) -> str:
        """The arm that kept an object in its hand when the last request ended, or ""."""
        return self.kept.arm if self.kept else ""

    @property
    def memory(self) -> Memory | None:
        """What is known of the running request; None when none runs."""
        return self._memory

    @property
    def attempt(self) -> int:
        """1-based number of the running attempt, 0 when none runs."""
        return self._memory.attempt if self._memory else 0

    @property
    def label(self) -> str:
        """What is picked, "" when nothing is."""
        return self._memory.label if self._memory else ""

    @property
    def arm(self) -> str:
        """The arm in use, "" while none is chosen."""
        return self._memory.arm if self._memory else ""

    def step(self, event: GraspRequest | Outcome, t_ns: int) -> Effects:
        """Take one step.

        Args:
            event: A request, or what came of the recipe that the last step returned.
            t_ns: Now, robot time.

        Returns:
            The recipe of the state that follows; empty when the request has ended and `outcome` says how.

        Raises:
            OpenArmError: BUSY, for a request while one runs; INVALID_ARGUMENT, for one with an unknown arm or phase;
                NOT_READY, for a place when no hand holds anything.
        """
        m = self._memory
        if isinstance(event, GraspRequest):
            if m is not None:
                running = f"a grasp of {m.label or 'any object'!r} is running (state {self.state.value})"
                raise OpenArmError(Code.BUSY, f"{running}; cancel it or wait")
            arm_order(event.arm, 0.0, 0.0)
            if event.phase not in PHASES:
                raise OpenArmError(
                    Code.INVALID_ARGUMENT, f"phase {event.phase!r} does not exist; valid: {', '.join(PHASES)}"
                )
            self._memory = m = self._place_request(event, t_ns) if event.phase == "place" else Memory(event, t_ns)
            self.outcome = None
            why = f"; {event.why}" if event.why else ""
            return self._enter(m, Event.REQUEST, f"asked for {event.label or 'any object'!r}{why}", t_ns)
        if m is None:
            raise OpenArmError(Code.INTERNAL, "an outcome came to the grasp machine while no request runs")
        kind, reason = self._judge(m, event, t_ns)
        if m.residual is not None:
            self.drift.add(self._around.config.camera, *m.residual)
            m.residual = None
        return self._enter(m, kind, reason, t_ns)

    def _place_request(self, request: GraspRequest, t_ns: int) -> Memory:
        kept = self.kept
        if kept is None:
            raise OpenArmError(Code.NOT_READY, "no hand holds anything that was picked; ask for phase pick first")
        label = kept.target.label
        if request.label not in ("", label) or request.arm not in ("", "auto", kept.arm):
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"asked to place {request.label or 'an object'!r} with arm {request.arm!r}, but it is the"
                f" {kept.arm} hand that holds {label!r}",
            )
        return Memory(replace(request, label=label), t_ns, arm=kept.arm, kept=kept, hand=Hand(holding=True))

    def _judge(self, m: Memory, outcome: Outcome, t_ns: int) -> Judgement:
        if outcome.code in _STOPS:
            late = 0.0 < m.request.timeout <= (t_ns - m.started_ns) * 1e-9 and outcome.code is Code.CANCELLED
            m.failure = Verdict(Code.TIMEOUT if late else outcome.code, outcome.message)
            # Fingers that were closing may have the object between them by now.
            m.hand.holding = m.hand.holding or self.state is State.CLOSE_GRIPPER
            return _STOPS[outcome.code], outcome.message
        try:
            return JUDGES[self.state](m, outcome, t_ns, self._around)
        except OpenArmError as error:
            return m.fail(error.code, error.message, final=True)

    def _enter(self, m: Memory, event: Event, reason: str, t_ns: int) -> Effects:
        came_from, self.state = self.state, self._transitions[self.state][event]
        self.previous, self.reason = came_from, reason
        waits = came_from is State.DETECT and event is Event.AGAIN
        if self.state is State.IDLE and not waits:
            self._finish(m, event, t_ns)
            return ()
        if self.state is State.DETECT and came_from in (State.TRANSFORM, State.PLAN, State.RESET):
            start_over(m, came_from)
        if self.state in (State.MOVE_TO_PREGRASP, State.PLACE) and came_from in (State.PLAN, State.TRANSFORM):
            m.tried += 1
        return RECIPES[self.state](m, self._around)

    def _finish(self, m: Memory, event: Event, t_ns: int) -> None:
        done = m.failure or Verdict(Code.OK, self.reason)
        placed = m.place_target is not None and not m.hand.putting_back
        x, y, z = (float(v) for v in (m.place_target.position if m.place_target and placed else (0.0, 0.0, 0.0)))
        self.outcome = GraspOutcome(
            code=done.code,
            message=done.reason,
            label=m.label,
            arm=m.arm,
            attempts=m.tried,
            place_position=(x, y, z),
            duration=(t_ns - m.started_ns) * 1e-9,
            held=m.hand.holding,
            options=tuple(m.options.values()),
        )
        self.known = Known(m.sighting, dict(m.refusals), m.place_refused) if m.sighting is not None else None
        if m.hand.holding and m.sighting is not None and m.candidate is not None:
            self.kept = Kept(m.arm, m.sighting.target, m.candidate)
        elif not m.hand.holding and not m.request.dry_run:
            self.kept = None
        self._memory = None
