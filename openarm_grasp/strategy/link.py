# SPDX-License-Identifier: Apache-2.0
"""How the robot, its cameras and its planner are reached, whatever is behind: a node graph, or a world in this process.

Everything is a coroutine that ends: by its work, a deadline, a cancel, or a lost robot. Base frame, m, rad.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Protocol

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.types import Array
from openarm_grasp.strategy import effects
from openarm_grasp.strategy.effects import Frames, GoHome, Planned, Trajectory


class Link(Protocol):
    """See the module's head; robot time in ns."""

    @property
    def description(self) -> RobotDescription:
        """The robot."""
        ...

    @property
    def states(self) -> RobotStateBuffer:
        """Its joint states."""
        ...

    @property
    def base_frame(self) -> str:
        """Name of the base frame."""
        ...

    deadline_ns: int
    """Robot time after which `check` raises CANCELLED; 0: none."""

    @property
    def now_ns(self) -> int:
        """Robot time."""
        ...

    def effort(self, joint: str) -> float:
        """Newest effort of a joint, N or N m; 0 when none is told."""
        ...

    def pads(self, arm: str) -> tuple[float, ...]:
        """Force on each finger pad of a hand, N; empty when no sensor tells it."""
        ...

    def check(self) -> None:
        """Raise when the work shall not go on: CANCELLED, ROBOT_LOST."""
        ...

    def warn(self, text: str) -> None:
        """Say something that does not stop the work."""
        ...

    def stop_looking(self) -> None:
        """The camera is not needed for now."""
        ...

    async def until(
        self, done: Callable[[], bool], limit: float, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        """Wait for a condition, no longer than `limit` s; `guard` is called at each look and may raise."""
        ...

    async def together(self, parts: Sequence[Callable[[], Awaitable[None]]]) -> None:
        """Carry out several things at once; all end before this does, then the first error is raised."""
        ...

    async def observe(self, count: int, *, near: bool = False) -> Frames:
        """Frames of detections that are taken from now on, by the camera over the table or the one on the hand."""
        ...

    async def plan(self, effect: effects.PlanGrasp | effects.PlanPlace) -> Planned:
        """Plan; raises with the planner's code."""
        ...

    async def reach(self, arm: str, T_base_tcp: Array) -> Mapping[str, float]:
        """How far the arm's TCP stays from a point, m by arm; empty when that cannot be said."""
        ...

    async def follow(
        self, arm: str, trajectory: Trajectory, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        """Follow a planned trajectory."""
        ...

    async def move_linear(self, effect: effects.MoveLinear, what: str) -> None:
        """Move the TCP on a straight line."""
        ...

    async def move_named(self, arm: str, named: str, effect: GoHome, what: str) -> None:
        """Move an arm on a free path to a posture."""
        ...

    async def grip(self, arm: str, joint: str, position: float, what: str, effort: float = 0.0) -> bool:
        """Move the fingers with at most `effort` N (0: any); whether they arrived or push against something."""
        ...


def check_deadline(now_ns: int, deadline_ns: int) -> None:
    """Raise CANCELLED when the time of a request is over; for links."""
    if 0 < deadline_ns < now_ns:
        raise OpenArmError(
            Code.CANCELLED, "the time for the request is over; the arm holds, and the hand keeps what it has"
        )
