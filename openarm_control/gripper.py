# SPDX-License-Identifier: Apache-2.0
"""Moving one gripper, like parallel_gripper_action_controller.

Positions, velocities and efforts are those of the driving finger joint (m, N of a slide; rad, N m of a hinge); the
configuration is of a finger, m from the middle, and the lever of the joint group lies between. The command ramps to the
goal and stays there, so a gripper that is stopped by an object keeps pressing with the effort limit. A hand that
presses on something opens from where its fingers are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_control.follower import End, Follower, Tracker
from openarm_control.trajectory import LIMIT_SLACK, JointGroup

#: Type of the action of a gripper: ParallelGripperCommand, or the older GripperCommand.
GripperAction = Literal["parallel", "classic"]

#: Fingers that are this much further open than commanded press on something, m.
_PRESSING = 0.002


class GripperConfig(Config):
    """How grippers move and when they are done."""

    velocity: float = Field(default=0.075, gt=0.0, description="largest speed of a finger, m/s: 0.044 m in 0.6 s")
    first_velocity: float = Field(
        default=0.0075, gt=0.0, description="the same until a goal is reached, after its motor lost a turn, m/s"
    )
    acceleration: float = Field(default=1.0, gt=0.0, description="largest acceleration of a finger, m/s2")
    goal_tolerance: float = Field(default=0.001, gt=0.0, description="a finger this near its goal has reached it, m")
    stall_velocity: float = Field(default=0.001, gt=0.0, description="a finger slower than this does not move, m/s")
    stall_time: float = Field(default=0.2, gt=0.0, description="for how long it must not move to have stalled, s")
    timeout: float = Field(default=3.0, gt=0.0, description="after the ramp, neither reached nor stalled: aborted, s")


@dataclass(frozen=True)
class GripperOutcome:
    """How a gripper goal ended, with position and effort of the finger joint then."""

    end: End
    position: float
    effort: float
    stalled: bool
    reached_goal: bool
    text: str


@dataclass(frozen=True)
class GripperGoal:
    """Goal of a finger joint.

    Args:
        position: m, or rad.
        max_effort: N, or N m; 0 or less is the limit of the gripper.
        max_velocity: m/s, or rad/s; 0 or less is the configured one, which is never exceeded.
    """

    position: float
    max_effort: float = 0.0
    max_velocity: float = 0.0


class GripperFollower(Follower):
    """Moves one gripper. Used by the thread that steps the world; `check` by any.

    Args:
        group: The one driving finger joint.
        config: Speeds and tolerances of a finger.
        position: (1,) where the command starts.
        max_effort: Limit of the gripper.
    """

    def __init__(self, group: JointGroup, config: GripperConfig, position: ArrayLike, max_effort: float) -> None:
        self._lever = abs(group.lever)
        self._velocity = self._fastest = config.velocity / self._lever
        super().__init__(group, Tracker(position, [self._velocity], [config.acceleration / self._lever]))
        self._config = config
        self._done: Callable[[GripperOutcome], None] | None = None
        self._cancelled = False
        self._still_ns = 0
        self._arrived_ns: int | None = None
        self._max_effort = max_effort
        #: Whether the fingers are closed on something: they stay open further than commanded.
        self.pressing = False
        #: Effort that the actuator may use.
        self.effort_limit = max_effort

    @property
    def busy(self) -> bool:
        """See `Follower.busy`."""
        return self._done is not None

    def check(self, goal: GripperGoal) -> GripperGoal:
        """Return the goal.

        Raises:
            OpenArmError: INVALID_ARGUMENT or LIMITS, naming joint and value.
        """
        name, lower, upper = self.group.names[0], float(self.group.lower[0]), float(self.group.upper[0])
        for what, value in (("position", goal.position), ("effort", goal.max_effort), ("velocity", goal.max_velocity)):
            if not np.isfinite(value):
                raise OpenArmError(Code.INVALID_ARGUMENT, f"{what} of {name} is {value}, expected a finite number")
        if not lower - LIMIT_SLACK <= goal.position <= upper + LIMIT_SLACK:
            raise OpenArmError(
                Code.LIMITS,
                f"position of {name} is {goal.position:.4f}, out of its limits {lower:.3f} to {upper:.3f}",
            )
        return goal

    def reset(self, position: ArrayLike) -> None:
        """See `Follower.reset`; the effort limit is the gripper's again."""
        super().reset(position)
        self.effort_limit = self._max_effort

    def begin(self, targets: Array) -> None:
        """See `Follower.begin`: what is held stays held."""
        self._hold(targets)

    def abort(self, why: str) -> None:
        """See `Follower.abort`."""
        self._finish(End.ABORTED, float(self._command.position[0]), 0.0, why)

    def set_target(self, target: Array) -> None:
        """See `Follower.set_target`; speed and effort are the default ones."""
        if not self.busy:
            self._aim(float(target[0]), 0.0, 0.0)

    def halt(self) -> None:
        """Stop the ramp where it is, because commands ceased: a held object stays held; a goal continues."""
        if not self.busy:
            self._target = self._command.position.copy()

    def start(self, goal: GripperGoal, position: float, effort: float, done: Callable[[GripperOutcome], None]) -> None:
        """Follow a checked goal from now on; one that runs is aborted.

        Args:
            goal: Goal from `check`.
            position: Measured now.
            effort: Measured now.
            done: Called once, from `update` or `start`, when the goal ends.
        """
        self._finish(End.ABORTED, position, effort, "a newer goal took its place")
        if self.pressing and (goal.position - position) * self.group.lever > 0.0:
            self._command.hold([position])
        self._aim(goal.position, goal.max_velocity, goal.max_effort)
        self._done, self._cancelled, self._still_ns, self._arrived_ns = done, False, 0, None

    def cancel(self) -> None:
        """Stop the ramp where it is; what is held stays held."""
        self._cancelled = self.busy

    def update(self, t_ns: int, dt_ns: int, position: Array, velocity: Array, effort: Array) -> Array:
        """See `Follower.update`."""
        self.pressing = float(position[0] - self._command.position[0]) * self.group.lever > _PRESSING
        if self._done is not None:
            self._judge(t_ns, dt_ns, float(position[0]), float(velocity[0]), float(effort[0]))
        if self._command.position[0] != self._target[0]:
            fastest = self._config.first_velocity / self._lever if self.careful else self._velocity
            self._command.step(self._target, dt_ns * 1e-9, min(self._velocity, fastest))
        return self._command.position

    def _judge(self, t_ns: int, dt_ns: int, position: float, velocity: float, effort: float) -> None:
        config = self._config
        if self._cancelled:
            self._target = self._command.position.copy()
            self._finish(End.CANCELLED, position, effort, "cancelled; the gripper holds")
            return
        still = abs(velocity) * self._lever <= config.stall_velocity
        self._still_ns = self._still_ns + dt_ns if still else 0
        lag, arrived = self._command.position[0] - position, self._command.position[0] == self._target[0]
        if arrived and self._arrived_ns is None:
            self._arrived_ns = t_ns
        # fingers that lag behind a command which is still on its way have met something, too
        behind = lag * np.sign(self._target[0] - position) * self._lever > _PRESSING
        if arrived and still and abs(position - self._target[0]) * self._lever <= config.goal_tolerance:
            self._finish(End.SUCCEEDED, position, effort, "goal reached", reached=True)
        elif (arrived or behind) and self._still_ns >= config.stall_time * 1e9:
            self._finish(End.SUCCEEDED, position, effort, "stalled", stalled=True)
        elif self._arrived_ns is not None and t_ns - self._arrived_ns > config.timeout * 1e9:
            self._finish(
                End.ABORTED,
                position,
                effort,
                f"{self.group.names[0]} still moves at {velocity:.4f}/s, {config.timeout:g} s after its"
                f" command arrived at {self._target[0]:.4f}",
            )

    def _aim(self, position: float, velocity: float, effort: float) -> None:
        self._target = self._within_limits(np.array([position]))
        self._velocity = velocity if velocity > 0.0 else self._fastest
        self.effort_limit = min(effort, self._max_effort) if effort > 0.0 else self._max_effort

    def _finish(
        self, end: End, position: float, effort: float, text: str, *, stalled: bool = False, reached: bool = False
    ) -> None:
        if self._done is not None:
            done, self._done = self._done, None
            self.careful = "" if end is End.SUCCEEDED else self.careful
            done(GripperOutcome(end, position, effort, stalled, reached, text))
