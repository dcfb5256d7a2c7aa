# SPDX-License-Identifier: Apache-2.0
"""The position servos of an arm, and the torques that its motions take.

Arrays (k,) are in the order of its joints, from the shoulder; N m, rad, s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array


@dataclass(frozen=True, eq=False)
class ServoModel:
    """What is known of the servos of an arm; arrays (k,).

    Attributes:
        stiffness: Position gain, N m/rad.
        damping: Velocity gain and that of the gearbox, N m s/rad.
        friction: Dry friction, N m.
        armature: Inertia of rotor and gear, kg m2.
        latency_s: (k,) from a command to its effect.
        weight: Share of the arm's weight that the servos leave to the client.
    """

    stiffness: Array
    damping: Array
    friction: Array
    armature: Array
    latency_s: Array
    weight: float = 0.0

    @property
    def soft(self) -> bool:
        """Whether there is something to carry and to correct: ideal servos need but their lag."""
        return self.weight > 0.0


class ArmLoad:
    """Torques that a motion of an arm takes, by the robot's description.

    Args:
        description: The robot.
        joints: Joints of the arm, from the shoulder.
        tool: Link in whose origin a held mass is.
    """

    def __init__(self, description: RobotDescription, joints: Sequence[str], tool: str) -> None:
        whole = pin.buildModelFromXML(description.urdf)
        others = [i for i, name in enumerate(whole.names) if i > 0 and name not in joints]
        self._model = pin.buildReducedModel(whole, others, pin.neutral(whole))
        self._data, self._zero = self._model.createData(), pin.neutral(self._model)
        self._order = [self._model.joints[self._model.getJointId(name)].idx_v for name in joints]
        self._tool = self._model.getFrameId(tool)
        #: Viscous damping of the description, N m s/rad.
        self.damping: Array = np.array(self._model.damping)[self._order]
        #: Dry friction of the description, N m.
        self.friction: Array = np.array(self._model.friction)[self._order]

    def torque(self, q: Array, v: Array, a: Array) -> Array:
        """Return the torques (k,) of a motion without friction and armature."""
        tau: Array = np.array(pin.rnea(self._model, self._data, self._at(q), self._full(v), self._full(a)))
        return tau[self._order]

    def torque_of_mass(self, q: Array) -> Array:
        """Return the torques (k,) that hold 1 kg at the tool."""
        held: Array = -np.array(self._model.gravity.linear) @ self._jacobian(q)
        return held

    def tool_offset(self, q: Array, error: Array) -> float:
        """Return how far errors (k,) of joints at q put the tool off, m."""
        return float(np.linalg.norm(self._jacobian(q) @ error))

    def inertia(self, lower: Array, upper: Array, mass: float, n: int = 200) -> Array:
        """Return the inertias (3, k) of the joints that occur within limits: least, middle, most with a held mass.

        Args:
            lower: (k,) limits of the joints.
            upper: The same.
            mass: Mass at the tool, kg.
            n: Postures that are tried.
        """
        rng, found, held = np.random.default_rng(0), list[Array](), list[Array]()
        for _ in range(n):
            q = rng.uniform(lower, upper)
            found.append(np.diag(pin.crba(self._model, self._data, self._at(q)))[self._order])
            held.append(mass * np.sum(self._jacobian(q) ** 2, axis=0))
        return np.stack([np.min(found, axis=0), np.median(found, axis=0), np.max(np.add(found, held), axis=0)])

    def _jacobian(self, q: Array) -> Array:
        """Translation of the tool by joint, (3, k), m/rad."""
        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian: Array = np.array(pin.computeFrameJacobian(self._model, self._data, self._at(q), self._tool, frame))
        return jacobian[:3, self._order]

    def _at(self, q: Array) -> Array:
        """Configuration of the model, which has cosine and sine of a joint that turns without end."""
        return np.asarray(pin.integrate(self._model, self._zero, self._full(q)))

    def _full(self, values: Array) -> Array:
        full = np.empty(self._model.nv)
        full[self._order] = values
        return full
