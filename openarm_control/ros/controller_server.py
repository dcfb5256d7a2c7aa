# SPDX-License-Identifier: Apache-2.0
"""Base of the action servers of arms and grippers: a goal starts between two ticks and is awaited in the executor."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future as ThreadFuture
from typing import Any, Generic, TypeVar

from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.actions import ActionServer
from openarm_common.ros.node import BaseNode
from openarm_control.arm import End
from openarm_control.loop import ControlLoop

OutcomeT = TypeVar("OutcomeT")


class ControllerServer(ABC, Generic[OutcomeT]):
    """Serves the action of one controller.

    Args:
        node: Owner.
        loop: Loop whose thread runs the controller.
        check: Refuses a goal, by its id, while another client holds the arm.
        label: Names arm or gripper in the log.
        kind: Type of the action.
        name: Absolute name of the action.
        cancel: Ends the goal that the controller follows; called between two ticks.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        loop: ControlLoop,
        check: Callable[[bytes], None],
        label: str,
        kind: type,
        name: str,
        cancel: Callable[[], None],
    ) -> None:
        self._node = node
        self._loop = loop
        self._check = check
        self._label = label
        self._cancel = cancel
        self._server = ActionServer(
            node, kind, name, self._execute, goal_callback=self._on_goal, cancel_callback=self._on_cancel
        )

    def destroy(self) -> None:
        """Take the action away."""
        self._server.destroy()

    @abstractmethod
    async def _execute(self, handle: ServerGoalHandle) -> Any:
        """Follow a goal and return its result."""

    def _on_goal(self, _request: Any) -> GoalResponse:
        return GoalResponse.ACCEPT

    def _on_cancel(self, _handle: ServerGoalHandle) -> CancelResponse:
        self._loop.call(self._cancel)
        return CancelResponse.ACCEPT

    async def _follow(self, handle: ServerGoalHandle, start: Callable[[Callable[[OutcomeT], None]], None]) -> OutcomeT:
        """Start a goal between two ticks and wait for its end.

        Args:
            handle: Handle of the goal.
            start: Starts it; is given the function that takes the outcome.

        Raises:
            OpenArmError: BUSY, when another client holds the arm; what `start` raised; CANCELLED, when the
                controllers shut down.
        """
        self._check(bytes(handle.goal_id.uuid))
        ended: ThreadFuture[OutcomeT] = ThreadFuture()
        started = self._loop.call(lambda: start(ended.set_result))
        if handle.is_cancel_requested:
            self._loop.call(self._cancel)
        await self._node.awaitable(started)
        if started.cancelled():
            raise OpenArmError(Code.CANCELLED, "the controllers are shutting down")
        outcome: OutcomeT = await self._node.awaitable(ended)
        return outcome

    def _end(self, handle: ServerGoalHandle, end: End, text: str) -> None:
        """Set the state in which the goal ends, and log the reason where it did not succeed."""
        if end is End.SUCCEEDED:
            handle.succeed()
        elif end is End.CANCELLED:
            handle.canceled()
            self._node.get_logger().info(f"{self._label}: {text}")
        else:
            handle.abort()
            self._node.get_logger().warning(f"{self._label}: {text}")
