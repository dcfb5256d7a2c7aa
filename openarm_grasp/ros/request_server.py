# SPDX-License-Identifier: Apache-2.0
"""Takes requests, of one object or of two, one at a time, and carries them out over the node graph."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import Side
from openarm_common.ros.node import BaseNode
from openarm_grasp.context import GraspContext
from openarm_grasp.planning.arms import ARMS
from openarm_grasp.robot.interface import RobotInterface
from openarm_grasp.robot.skills import Skills
from openarm_grasp.ros.graph_robot import GraphRobot
from openarm_grasp.strategies.pair import Pair, PairOutcome
from openarm_grasp.strategies.registry import carry_out, carry_out_pair
from openarm_grasp.strategies.request import GraspOutcome, GraspRequest
from openarm_grasp.strategies.task import GraspSession, Report, Task

T = TypeVar("T")


class RequestServer:
    """See the module's head.

    Args:
        node: The node that owns the clients.
        context: Parameters, table and arms.
    """

    def __init__(self, node: BaseNode[Any], context: GraspContext) -> None:
        self._robot = GraphRobot(node, context.config)
        self._skills = Skills(self._robot, context.config)
        self.session = GraspSession(context)
        self._running: tuple[GraspRequest, ...] = ()

    @property
    def running(self) -> bool:
        """Whether a request is being carried out."""
        return bool(self._running)

    @property
    def now_ns(self) -> int:
        """Robot time; 0 before the first joint state."""
        return self._robot.now_ns

    def cancel(self) -> None:
        """Let what runs end with CANCELLED; arms hold, hands keep what they hold."""
        self._robot.cancel()

    def close(self) -> None:
        """Take the clients down."""
        self._robot.close()

    async def one(self, request: GraspRequest, report: Report) -> GraspOutcome:
        """Carry out a request; `report` is called at each state that is entered.

        Raises:
            OpenArmError: BUSY, NOT_READY or INVALID_ARGUMENT, when it is not taken; CANCELLED before it began.
        """
        return await self._take((request,), lambda: carry_out(Task(self.session, self._skills, request, report)))

    async def two(self, requests: tuple[GraspRequest, GraspRequest], report: Report) -> PairOutcome:
        """Carry out two requests at once.

        Raises:
            OpenArmError: As `one`, when they are not taken.
        """
        robots: dict[Side, RobotInterface] = {arm: self._robot.next_to_other() for arm in ARMS}
        return await self._take(
            requests,
            lambda: carry_out_pair(Pair(self.session, self._skills, robots, requests, report, carry_out)),
        )

    async def _take(self, requests: tuple[GraspRequest, ...], work: Callable[[], Awaitable[T]]) -> T:
        if self._running:
            labels = " and ".join(repr(request.label) if request.label else "an object" for request in self._running)
            raise OpenArmError(Code.BUSY, f"a grasp of {labels} is running; cancel it or wait until it has ended")
        self._running = requests
        try:
            await self._robot.begin(moves=not requests[0].dry_run)
            return await work()
        finally:
            self._robot.end()
            self._running = ()
