# SPDX-License-Identifier: Apache-2.0
"""Following joint trajectories with one arm, like joint_trajectory_controller.

Positions are rad, velocities rad/s, arrays (k,) in the order of the group's joints; times are simulated time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from openarm_common.config import Config
from openarm_common.errors import Code
from openarm_common.robot.turns import nearest_turns
from openarm_common.types import Array
from openarm_control.carrier import Carrier, CarrierConfig
from openarm_control.follower import End, Follower, Tracker
from openarm_control.trajectory import (
    JointGroup,
    JointSpline,
    Trajectory,
    TrajectoryError,
    TrajectoryResult,
    check_speed,
    checked,
)

#: A trajectory that starts later than this has most likely a stamp of another clock.
_MAX_DELAY_NS = 600_000_000_000


class TrajectoryConfig(Config):
    """How arms follow trajectories and position commands."""

    path_tolerance: float = Field(default=0.05, gt=0.0, description="default deviation from the path, rad")
    goal_tolerance: float = Field(default=0.02, gt=0.0, description="default deviation from the goal, rad")
    goal_time: float = Field(default=1.0, gt=0.0, description="default time after the end to reach the goal, s")
    stopped_velocity: float = Field(
        default=0.05, gt=0.0, description="at the goal the joints are slower than this, rad/s"
    )
    stop_time: float = Field(default=0.15, gt=0.0, le=2.0, description="a cancelled arm comes to rest in this time, s")
    blend_time: float = Field(default=0.2, gt=0.0, description="a small offset at the start fades in this time, s")
    new_goal: Literal["replace", "refuse"] = Field(
        default="replace", description="what a goal does that comes while the arm follows another"
    )
    carrier: CarrierConfig = CarrierConfig()
    first_velocity: float = Field(
        default=0.3,
        gt=0.0,
        description="largest speed of a joint until its arm has arrived once, after a motor of it lost a turn, rad/s",
    )
    command_timeout: float = Field(
        default=0.5, gt=0.0, le=60.0, description="arm and gripper hold when no /joint_commands came for so long, s"
    )
    command_velocity: float = Field(
        default=1.5, gt=0.0, description="largest speed towards a /joint_commands target, rad/s"
    )
    command_acceleration: float = Field(default=8.0, gt=0.0, description="and its largest acceleration, rad/s2")


@dataclass(frozen=True)
class TrajectoryOutcome:
    """How following a trajectory ended."""

    end: End
    result: TrajectoryResult
    text: str


@dataclass(frozen=True)
class FollowerState:
    """What a follower was doing at `t_ns`: desired and measured position and velocity (k,), and the servos' targets.

    `time_from_start` is how long it had followed its trajectory then, s; 0 without one and before its start.
    """

    t_ns: int
    time_from_start: float
    desired: Array
    desired_velocity: Array
    actual: Array
    actual_velocity: Array
    target: Array


@dataclass
class _Goal:
    spline: JointSpline
    start_ns: int
    path_tolerance: Array
    goal_tolerance: Array
    goal_time_s: float
    lenient: bool  # it has a goal tolerance of its own: what is within it is not worked off
    offset: Array  # (k,) present command minus first point; fades
    blend_from_s: float
    blend_time_s: float
    done: Callable[[TrajectoryOutcome], None]
    tau_s: float  # time along the trajectory, to which the command was last moved
    rate: float = 1.0  # of that time; falls to 0 when cancelled
    cancelled: bool = False
    settled: bool = False  # what the carrier can work off at the end is worked off


class TrajectoryFollower(Follower):
    """Follows trajectories with one arm. Used by the thread that steps the world; `check` by any.

    Args:
        group: The joints.
        config: Tolerances and limits.
        carrier: Makes servo targets of the command.
        position: (k,) where the command starts.
    """

    def __init__(self, group: JointGroup, config: TrajectoryConfig, carrier: Carrier, position: Array) -> None:
        k = len(group.names)
        command = Tracker(position, np.full(k, config.command_velocity), np.full(k, config.command_acceleration))
        super().__init__(group, command)
        self._config = config
        self._carrier = carrier
        self._goal: _Goal | None = None
        self.state: FollowerState | None = None

    @property
    def busy(self) -> bool:
        """See `Follower.busy`."""
        return self._goal is not None

    @property
    def fastest(self) -> float:
        """Largest speed of a joint that is followed now beyond the limits of the joints, rad/s."""
        return self._config.first_velocity if self.careful else np.inf

    def check(self, trajectory: Trajectory) -> Trajectory:
        """Return the trajectory in the order of the joints.

        Raises:
            TrajectoryError: Same as `openarm_control.trajectory.checked`.
        """
        return checked(trajectory, self.group)

    def abort(self, why: str) -> None:
        """See `Follower.abort`."""
        if self._goal is not None:
            self._command.velocity = np.zeros_like(self._command.velocity)
        self._finish(End.ABORTED, TrajectoryResult.INVALID_GOAL, why)

    def stop(self, why: str) -> None:
        """See `Follower.stop`."""
        self._finish(End.ABORTED, TrajectoryResult.STOPPED, why)
        super().stop(why)

    def start(
        self, trajectory: Trajectory, t_ns: int, measured: Array, done: Callable[[TrajectoryOutcome], None]
    ) -> None:
        """Follow a checked trajectory from now on; one that runs is aborted, or the new one refused, as configured.

        Args:
            trajectory: Trajectory from `check`.
            t_ns: Present time.
            measured: (k,) present positions.
            done: Called once, from `update` or `start`, when the goal ends.

        Raises:
            TrajectoryError: OLD_HEADER_TIMESTAMP, when it would have ended already; PATH_TOLERANCE_VIOLATED, when it
                starts elsewhere; INVALID_GOAL, when its first point can't be reached in time or its start is far away,
                the arm is careful and it is fast, or the arm is busy and new goals are refused.
        """
        if self._goal is not None and self._config.new_goal == "refuse":
            raise TrajectoryError(
                f"the arm follows a trajectory for another {self._goal.spline.end_s - self._goal.tau_s:.2f} s, and new"
                " goals are refused meanwhile (parameter trajectory.new_goal); cancel it or wait for its end",
                code=Code.BUSY,
            )
        goal = self._goal_of(trajectory, t_ns, measured, done)
        self._finish(End.ABORTED, TrajectoryResult.INVALID_GOAL, "a newer trajectory took its place")
        self._goal = goal

    def cancel(self) -> None:
        """Slow down along the trajectory and hold."""
        if self._goal is not None:
            self._goal.cancelled = True

    def update(self, t_ns: int, dt_ns: int, position: Array, velocity: Array, effort: Array) -> Array:
        """See `Follower.update`."""
        desired, desired_velocity, dt = self._command.position, self._command.velocity, dt_ns * 1e-9
        error = desired - position
        elapsed = 0.0 if self._goal is None else max(0.0, self._goal.tau_s)
        if self._goal is not None:
            self._judge(self._goal, t_ns, dt, position, velocity)
        if self._goal is not None:
            self._advance(self._goal, t_ns, dt_ns)
        elif not np.array_equal(self._target, self._command.position):
            self._command.step(self._target, dt, self.fastest)
        slip = desired_velocity - velocity
        target = self._carrier.target(self._command.position, self._command.velocity, error, slip, dt)
        self.state = FollowerState(t_ns, elapsed, desired, desired_velocity, position, velocity, target)
        return target

    @property
    def carrier(self) -> Carrier:
        """What makes the targets."""
        return self._carrier

    def carry_by(self, carrier: Carrier) -> None:
        """Let another carrier make the targets, because more is known of the servos; for an arm at rest or moving."""
        carrier.succeed(self._carrier)
        self._carrier = carrier

    def reset(self, position: ArrayLike) -> None:
        """See `Follower.reset`."""
        super().reset(position)
        self._carrier.reset()

    def begin(self, targets: Array) -> None:
        """See `Follower.begin`."""
        self._carrier.begin(targets - self._command.position)

    def _judge(self, goal: _Goal, t_ns: int, dt: float, position: Array, velocity: Array) -> None:
        """End the goal if it is reached, or the arm is not where it should be."""
        tau = (t_ns - goal.start_ns) * 1e-9
        error = self._command.position - position
        names, config = self.group.names, self._config
        arrived = np.all(np.abs(error) <= goal.goal_tolerance) and np.all(np.abs(velocity) <= config.stopped_velocity)
        if goal.cancelled and goal.rate <= 0.0:
            self._target = self._command.position.copy()
            self._finish(End.CANCELLED, TrajectoryResult.SUCCESSFUL, "cancelled; the arm holds")
        elif tau < goal.spline.end_s or goal.cancelled:
            j = int(np.argmax(np.abs(error) - goal.path_tolerance))
            if tau > 0.0 and abs(error[j]) > goal.path_tolerance[j]:
                self._hold(position)
                self._finish(
                    End.ABORTED,
                    TrajectoryResult.PATH_TOLERANCE_VIOLATED,
                    f"{names[j]} is {abs(error[j]):.3f} rad off its path at {tau:.2f} s of {goal.spline.end_s:.2f},"
                    f" tolerance {goal.path_tolerance[j]:.3f}; the arm holds where it is. Is something blocking it?",
                )
        elif self._settles(goal, tau - goal.spline.end_s, error, dt, near_enough=goal.lenient and bool(arrived)):
            pass
        elif arrived:
            self._finish(End.SUCCEEDED, TrajectoryResult.SUCCESSFUL, "goal reached")
        elif tau > goal.spline.end_s + goal.goal_time_s:
            j = int(np.argmax(np.abs(error) - goal.goal_tolerance))
            self._finish(
                End.ABORTED,
                TrajectoryResult.GOAL_TOLERANCE_VIOLATED,
                f"{names[j]} is {abs(error[j]):.3f} rad off its goal and moves at {abs(velocity[j]):.3f} rad/s,"
                f" {goal.goal_time_s:.2f} s after the end; expected within {goal.goal_tolerance[j]:.3f} rad and"
                f" {config.stopped_velocity:.3f} rad/s",
            )

    def _settles(self, goal: _Goal, over_s: float, error: Array, dt: float, *, near_enough: bool) -> bool:
        """Let the carrier work off what is left at the end of a motion; whether it still does."""
        config = self._carrier.config
        if not self._carrier.settles or goal.settled:
            return False
        timely = over_s <= config.settle_time and not near_enough
        goal.settled = not timely or self._carrier.settled(self._command.position, error)
        if goal.settled:
            self._carrier.weigh(self._command.position, error)
        else:
            self._carrier.settle(error, dt)
        return not goal.settled

    def _advance(self, goal: _Goal, t_ns: int, dt_ns: int) -> None:
        """Move the command to where the trajectory is at the end of the coming tick."""
        if goal.cancelled:
            before = goal.rate
            goal.rate = max(0.0, before - dt_ns * 1e-9 / self._config.stop_time)
            goal.tau_s += 0.5 * (before + goal.rate) * dt_ns * 1e-9
        else:
            goal.tau_s = (t_ns + dt_ns - goal.start_ns) * 1e-9
        q, v = goal.spline.sample(goal.tau_s)
        u = min(1.0, max(0.0, (goal.tau_s - goal.blend_from_s) / goal.blend_time_s))
        if u < 1.0:
            q = q + goal.offset * (1.0 - u * u * (3.0 - 2.0 * u))
        self._command.position, self._command.velocity = q, v * goal.rate
        self._target = q.copy()

    def _goal_of(
        self, trajectory: Trajectory, t_ns: int, measured: Array, done: Callable[[TrajectoryOutcome], None]
    ) -> _Goal:
        start_ns = trajectory.start_ns or t_ns
        elapsed = max(0.0, (t_ns - start_ns) * 1e-9)
        path = self._tolerances(trajectory.path_tolerance, self._config.path_tolerance)
        t, q, v, a = trajectory.t, trajectory.q, trajectory.v, trajectory.a
        if t[-1] < elapsed:
            raise TrajectoryError(
                f"the trajectory ended {elapsed - t[-1]:.2f} s ago (stamp {start_ns * 1e-9:.2f} s, now"
                f" {t_ns * 1e-9:.2f} s); leave the stamp zero to start at once",
                TrajectoryResult.OLD_HEADER_TIMESTAMP,
            )
        if start_ns - t_ns > _MAX_DELAY_NS:
            raise TrajectoryError(
                f"the trajectory would start in {(start_ns - t_ns) * 1e-9:.0f} s (stamp {start_ns * 1e-9:.2f} s, now"
                f" {t_ns * 1e-9:.2f} s); leave the stamp zero, or set use_sim_time so that the stamp is simulated time",
            )
        ahead = t >= elapsed
        t, q = t[ahead], q[ahead]
        v, a = (None if x is None else x[ahead] for x in (v, a))
        command, speed = self._command.position, self._command.velocity
        q = q + (nearest_turns(q[0], command, self.group.upper) - q[0])  # the command goes on from where it is
        offset = np.zeros_like(command)
        if t[0] > elapsed:  # the motion to the first point is part of the curve
            self._check_first_point(q[0], t[0] - elapsed)
            t, q = np.concatenate([[elapsed], t]), np.vstack([command, q])
            v = None if v is None else np.vstack([speed, v])
            a = None if a is None else np.vstack([np.zeros_like(command), a])
        else:
            self._check_start(q[0], measured, path)
            offset = command - q[0]
        if self.careful:
            why = (
                f" until this arm has arrived once: {self.careful}; send it slower, or have /motion/move plan it, which"
                " keeps this limit"
            )
            check_speed(t, q, v, np.minimum(self.group.max_velocity, self.fastest), self.group, why)
        return _Goal(
            spline=JointSpline(t, q, v, a),
            start_ns=start_ns,
            path_tolerance=path,
            goal_tolerance=self._tolerances(trajectory.goal_tolerance, self._config.goal_tolerance),
            goal_time_s=_or_default(trajectory.goal_time_s, self._config.goal_time),
            lenient=any(tolerance > 0.0 for tolerance in trajectory.goal_tolerance.values()),
            offset=offset,
            blend_from_s=elapsed,
            blend_time_s=max(1e-3, min(self._config.blend_time, float(t[-1] - elapsed))),
            done=done,
            tau_s=(t_ns - start_ns) * 1e-9,
        )

    def _check_first_point(self, first: Array, seconds: float) -> None:
        speed = np.abs(first - self._command.position) / seconds
        j = int(np.argmax(speed / self.group.max_velocity))
        if speed[j] > self.group.max_velocity[j]:
            raise TrajectoryError(
                f"{self.group.names[j]} would have to move at {speed[j]:.2f} rad/s to be at the first point"
                f" ({first[j]:.3f} rad) in {seconds:.3f} s from {self._command.position[j]:.3f} rad; its limit is"
                f" {self.group.max_velocity[j]:.2f}",
                code=Code.LIMITS,
            )

    def _check_start(self, first: Array, measured: Array, tolerance: Array) -> None:
        allowed = np.minimum(tolerance, self.group.max_velocity * self._config.blend_time)
        j = int(np.argmax(np.abs(first - measured) - allowed))
        if abs(first[j] - measured[j]) > allowed[j]:
            raise TrajectoryError(
                f"the trajectory starts with {self.group.names[j]} at {first[j]:.3f} rad, but it is at"
                f" {measured[j]:.3f}, more than {allowed[j]:.3f} away; plan from the present position",
                TrajectoryResult.PATH_TOLERANCE_VIOLATED,
            )

    def _tolerances(self, given: Mapping[str, float], default: float) -> Array:
        return np.array([_or_default(given.get(name, 0.0), default) for name in self.group.names])

    def _finish(self, end: End, result: TrajectoryResult, text: str) -> None:
        if self._goal is not None:
            done, self._goal = self._goal.done, None
            self.careful = "" if end is End.SUCCEEDED else self.careful
            done(TrajectoryOutcome(end, result, text))


def _or_default(value: float, default: float) -> float:
    """Return the default for 0 and no bound for a negative value, as in control_msgs."""
    return default if value == 0.0 else (np.inf if value < 0.0 else value)
