# SPDX-License-Identifier: Apache-2.0
"""Controllers of all arms and grippers: from goals and position commands to the actuator targets of a tick.

Positions are rad (m of fingers that slide). Called by the thread that steps the world, but for `check_command`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array, Ints
from openarm_control.arm import TrajectoryConfig, TrajectoryFollower
from openarm_control.carrier import Carrier
from openarm_control.follower import Follower
from openarm_control.gripper import GripperConfig, GripperFollower
from openarm_control.joints import JointReadout
from openarm_control.trajectory import LIMIT_SLACK, JointGroup, limits_of


@dataclass(frozen=True)
class PositionCommand:
    """A checked position command: positions by joint, and the names of unknown joints."""

    positions: Mapping[str, float]
    unknown: tuple[str, ...]

    @classmethod
    def checked(
        cls, names: Sequence[str], positions: Sequence[float], limits: Mapping[str, tuple[float, float]]
    ) -> PositionCommand:
        """Check positions against the limits of the joints that are known.

        Raises:
            OpenArmError: INVALID_ARGUMENT or LIMITS for the whole command, naming joint and value.
        """
        if len(names) != len(positions):
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"a command has {len(names)} names and {len(positions)} positions, expected as many",
            )
        known: dict[str, float] = {}
        for name, position in zip(names, positions, strict=True):
            if name not in limits:
                continue
            lower, upper = limits[name]
            if not np.isfinite(position):
                raise OpenArmError(
                    Code.INVALID_ARGUMENT, f"commanded position of {name} is {position}, expected a finite number"
                )
            if not lower - LIMIT_SLACK <= position <= upper + LIMIT_SLACK:
                raise OpenArmError(
                    Code.LIMITS,
                    f"commanded position of {name} is {position:.4f}, out of its limits {lower:.4f} to {upper:.4f}",
                )
            known[name] = float(position)
        return cls(known, tuple(name for name in names if name not in limits))


class JointController(Protocol):
    """Makes the servo targets of all joints of a robot, one control tick at a time; in one thread."""

    joint_names: tuple[str, ...]

    def update(self, state: JointReadout, dt_ns: int) -> Array:
        """Return the targets (n,) of a tick of `dt_ns` that begins at `state`; valid until the next call."""
        ...

    def effort_limits(self) -> Array:
        """Return the effort limits (n,) of the joints, N m or N; infinite where there is none."""
        ...

    def reset(self, state: JointReadout) -> None:
        """Hold where the robot is, because it was put elsewhere; goals that run are aborted."""
        ...

    def stop(self, why: str) -> None:
        """Hold all joints at once."""
        ...

    def abort(self, why: str) -> None:
        """Give up all goals."""
        ...


class RobotController(JointController):
    """Followers of all joint groups.

    Args:
        arms: Joint group of each arm by side.
        grippers: Joint group (one finger joint) of each gripper by side.
        joint_names: Order of the joints, of states and of targets.
        state: State of the joints.
        gripper_effort: Limit of each finger joint, N or N m, by side.
        trajectory: Settings of how arms follow.
        gripper: Settings of how grippers move.
        carriers: Make servo targets of the command of each arm, by side.
    """

    def __init__(
        self,
        arms: Mapping[str, JointGroup],
        grippers: Mapping[str, JointGroup],
        joint_names: tuple[str, ...],
        state: JointReadout,
        gripper_effort: Mapping[str, float],
        trajectory: TrajectoryConfig,
        gripper: GripperConfig,
        carriers: Mapping[str, Carrier],
    ) -> None:
        self.joint_names = joint_names
        self._timeout_ns = round(trajectory.command_timeout * 1e9)
        self._commanded_ns: dict[Follower, int] = {}
        self._now_ns = state.t_ns
        self._targets = state.position.copy()
        at = {
            group: np.array([joint_names.index(name) for name in group.names])
            for group in (*arms.values(), *grippers.values())
        }
        self.arms = {
            side: TrajectoryFollower(group, trajectory, carriers[side], self._targets[at[group]])
            for side, group in arms.items()
        }
        self.grippers = {
            side: GripperFollower(group, gripper, self._targets[at[group]], gripper_effort[side])
            for side, group in grippers.items()
        }
        self._followers: list[tuple[Follower, Ints]] = [
            (follower, at[follower.group]) for follower in (*self.arms.values(), *self.grippers.values())
        ]
        self._limits = limits_of(*arms.values(), *grippers.values())
        #: Upper limits of the joints (n,), infinite for those that turn without end.
        self.upper: Array = np.array([self._limits.get(name, (0.0, 0.0))[1] for name in joint_names])

    def check_command(self, names: Sequence[str], positions: Sequence[float]) -> PositionCommand:
        """Check a position command; names may be a part of the joints, in any order. May run in any thread.

        Raises:
            OpenArmError: Same as `PositionCommand.checked`.
        """
        return PositionCommand.checked(names, positions, self._limits)

    def sides(self, command: PositionCommand) -> tuple[str, ...]:
        """Return the sides whose arm or gripper a command moves."""
        followers = (*self.arms.items(), *self.grippers.items())
        return tuple({side: None for side, f in followers if not command.positions.keys().isdisjoint(f.group.names)})

    def busy(self, command: PositionCommand) -> tuple[str, ...]:
        """Return the joints of a command that are ignored because their arm or gripper follows a goal."""
        return tuple(name for f, _ in self._followers if f.busy for name in f.group.names if name in command.positions)

    def command(self, command: PositionCommand) -> None:
        """Go to the positions of a checked command, with bounded speed; hold when no other follows in time."""
        for follower, _ in self._followers:
            target = np.array([command.positions.get(name, np.nan) for name in follower.group.names])
            if not np.isnan(target).all():
                follower.set_target(target)
                self._commanded_ns[follower] = self._now_ns

    def reset(self, state: JointReadout) -> None:
        """Hold the positions of a world that was reset; goals that run are aborted."""
        self._targets[:] = state.position
        self._commanded_ns.clear()
        for follower, at in self._followers:
            follower.reset(state.position[at])

    def begin(self, targets: Array) -> None:
        """Begin where servos have targets (n,) already, NaN where they are not known; after `reset`."""
        for follower, at in self._followers:
            if not np.isnan(targets[at]).any():
                follower.begin(targets[at])

    def stop(self, why: str) -> None:
        """Hold all joints at once; hands keep what they hold, goals that run are aborted."""
        self._commanded_ns.clear()
        for follower, _ in self._followers:
            follower.stop(why)

    def be_careful(self, joints: Sequence[str], why: str) -> None:
        """Let the arms and grippers of some joints move slowly until a goal is reached."""
        for follower, _ in self._followers:
            if not set(joints).isdisjoint(follower.group.names):
                follower.careful = why

    def abort(self, why: str) -> None:
        """Give up all goals, because the physics diverged."""
        for follower, _ in self._followers:
            follower.abort(why)

    def update(self, state: JointReadout, dt_ns: int) -> Array:
        """Return the actuator targets (n,) of a tick of `dt_ns` that begins at `state`; valid until the next call."""
        self._now_ns = state.t_ns
        self._hold_where_commands_ceased()
        for follower, at in self._followers:
            self._targets[at] = follower.update(
                state.t_ns, dt_ns, state.position[at], state.velocity[at], state.effort[at]
            )
        for side, gripper in self.grippers.items():
            self.arms[side].carrier.hold(gripper.pressing)
        return self._targets

    def carry_by(self, carriers: Mapping[str, Carrier]) -> None:
        """Let other carriers make the targets of the arms, because more is known of the servos."""
        for side, carrier in carriers.items():
            self.arms[side].carry_by(carrier)

    def commanded(self) -> Array:
        """Return where the joints (n,) should be now; their targets are off by what carries the arms."""
        positions = self._targets.copy()
        for follower, at in self._followers:
            positions[at] = follower.commanded
        return positions

    def effort_limits(self) -> Array:
        """Return the effort limits (n,) of the joints, N or N m; infinite but for those of the grippers."""
        limits = np.full(len(self.joint_names), np.inf)
        for follower, at in self._followers:
            if isinstance(follower, GripperFollower):
                limits[at] = follower.effort_limit
        return limits

    def _hold_where_commands_ceased(self) -> None:
        for follower, since_ns in list(self._commanded_ns.items()):
            if self._now_ns - since_ns > self._timeout_ns:
                follower.halt()
                del self._commanded_ns[follower]
