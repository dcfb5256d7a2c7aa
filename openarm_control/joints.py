# SPDX-License-Identifier: Apache-2.0
"""The joints that are controlled, and what carries them: of the robot's description."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from openarm_common.robot.description import RobotDescription
from openarm_common.robot.lift import LIFT
from openarm_common.robot.servos import ArmLoad, ServoModel
from openarm_common.types import Array
from openarm_control.carrier import Carrier, CarrierConfig
from openarm_control.loop_gains import safe_gains
from openarm_control.trajectory import JointGroup

#: Mass that a hand may hold while errors are corrected, kg.
_HELD_MASS = 0.5
#: Delay of a correction on top of the latency, s: a control tick, and half of one for which a target is kept.
_DELAY_S = 0.015


@dataclass(frozen=True)
class JointReadout:
    """State of the controlled joints at `t_ns`, arrays (n,): rad, rad/s, N m; of a finger that slides m, m/s, N."""

    t_ns: int
    position: Array
    velocity: Array
    effort: Array


def joint_names(description: RobotDescription) -> tuple[str, ...]:
    """Return the controlled joints: of each arm its own, then the driving finger joint."""
    return tuple(name for arm in description.arms.values() for name in arm.controlled)


def arm_groups(description: RobotDescription) -> dict[str, JointGroup]:
    """Return the joint group of each arm, by name."""
    return {name: _group(description, arm.joints) for name, arm in description.arms.items()}


def lift_group(description: RobotDescription) -> dict[str, JointGroup]:
    """Return the joint group of the lift, by the name of its controller; none without one."""
    return {} if description.lift is None else {LIFT: _group(description, (description.lift.joint,))}


def lift_carriers(description: RobotDescription, config: CarrierConfig) -> dict[str, Carrier]:
    """Return what makes servo targets for the lift, whose drive carries it; as `lift_group`."""
    lift = description.lift
    if lift is None:
        return {}
    stiffness, damping, none = (np.array([value]) for value in (lift.stiffness, lift.damping, 0.0))
    return {LIFT: Carrier(ServoModel(stiffness, damping, none, none, none), config)}


def gripper_groups(description: RobotDescription) -> dict[str, JointGroup]:
    """Return the joint group (the driving finger joint) of each gripper, by arm."""
    return {name: _group(description, (hand.joint,), lever=hand.lever) for name, hand in description.hands.items()}


def arm_loads(description: RobotDescription) -> dict[str, ArmLoad]:
    """Return what motions of each arm take, by name."""
    return {name: ArmLoad(description, arm.joints, arm.tcp) for name, arm in description.arms.items()}


def carriers(
    description: RobotDescription, config: CarrierConfig, servos: Mapping[str, ServoModel]
) -> dict[str, Carrier]:
    """Return what makes servo targets of commands, by side.

    Args:
        description: The robot.
        config: Settings of how it carries.
        servos: Servos by side, as far as known.
    """
    soft = any(one.soft for one in servos.values())
    loads = arm_loads(description) if soft else {}
    found = dict[str, Carrier]()
    for side, one in servos.items():
        if not one.soft:
            found[side] = Carrier(one, config)
            continue
        limits = description.limits(description.arm_joints(side), np.pi)
        inertia = loads[side].inertia(*limits, _HELD_MASS) + one.armature
        gains = safe_gains(one.stiffness, one.damping, inertia, one.latency_s + _DELAY_S)
        found[side] = Carrier(one, config, loads[side], gains)
    return found


def _group(description: RobotDescription, names: Sequence[str], lever: float = 1.0) -> JointGroup:
    lower, upper = description.limits(names)
    speeds = np.array([description.joint(name).velocity for name in names])
    return JointGroup(
        tuple(names), lower, upper, speeds, lever
    )  # those of the motors, far above what a plan should use
