# SPDX-License-Identifier: Apache-2.0
"""Faults of robot and world, worked by the thread that steps the world.

Targets (n,) and joint columns are in the order of the world's joints; times are simulated, ns.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import mujoco
import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_sim_bridge.faults.faults import (
    Fault,
    FrictionLowered,
    GripperWeak,
    JointLate,
    JointSag,
    JointStateGap,
    ObjectNudged,
)
from openarm_sim_bridge.world.world import World


class WorldFaults:
    """Faults that are active in a world.

    Args:
        joint_names: Order of the targets; the name says the side (`left`, `right`) and whether it is a finger.
        period_ns: Length of a control tick.
    """

    def __init__(self, joint_names: tuple[str, ...], period_ns: int) -> None:
        self._names = joint_names
        self._period_ns = period_ns
        self._faults: dict[str, Fault] = {}
        self._model: mujoco.MjModel | None = None
        self._friction: Array = np.zeros(0)
        self._gravcomp: Array = np.zeros(0)
        self._changed = False
        self._stuck: dict[int, float] = {}
        self._late: deque[Array] = deque()

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the faults that are active."""
        return tuple(self._faults)

    def inject(self, fault: Fault, world: World) -> None:
        """Begin a fault.

        Raises:
            OpenArmError: INVALID_ARGUMENT for an object that is not there; SCENE_INVALID where it would be pushed into
                something.
        """
        if isinstance(fault.parameters, ObjectNudged):
            nudge(world, fault.parameters, fault.seed)
            return
        self._faults[fault.name] = fault
        self._renew()

    def clear(self, name: str = "") -> None:
        """End one fault, or all."""
        if name:
            self._faults.pop(name, None)
        else:
            self._faults.clear()
        self._renew()

    def _renew(self) -> None:
        self._changed = True
        self._stuck.clear()
        self._late.clear()

    def prepare(self, world: World) -> None:
        """Put the faults into the model, once after each change of faults or model; before a tick."""
        if world.model is not self._model:
            self._model = world.model
            self._friction = world.model.geom_friction.copy()
            self._gravcomp = world.model.body_gravcomp.copy()
            self._changed = bool(self._faults)
        if not self._changed:
            return
        self._changed = False
        model = world.model
        model.geom_friction[:] = self._friction
        model.body_gravcomp[:] = self._gravcomp
        for fault in self._faults.values():
            parameters = fault.parameters
            if isinstance(parameters, FrictionLowered):
                model.geom_friction[:] *= parameters.scale
            elif isinstance(parameters, JointSag):
                for body in range(model.nbody):
                    name = model.body(body).name
                    if any(f"_{side}_" in name and fault.hits(side) for side in ("left", "right")):
                        model.body_gravcomp[body] *= parameters.share

    def targets(self, wanted: Array) -> Array:
        """Actuator targets (n,) that take effect, of those that are wanted."""
        if not self._faults:
            return wanted
        out = wanted.copy()
        late = self._faults.get("joint_late")
        if late is not None and isinstance(late.parameters, JointLate):
            self._late.append(wanted.copy())
            ticks = round(late.parameters.ms * 1e6 / self._period_ns)
            before = self._late.popleft() if len(self._late) > ticks else self._late[0]
            hit = [i for i, name in enumerate(self._names) if late.hits(_side(name))]
            out[hit] = before[hit]
        stuck = self._faults.get("gripper_stuck")
        if stuck is not None:
            for i, name in enumerate(self._names):
                if "finger" in name and stuck.hits(_side(name)):
                    out[i] = self._stuck.setdefault(i, float(out[i]))
        return out

    def effort_limits(self, limits: Mapping[int, float]) -> Mapping[int, float]:
        """Effort limits by joint index that take effect."""
        weak = self._faults.get("gripper_weak")
        if weak is None or not isinstance(weak.parameters, GripperWeak):
            return limits
        share = weak.parameters.share
        return {i: limit * (share if weak.hits(_side(self._names[i])) else 1.0) for i, limit in limits.items()}

    def tells_joints(self, t_ns: int) -> bool:
        """Whether the joint state of a tick is published."""
        gap = self._faults.get("joint_state_gap")
        if gap is None or not isinstance(gap.parameters, JointStateGap):
            return True
        every_ns, gap_ns = round(gap.parameters.every * 1e9), round(gap.parameters.ms * 1e6)
        period, inside = divmod(t_ns, every_ns)
        begin = np.random.default_rng([gap.seed, period]).uniform(0.0, max(0.0, every_ns - gap_ns))
        return not begin <= inside < begin + gap_ns


def _side(joint: str) -> str:
    return "left" if "_left_" in joint else "right"


def nudge(world: World, parameters: ObjectNudged, seed: int) -> None:
    """Push an object aside.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the objects there are; SCENE_INVALID, when something is in the way.
    """
    there = {readout.object.name: readout for readout in world.objects()}
    if parameters.object not in there:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"no object {parameters.object!r}; objects: {', '.join(there) or 'none'}"
        )
    heading = np.random.default_rng(seed).uniform(-math.pi, math.pi)
    shift = 1e-3 * parameters.mm * np.array([math.cos(heading), math.sin(heading), 0.0])
    world.move_object(parameters.object, se3.make(None, shift) @ there[parameters.object].T_world_object)
