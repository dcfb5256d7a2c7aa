# SPDX-License-Identifier: Apache-2.0
"""The grasp as a state machine: no ROS, no clock, no sleeping.

One call of `GraspMachine.step` handles one state: the outcome of the state's recipe is judged (`judges`), the judgement
is an event, the table in `states` says which state follows, and that state's recipe (`recipes`) is returned. Time is
passed in; waiting is an effect.
"""

from __future__ import annotations

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.effects import Effects, GraspOutcome, GraspRequest, Outcome
from openarm_grasp.evidence import Verdict
from openarm_grasp.judges import JUDGES, Judgement, fail, start_over
from openarm_grasp.memory import Memory, Surroundings
from openarm_grasp.recipes import RECIPES
from openarm_grasp.routing import arm_order
from openarm_grasp.states import TRANSITIONS, Event, State

#: These end a request wherever it stands, with the arm where it is.
_STOPS = {Code.CANCELLED: Event.CANCEL, Code.ROBOT_LOST: Event.LOST, Code.INTERNAL: Event.LOST}


class GraspMachine:
    """Decides what a grasp does next.

    Args:
        around: Parameters, table and arms.
    """

    def __init__(self, around: Surroundings) -> None:
        self._around = around
        self._memory: Memory | None = None
        self.state = State.IDLE
        self.previous = State.IDLE
        self.reason = "waiting for a request"
        #: How the last request ended; None while one runs.
        self.outcome: GraspOutcome | None = None
        #: The arm that kept an object in its hand when the last request ended, or "".
        self.carrying = ""

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
            OpenArmError: BUSY, for a request while one runs; INVALID_ARGUMENT, for a request with an unknown arm.
        """
        m = self._memory
        if isinstance(event, GraspRequest):
            if m is not None:
                running = f"a grasp of {m.label or 'any object'!r} is running (state {self.state.value})"
                raise OpenArmError(Code.BUSY, f"{running}; cancel it or wait")
            arm_order(event.arm, 0.0, 0.0)
            self._memory = m = Memory(event, t_ns)
            self.outcome = None
            return self._enter(m, Event.REQUEST, f"asked for {event.label or 'any object'!r}", t_ns)
        if m is None:
            raise OpenArmError(Code.INTERNAL, "an outcome came to the grasp machine while no request runs")
        kind, reason = self._judge(m, event, t_ns)
        return self._enter(m, kind, reason, t_ns)

    def _judge(self, m: Memory, outcome: Outcome, t_ns: int) -> Judgement:
        if outcome.code in _STOPS:
            m.failure = Verdict(outcome.code, outcome.message)
            # Fingers that were closing may have the object between them by now.
            m.hand.holding = m.hand.holding or self.state is State.CLOSE_GRIPPER
            return _STOPS[outcome.code], outcome.message
        try:
            return JUDGES[self.state](m, outcome, t_ns, self._around)
        except OpenArmError as error:
            return fail(m, error.code, error.message, final=True)

    def _enter(self, m: Memory, event: Event, reason: str, t_ns: int) -> Effects:
        came_from, self.state = self.state, TRANSITIONS[self.state][event]
        self.previous, self.reason = came_from, reason
        waits = came_from is State.DETECT and event is Event.AGAIN
        if self.state is State.IDLE and not waits:
            self._finish(m, event, t_ns)
            return ()
        if self.state is State.DETECT and came_from in (State.TRANSFORM, State.PLAN, State.RESET):
            start_over(m, came_from)
        if self.state is State.MOVE_TO_PREGRASP:
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
        )
        self.carrying = m.arm if m.hand.holding else ""
        self._memory = None
