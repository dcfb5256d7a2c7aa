# SPDX-License-Identifier: Apache-2.0
"""The controllers of openarm_ros2 as it is since May 2026: positions alone, without interpolation and tolerances.

Sources: joint_trajectory_controller of ros2_controllers (`Trajectory::sample`, Jazzy) with position commands and
`interpolation_method: none`, and the hardware interface of openarm_ros2, which drives all joints to zero when it is
activated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array, Ints
from openarm_control.controller import JointController
from openarm_control.follower import End
from openarm_control.joints import JointReadout
from openarm_control.trajectory import JointGroup, Trajectory
from openarm_sim_bridge.world.world import World

#: Time in which activation takes all joints to zero on a straight line, s.
_ACTIVATION_S = 2.0

Done = Callable[[End, str], None]


@dataclass
class _FollowedGoal:
    t: Array
    q: Array
    start_ns: int
    before: Array  # (k,) where the joints were
    done: Done


class PositionController:
    """One joint_trajectory_controller: between two points it commands the later one, before the first where it is.

    Args:
        names: Its joints.
        position: (k,) that it commands at first.
        limit: Limit of the motors' position commands, +-rad.
    """

    def __init__(self, names: Sequence[str], position: Array, limit: float = math.inf) -> None:
        whole, free = np.full(len(names), limit), np.full(len(names), np.inf)
        #: Its joints; their limits are those of the motors' position commands.
        self.group = JointGroup(tuple(names), -whole, whole, free)
        self.command: Array = position.copy()
        self.measured: Array = position.copy()
        self.velocity: Array = np.zeros_like(position)
        self.t_ns = 0
        self._goal: _FollowedGoal | None = None

    def start(self, trajectory: Trajectory, t_ns: int, done: Done) -> None:
        """Follow a checked trajectory from now on; one that runs is given up."""
        self._end(End.CANCELLED, "a newer trajectory took its place")
        self._goal = _FollowedGoal(trajectory.t, trajectory.q, trajectory.start_ns or t_ns, self.measured.copy(), done)

    def cancel(self) -> None:
        """Hold where the joints are, which lets a soft arm sink."""
        self.hold("cancelled")

    def hold(self, why: str, end: End = End.CANCELLED) -> None:
        """Give up a goal and hold where the joints are."""
        self._end(end, why)
        self.command = self.measured.copy()

    def reset(self, position: Array) -> None:
        """Hold a position."""
        self._end(End.ABORTED, "the robot was put elsewhere")
        self.command = position.copy()

    def update(self, t_ns: int, position: Array, velocity: Array) -> Array:
        """Return the commands (k,) of a control cycle; the goal has succeeded when its time is over."""
        self.t_ns, self.measured, self.velocity = t_ns, position, velocity
        goal = self._goal
        if goal is not None:
            reached = int(np.searchsorted(goal.t, (t_ns - goal.start_ns) * 1e-9 + 1e-9, side="right"))
            self.command = goal.q[min(reached, len(goal.t) - 1)].copy() if reached else goal.before
            if reached == len(goal.t):
                self._end(End.SUCCEEDED, "goal reached")
        return self.command

    def _end(self, end: End, text: str) -> None:
        if self._goal is not None:
            done, self._goal = self._goal.done, None
            done(end, text)


class OpenArmRos2(JointController):
    """All controllers: one of each arm, and one of each gripper.

    Args:
        description: The robot.
        joint_names: Order of the joints.
        state: State of the joints.
    """

    def __init__(self, description: RobotDescription, joint_names: tuple[str, ...], state: JointReadout) -> None:
        self.joint_names = joint_names
        groups: dict[str, Sequence[str]] = {}
        for side in description.arm_names:
            groups[f"{side}_joint_trajectory_controller"] = description.arm_joints(side)
            groups[f"{side}_gripper_controller"] = (description.finger_joint(side),)
        self._at: dict[str, Ints] = {
            name: np.array([joint_names.index(joint) for joint in joints]) for name, joints in groups.items()
        }
        bus = description.motors.bus if description.motors is not None else None
        limit = math.inf if bus is None else bus.position
        #: By name.
        self.controllers = {
            name: PositionController(joints, state.position[self._at[name]], limit) for name, joints in groups.items()
        }
        self._fingers = np.concatenate([self._at[f"{side}_gripper_controller"] for side in description.arm_names])
        self._targets = state.position.copy()

    def update(self, state: JointReadout, dt_ns: int) -> Array:
        """See `JointController.update`."""
        for name, controller in self.controllers.items():
            at = self._at[name]
            self._targets[at] = controller.update(state.t_ns, state.position[at], state.velocity[at])
        return self._targets

    def reported(self, state: JointReadout) -> JointReadout:
        """Return joint states as openarm_ros2 has them: nothing of the fingers but where they are."""
        velocity, effort = state.velocity.copy(), state.effort.copy()
        velocity[self._fingers] = effort[self._fingers] = 0.0
        return replace(state, velocity=velocity, effort=effort)

    def effort_limits(self) -> Array:
        """See `JointController.effort_limits`."""
        return np.full(len(self.joint_names), np.inf)

    def reset(self, state: JointReadout) -> None:
        """See `JointController.reset`."""
        for name, controller in self.controllers.items():
            controller.reset(state.position[self._at[name]])

    def stop(self, why: str) -> None:
        """See `JointController.stop`."""
        for controller in self.controllers.values():
            controller.hold(why, End.ABORTED)

    def abort(self, why: str) -> None:
        """See `JointController.abort`."""
        self.stop(why)


def activate(world: World) -> None:
    """Drive all joints to zero on a straight line, whatever is in the way, as the hardware interface does at its start.

    Raises:
        OpenArmError: INTERNAL, when the physics diverged.
    """
    start, ticks = world.read_joints().position, round(_ACTIVATION_S * 1e9) // world.period_ns
    for k in range(ticks):
        world.set_targets(start * (1.0 - (k + 1) / ticks))
        world.step(world.steps_per_tick)
