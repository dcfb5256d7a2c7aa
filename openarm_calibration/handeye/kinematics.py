# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics with offsets of the joints' zeros, lengths of links and flexure as parameters; m, rad, N m."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Pose of a tip in a base frame, and how it changes with the parameters of the joints.

    Args:
        description: The robot.
        base: Link in whose frame the pose is.
        tip: Link.
        parameters: Names: a joint for its offset, `joint length`, `joint flexure`; those of other chains are allowed.
    """

    description: RobotDescription
    base: str
    tip: str
    parameters: tuple[str, ...]

    def evaluate(
        self, q: Mapping[str, float], change: Array, torque: Mapping[str, float] | None = None
    ) -> tuple[Array, Array]:
        """Return A (4, 4) and its change by each parameter (6, parameters): position in base axes, rotation in tip's.

        Args:
            q: Positions that the encoders report, rad.
            change: (parameters,) rad, m, rad/(N m).
            torque: Torque of the joints, N m; none for stiff ones.
        """
        at = dict(zip(self.parameters, np.asarray(change).tolist(), strict=True))
        index = {name: k for k, name in enumerate(self.parameters)}
        (T_tip, moves_tip), (T_base, moves_base) = (
            self._walk(link, q, at, torque or {}) for link in (self.tip, self.base)
        )
        by = np.zeros((6, len(self.parameters)))
        p = T_tip[:3, 3]
        for moves, sign in ((moves_tip, 1.0), (moves_base, -1.0)):
            known = [move for move in moves if move[0] in index]
            if not known:
                continue
            names, factors, axes, points, turning = zip(*known, strict=True)
            axis, turns = np.array(axes), np.array(turning)[:, None]
            moved = np.concatenate([np.where(turns, np.cross(axis, p - np.array(points)), axis), axis * turns], axis=1)
            columns = [index[name] for name in names]
            np.add.at(by.T, columns, sign * np.array(factors)[:, None] * moved)
        by[:3] = T_base[:3, :3].T @ by[:3]
        by[3:] = T_tip[:3, :3].T @ by[3:]
        return se3.inverse(T_base) @ T_tip, by

    def _walk(
        self, link: str, q: Mapping[str, float], at: Mapping[str, float], torque: Mapping[str, float]
    ) -> tuple[Array, list[tuple[str, float, Array, Array, bool]]]:
        T = np.eye(4)
        moves: list[tuple[str, float, Array, Array, bool]] = []
        for joint in self.description.chain(link):
            origin = joint.T_parent_joint
            length = f"{joint.name} length"
            if length in at:
                along = origin[:3, 3] / np.linalg.norm(origin[:3, 3])
                moves.append((length, 1.0, T[:3, :3] @ along, T[:3, 3], False))
                origin = origin.copy()
                origin[:3, 3] += along * at[length]
            T = T @ origin
            if joint.type == "fixed":
                continue
            leader = joint.mimic or joint.name
            if leader not in q:
                there = ", ".join(q) or "no joints"
                raise OpenArmError(Code.INVALID_ARGUMENT, f"no position of joint {leader!r}; got {there}")
            flexure, load = f"{leader} flexure", torque.get(leader, 0.0)
            own = q[leader] + at.get(leader, 0.0) + at.get(flexure, 0.0) * load
            ratio = joint.multiplier if joint.mimic is not None else 1.0
            axis = T[:3, :3] @ joint.axis
            for name, factor in ((leader, ratio), (flexure, ratio * load)):
                moves.append((name, factor, axis, T[:3, 3].copy(), joint.type != "prismatic"))
            T = T @ joint.motion(ratio * own + (joint.offset if joint.mimic is not None else 0.0))
        return T, moves


@dataclass(frozen=True, eq=False)
class ArmPosture:
    """Joint positions of a view, as `problem.Arm`."""

    kinematics: Kinematics
    q: Mapping[str, float]
    torque: Mapping[str, float] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of parameters."""
        return len(self.kinematics.parameters)

    def scaled(self, factor: float) -> ArmPosture:
        """Return the posture of positions in another unit."""
        return ArmPosture(self.kinematics, {name: value * factor for name, value in self.q.items()}, self.torque)

    def at(self, zeros: Array) -> tuple[Array, Array]:
        """Return A (4, 4) at changed parameters, and how it changes with each (6, parameters)."""
        return self.kinematics.evaluate(self.q, zeros, self.torque)
