# SPDX-License-Identifier: Apache-2.0
"""How long a request spends in each state, and whether that is longer than expected. Robot time, s."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

from openarm_grasp.config import BudgetConfig
from openarm_grasp.requests.states import State


@dataclass(frozen=True)
class StateTime:
    """Time in one state.

    Attributes:
        state: Its name.
        duration: Duration of all visits, s.
        budget: Budget of a visit, s; 0: none.
        longest: Visit, s, without the time that a person took to confirm a plan.
    """

    state: str
    duration: float
    budget: float
    longest: float

    @property
    def exceeded(self) -> bool:
        """Whether a visit took longer than expected."""
        return 0.0 < self.budget < self.longest


class StateClock:
    """Measures the states of a request as they are entered; one that is entered again is the same visit.

    Args:
        budgets: Time that each may take.
        t_ns: When the request begins.
    """

    def __init__(self, budgets: BudgetConfig, t_ns: int) -> None:
        self._budgets, self._since_ns = budgets, t_ns
        self._state, self._waits, self._told = State.IDLE, False, False
        self._visit = 0.0
        self._durations = defaultdict[State, float](float)
        self._longest = defaultdict[State, float](float)

    def budget(self, state: State) -> float:
        """Longest visit that is expected, s; 0: none."""
        return float(getattr(self._budgets, state.value.lower(), 0.0))

    def enter(self, state: State, t_ns: int, *, waits: bool = False) -> str:
        """Note that a state is entered.

        Args:
            state: State that is entered.
            t_ns: When.
            waits: A person is waited for, until the next is entered.

        Returns:
            A sentence, when the state that ends has taken longer than expected; once a visit.
        """
        self._advance(t_ns)
        ended, visit, budget = self._state, self._visit, self.budget(self._state)
        late = 0.0 < budget < visit and not self._told
        self._told = (self._told or late) and state is ended
        if state is not ended:
            self._visit = 0.0
        self._state, self._waits = state, waits
        return f"{ended.value} took {visit:.1f} s, expected at most {budget:g} s" if late else ""

    def times(self, t_ns: int) -> tuple[StateTime, ...]:
        """Time in each state until now, in the order in which they were entered first."""
        self._advance(t_ns)
        rows = ((state, seconds) for state, seconds in self._durations.items() if seconds > 0.0)
        return tuple(StateTime(s.value, seconds, self.budget(s), self._longest[s]) for s, seconds in rows)

    def _advance(self, t_ns: int) -> None:
        seconds, self._since_ns = (t_ns - self._since_ns) * 1e-9, t_ns
        self._durations[self._state] += seconds
        self._visit += 0.0 if self._waits else seconds
        self._longest[self._state] = max(self._longest[self._state], self._visit)
