# SPDX-License-Identifier: Apache-2.0
"""Both arms and both grippers: from goals and position commands to the actuator targets of a tick.

Positions are rad (finger joints: m). Called by the thread that steps the world, but for `check_command`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_sim_bridge.control.arm import TrajectoryConfig, TrajectoryFollower
from openarm_sim_bridge.control.gripper import GripperConfig, GripperFollower
from openarm_sim_bridge.control.trajectory import JointGroup
from openarm_sim_bridge.world.world import JointReadout, World

_LIMIT_SLACK = 1e-4


@dataclass(frozen=True)
class PositionCommand:
    """A checked position command: what is known of it, and the names that nothing here is called by."""

    positions: Mapping[str, float]
    unknown: tuple[str, ...]


class RobotController:
    """Followers of all joint groups.

    Args:
        arms: Joint group of each arm by side.
        grippers: Joint group (one finger joint) of each gripper by side.
        world: Where the joints are; its joint order is that of the targets.
        trajectory: How arms follow.
        gripper: How grippers move.
    """

    def __init__(
        self,
        arms: Mapping[str, JointGroup],
        grippers: Mapping[str, JointGroup],
        world: World,
        trajectory: TrajectoryConfig,
        gripper: GripperConfig,
    ) -> None:
        self._names = world.joint_names
        self._timeout_ns = round(trajectory.command_timeout * 1e9)
        self._commanded_ns: dict[TrajectoryFollower | GripperFollower, int] = {}
        self._now_ns = world.t_ns
        self._targets = world.read_joints().position
        lead, limits = world.target_lead_s(), world.effort_limits()
        self.arms: dict[str, TrajectoryFollower] = {}
        self.grippers: dict[str, GripperFollower] = {}
        self._columns: dict[str, NDArray[np.intp]] = {}
        for side, group in arms.items():
            at = self._columns_of(group)
            self._columns[side] = at
            self.arms[side] = TrajectoryFollower(group, trajectory, lead[at], self._targets[at])
        self._fingers: dict[str, int] = {}
        for side, group in grippers.items():
            (finger,) = self._columns_of(group)
            self._fingers[side] = int(finger)
            self.grippers[side] = GripperFollower(group, gripper, float(self._targets[finger]), float(limits[finger]))

        self._limits = {
            name: (float(lower), float(upper))
            for group in (*arms.values(), *grippers.values())
            for name, lower, upper in zip(group.names, group.lower, group.upper, strict=True)
        }

    def check_command(self, names: Sequence[str], positions: Sequence[float]) -> PositionCommand:
        """Check a position command; names may be a part of the joints, in any order. May run in any thread.

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
            if name not in self._limits:
                continue
            lower, upper = self._limits[name]
            if not np.isfinite(position):
                raise OpenArmError(
                    Code.INVALID_ARGUMENT, f"commanded position of {name} is {position}, expected a finite number"
                )
            if not lower - _LIMIT_SLACK <= position <= upper + _LIMIT_SLACK:
                raise OpenArmError(
                    Code.LIMITS,
                    f"commanded position of {name} is {position:.4f}, out of its limits {lower:.4f} to {upper:.4f}",
                )
            known[name] = float(position)
        return PositionCommand(known, tuple(name for name in names if name not in self._limits))

    def busy(self, command: PositionCommand) -> tuple[str, ...]:
        """Joints of a command that are ignored because their arm or gripper follows a goal."""
        following = (*self.arms.values(), *self.grippers.values())
        return tuple(name for f in following if f.busy for name in f.group.names if name in command.positions)

    def command(self, command: PositionCommand) -> None:
        """Go to the positions of a checked command, with bounded speed; hold when no other follows in time."""
        positions = command.positions
        for arm in self.arms.values():
            target = np.array([positions.get(name, np.nan) for name in arm.group.names])
            if not np.all(np.isnan(target)):
                arm.set_target(target)
                self._commanded_ns[arm] = self._now_ns
        for gripper in self.grippers.values():
            if gripper.group.names[0] in positions:
                gripper.set_target(positions[gripper.group.names[0]])
                self._commanded_ns[gripper] = self._now_ns

    def reset(self, state: JointReadout) -> None:
        """Hold the positions of a world that was reset; goals that run are aborted."""
        self._targets[:] = state.position
        self._commanded_ns.clear()
        for side, arm in self.arms.items():
            arm.reset(state.position[self._columns[side]])
        for side, gripper in self.grippers.items():
            gripper.reset(float(state.position[self._fingers[side]]))

    def abort(self, why: str) -> None:
        """Give up all goals, because the world can't go on."""
        for follower in (*self.arms.values(), *self.grippers.values()):
            follower.abort(why)

    def update(self, state: JointReadout, dt_ns: int) -> Array:
        """Actuator targets (n,) for the tick of `dt_ns` that begins at `state`; valid until the next call."""
        self._now_ns = state.t_ns
        self._watch(state.t_ns)
        for side, arm in self.arms.items():
            at = self._columns[side]
            self._targets[at] = arm.update(state.t_ns, dt_ns, state.position[at], state.velocity[at])
        for side, gripper in self.grippers.items():
            i = self._fingers[side]
            self._targets[i] = gripper.update(
                state.t_ns, dt_ns, float(state.position[i]), float(state.velocity[i]), float(state.effort[i])
            )
        return self._targets

    def _watch(self, t_ns: int) -> None:
        """Hold where position commands have ceased."""
        for follower, since_ns in list(self._commanded_ns.items()):
            if t_ns - since_ns > self._timeout_ns:
                follower.halt()
                del self._commanded_ns[follower]

    def effort_limits(self) -> dict[int, float]:
        """Effort limits of the grippers by joint index, N."""
        return {self._fingers[side]: gripper.effort_limit for side, gripper in self.grippers.items()}

    def _columns_of(self, group: JointGroup) -> NDArray[np.intp]:
        return np.array([self._names.index(name) for name in group.names], dtype=np.intp)
