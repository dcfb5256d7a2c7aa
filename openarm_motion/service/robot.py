# SPDX-License-Identifier: Apache-2.0
"""What the motion service needs of a robot: joint states, controllers, a clock, and waiting.

`RobotInterface` is implemented twice: over the node graph (`openarm_motion.ros.robot`) and in one process with the
simulation (`openarm_evaluation.campaign.robot`).
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeVar

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.robot_state import RobotStateBuffer

if TYPE_CHECKING:
    from openarm_motion.timing.trajectory import Motion

T = TypeVar("T")

#: A joint state no older than this shows where the robot is, s.
_FRESH = 0.5
#: Joint states have this long to appear before a motion, s.
_READY = 1.0
#: A longer pause between two wakes is this process being starved, not the robot being silent, s.
_STARVED = 0.1


@dataclass(frozen=True)
class GoalOutcome:
    """How a controller ended a trajectory; `text` and `code` are its reason after a failure."""

    success: bool
    text: str = ""
    code: Code = Code.EXECUTION_FAILED


class TrajectoryGoal(Protocol):
    """A trajectory that was sent to a controller."""

    @property
    def accepted(self) -> bool | None:
        """Whether the controller took it; None while it has not answered."""
        ...

    @property
    def since_ns(self) -> int:
        """Robot time at which it began, as the controller says; 0 while that has not said so."""
        ...

    @property
    def outcome(self) -> GoalOutcome | None:
        """How it ended; None before."""
        ...

    def cancel(self) -> None:
        """Withdraw it: the arm comes to rest and holds."""
        ...


class ArmController(Protocol):
    """The trajectory controller of one arm."""

    @property
    def name(self) -> str:
        """For messages."""
        ...

    @property
    def fastest(self) -> float:
        """Largest speed of a joint that it follows now, rad/s; infinite where the limits of the joints are all."""
        ...

    def ready(self) -> bool:
        """Whether it is there."""
        ...

    def start(self, motion: Motion, begin_ns: int, *, touches: bool) -> TrajectoryGoal:
        """Send a trajectory.

        Args:
            motion: The trajectory.
            begin_ns: Robot time of its beginning; 0: at once.
            touches: Something is touched where it ends: the controller brings the joints as near as it can. Else they
                have arrived within the goal tolerance of `ExecutionConfig`.
        """
        ...


class RobotInterface(Protocol):
    """A robot, the clock that deadlines are measured with, and where work and coroutines run."""

    @property
    def states(self) -> RobotStateBuffer:
        """Joint states and frames; their newest stamp is robot time."""
        ...

    def state_age(self) -> float:
        """Time since the newest joint state arrived, s; infinite before the first."""
        ...

    def now(self) -> float:
        """Monotonic time, s."""
        ...

    def controller(self, arm: str) -> ArmController:
        """The controller of an arm."""
        ...

    async def pause(self) -> None:
        """Give control back until something may have changed."""
        ...

    async def compute(self, work: Callable[[], T], nominal: float = 0.1) -> T:
        """Run work that takes some ms; `nominal` is its duration where time is simulated, s."""
        ...

    async def together(self, parts: Sequence[Callable[[], Awaitable[None]]]) -> None:
        """Run several coroutines concurrently until all have ended; then raise the first error."""
        ...


class RobotWatch:
    """Waits for conditions, and measures how long the robot has been silent while this process was awake.

    Messages wait unread while a process is starved, so silence counts only between wakes that are close together.

    Args:
        robot: The robot.
    """

    def __init__(self, robot: RobotInterface) -> None:
        self._robot = robot
        self._woke = robot.now()
        #: Time without a joint state, s.
        self.silence = 0.0
        #: Time from the last wake but one to the last one, s; at most `_STARVED`.
        self.awake = 0.0

    async def until(
        self, done: Callable[[], bool], check: Callable[[], None] = lambda: None, limit: float = math.inf
    ) -> bool:
        """Wait for a condition.

        Args:
            done: The condition.
            check: Called at each wake; may raise.
            limit: Longest wait, s.

        Returns:
            Whether the condition holds.
        """
        end = self._robot.now() + limit
        while not done():
            if self._robot.now() > end:
                return False
            await self._robot.pause()
            now = self._robot.now()
            self.awake, self._woke = min(now - self._woke, _STARVED), now
            self.silence = min(self._robot.state_age(), self.silence + self.awake)
            if done():
                break
            check()
        return True

    async def fresh(self) -> None:
        """Wait a moment for a fresh joint state.

        Raises:
            OpenArmError: NOT_READY, when none comes.
        """
        if not await self.until(lambda: self._robot.state_age() <= _FRESH, limit=_READY):
            raise stale(self._robot.state_age())


def stale(age: float) -> OpenArmError:
    """Return the error for joint states that are `age` seconds old."""
    when = "none yet" if math.isinf(age) else f"the last is {age:.1f} s old"
    return OpenArmError(Code.NOT_READY, f"no fresh /joint_states ({when}); is the bridge or driver running?")
