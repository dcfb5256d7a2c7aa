# SPDX-License-Identifier: Apache-2.0
"""Injected faults of robot and world, applied by the thread that steps the world.

Targets (n,) and joint columns are in the order of the world's joints; times are simulated, ns.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.motors.emulated import EmulatedBuses
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from openarm_sim_bridge.faults.faults import (
    Fault,
    FrictionLowered,
    GripperStuck,
    GripperWeak,
    JointLate,
    JointSag,
    JointStateGap,
    MotorFault,
    ObjectNudged,
    OfSide,
    ParametersT,
    find,
)
from openarm_sim_bridge.world.world import World


class WorldFaults:
    """Active faults of a world.

    Args:
        description: The robot.
        joint_names: Order of the targets.
    """

    def __init__(self, description: RobotDescription, joint_names: tuple[str, ...]) -> None:
        self._description = description
        by_joint = {joint: name for name, arm in description.arms.items() for joint in arm.controlled}
        fingers = {arm.finger_joint for arm in description.arms.values()}
        self._arms = tuple(by_joint.get(joint, "") for joint in joint_names)
        self._fingers = tuple(i for i, joint in enumerate(joint_names) if joint in fingers)
        self._faults: dict[str, Fault] = {}
        self._model: mujoco.MjModel | None = None
        self._friction: Array = np.zeros(0)
        self._gravcomp: Array = np.zeros(0)
        self._changed = False
        self._stuck: dict[int, float] = {}
        #: Where frames of buses command the robot.
        self.motors: EmulatedBuses | None = None

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the faults that are active."""
        return tuple(self._faults)

    def inject(self, fault: Fault, world: World) -> None:
        """Begin a fault.

        Raises:
            OpenArmError: INVALID_ARGUMENT for an object or an arm that is not there; SCENE_INVALID where the object
                would be pushed into something.
        """
        arms = self._description.arm_names
        if isinstance(fault.parameters, OfSide) and fault.parameters.side not in ("both", *arms):
            text = f"no side {fault.parameters.side[:80]!r}; sides: {', '.join(arms)}, both"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        if isinstance(fault.parameters, ObjectNudged):
            nudge(world, fault.parameters, fault.seed)
            return
        if isinstance(fault.parameters, MotorFault):
            if self.motors is None:
                text = "no motor takes frames here; that needs mujoco_bridge.controllers: motors"
                raise OpenArmError(Code.INVALID_ARGUMENT, text)
            self.motors.inject(fault.parameters.kind, fault.parameters.joint, fault.parameters.value)
        self._faults[fault.name] = fault
        self._renew()

    def clear(self, name: str = "") -> None:
        """End one fault, or all."""
        if self.motors is not None and any(name in ("", key) for key in self._motor_faults()):
            self.motors.inject("clear")
        self._faults = {key: fault for key, fault in self._faults.items() if name not in ("", key)}
        self._renew()

    def _motor_faults(self) -> list[str]:
        return [key for key, fault in self._faults.items() if isinstance(fault.parameters, MotorFault)]

    def _renew(self) -> None:
        self._changed = True
        self._stuck.clear()

    def prepare(self, world: World) -> None:
        """Put the faults into the model, once after each change of faults or model; before a tick."""
        if world.model is not self._model:
            self._model = world.model
            self._friction = world.model.geom_friction.copy()
            self._gravcomp = world.model.body_gravcomp.copy()
            self._changed |= bool(self._faults)
        if not self._changed:
            return
        self._changed = False
        late = self._of(JointLate)
        delays = [late.ms * 1e-3 if late is not None and late.hits(arm) else 0.0 for arm in self._arms]
        world.delay_commands(np.array(delays))
        model = world.model
        model.geom_friction[:] = self._friction
        model.body_gravcomp[:] = self._gravcomp
        if (friction := self._of(FrictionLowered)) is not None:
            model.geom_friction[:] *= friction.scale
        if (sag := self._of(JointSag)) is not None:
            hit = [arm for arm in self._description.arm_names if sag.hits(arm)]
            for link in (link for arm in hit for link in self._description.links_of(arm)):
                model.body_gravcomp[model.body(link).id] -= 1.0 - sag.share

    def targets(self, wanted: Array) -> Array:
        """Return the actuator targets (n,) that take effect in place of the wanted ones."""
        if not self._faults:
            return wanted
        out = wanted.copy()
        if (stuck := self._of(GripperStuck)) is not None:
            for i in self._fingers:
                if stuck.hits(self._arms[i]):
                    out[i] = self._stuck.setdefault(i, float(out[i]))
        return out

    def effort_limits(self, limits: Array) -> Array:
        """Return the effort limits (n,) that take effect; `limits` are infinite but for those of the grippers."""
        weak = self._of(GripperWeak)
        if weak is None:
            return limits
        out = limits.copy()
        out[[i for i in self._fingers if weak.hits(self._arms[i])]] *= weak.share
        return out

    def publishes_joints(self, t_ns: int) -> bool:
        """Whether the joint state of a tick is published."""
        gap = self._of(JointStateGap)
        if gap is None:
            return True
        every_ns, gap_ns = round(gap.every * 1e9), round(gap.ms * 1e6)
        period, inside = divmod(t_ns, every_ns)
        seed = self._faults["joint_state_gap"].seed
        begin = np.random.default_rng([seed, period]).uniform(0.0, max(0.0, every_ns - gap_ns))
        return not begin <= inside < begin + gap_ns

    def _of(self, model: type[ParametersT]) -> ParametersT | None:
        return find(self._faults.values(), model) if self._faults else None


def nudge(world: World, parameters: ObjectNudged, seed: int) -> None:
    """Push an object aside.

    Args:
        world: The world.
        parameters: Name of the object, and the distance.
        seed: Seed of the direction.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the objects there are; SCENE_INVALID, when it would overlap something.
    """
    T_world_object = world.object(parameters.object).T_world_object
    heading = np.random.default_rng(seed).uniform(-math.pi, math.pi)
    shift = 1e-3 * parameters.mm * np.array([math.cos(heading), math.sin(heading), 0.0])
    world.move_object(parameters.object, se3.make(None, shift) @ T_world_object)
