# SPDX-License-Identifier: Apache-2.0
"""Takes requests, one at a time or two that belong together, and carries them out over the node graph."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import Side
from openarm_common.ros.node import BaseNode
from openarm_grasp.planning.routing import ARMS
from openarm_grasp.ros.link_executor import GraphLink
from openarm_grasp.strategy.crew import Crew
from openarm_grasp.strategy.effects import GraspOutcome, GraspRequest
from openarm_grasp.strategy.legs import run_task
from openarm_grasp.strategy.link import Link
from openarm_grasp.strategy.machine import GraspMachine
from openarm_grasp.strategy.memory import Surroundings
from openarm_grasp.strategy.pair import PairOutcome, PairRunner
from openarm_grasp.strategy.performer import Performer

T = TypeVar("T")
Tell = Callable[[GraspMachine], None]


class RequestExecutor:
    """See the module's head.

    Args:
        node: The node that owns the clients.
        around: Parameters, table and arms.
    """

    def __init__(self, node: BaseNode[Any], around: Surroundings) -> None:
        self._config = around.config
        self._link = GraphLink(node, around.config)
        self._performer = Performer(self._link, around.config)
        self._crew = Crew(around)
        self.running = False

    @property
    def machines(self) -> tuple[GraspMachine, GraspMachine]:
        """Both machines; single requests are the first one's, unless the other's hand holds what is to be placed."""
        return self._crew.machines

    @property
    def now_ns(self) -> int:
        """Robot time; 0 before the first joint state."""
        return self._link.now_ns

    def cancel(self) -> None:
        """Let what runs end with CANCELLED; arms hold, hands keep what they hold."""
        self._link.cancel()

    def close(self) -> None:
        """Take the clients down."""
        self._link.close()

    async def one(self, request: GraspRequest, tell: Tell) -> GraspOutcome:
        """Carry out a request; `tell` is called after each transition.

        Raises:
            OpenArmError: BUSY, NOT_READY or INVALID_ARGUMENT, when it is not taken; CANCELLED before it began.
        """

        async def work() -> GraspOutcome:
            machine, performer = self._crew.serving(request), self._performer
            self._crew.check_hands(performer, request)
            if full := self._crew.full_hands_beside(machine):
                free = [arm for arm in ARMS if arm not in full]
                performer = Performer(self._link, self._config, arms=free)
            return await run_task(machine, performer, request, lambda: tell(machine))

        return await self._taken(work, moves=not request.dry_run)

    async def two(self, requests: tuple[GraspRequest, GraspRequest], tell: Tell) -> PairOutcome:
        """Carry out two requests at once.

        Raises:
            OpenArmError: As `one`, when they are not taken.
        """

        async def work() -> PairOutcome:
            links: dict[Side, Link] = {arm: self._link.beside() for arm in ARMS}
            return await PairRunner(self.machines, links, self._performer, tell).run(requests)

        return await self._taken(work, moves=not requests[0].dry_run)

    async def _taken(self, work: Callable[[], Awaitable[T]], *, moves: bool) -> T:
        if self.running:
            labels = " and ".join(repr(label) if label else "an object" for label in self._crew.running)
            text = f"a grasp of {labels or 'an object'} is running; cancel it or wait until it has ended"
            raise OpenArmError(Code.BUSY, text)
        self.running = True
        try:
            await self._link.begin(moves=moves)
            return await work()
        finally:
            self._link.end()
            self.running = False
