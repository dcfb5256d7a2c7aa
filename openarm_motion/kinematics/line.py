# SPDX-License-Identifier: Apache-2.0
"""Straight lines of the tool on one branch of the inverse kinematics.

The tool's origin moves on the line, its orientation turns at a constant rate; the elbow's swivel angle stays (or drifts
by a constant rate where that was asked for), so nothing flips on the way. Base frame, m, rad.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.collision.exact import CollisionScene, Contact
from openarm_motion.kinematics.chain import IkSolution
from openarm_motion.kinematics.chain_kernels import ROTATION_LENGTH
from openarm_motion.kinematics.inverse import InverseKinematics

#: Distance and turn of the tool between two points of a line.
STEP_M = 0.005
STEP_RAD = 0.025
#: Fewest points: a quintic spline needs six.
_FEWEST = 7


@dataclass(frozen=True, eq=False)
class Line:
    """A solved straight line.

    Attributes:
        q: (m, n) configurations, rad.
        s: (m,) way of the tool from the start, m (a turn counts as if at `ROTATION_LENGTH` from its axis).
    """

    q: Array
    s: Array

    def reversed(self) -> Line:
        """The same line the other way."""
        return Line(self.q[::-1].copy(), self.s[-1] - self.s[::-1])


def line_way(T_a: Array, T_b: Array) -> float:
    """Return the way of the tool from one pose to another, m; see `Line.s`."""
    length = float(np.linalg.norm(T_b[:3, 3] - T_a[:3, 3]))
    return length + ROTATION_LENGTH * se3.angle_between(T_a[:3, :3], T_b[:3, :3])


def line_poses(T_a: Array, T_b: Array) -> tuple[Array, Array]:
    """Poses (m, 4, 4) from one to another, `STEP_M` and `STEP_RAD` apart at most, and the way (m,) to each."""
    length = float(np.linalg.norm(T_b[:3, 3] - T_a[:3, 3]))
    turn = se3.angle_between(T_a[:3, :3], T_b[:3, :3])
    m = max(_FEWEST, int(np.ceil(max(length / STEP_M, turn / STEP_RAD))) + 1)
    u = np.linspace(0.0, 1.0, m)
    if turn < 1e-9:
        poses = np.repeat(T_a[None], m, axis=0)
        poses[:, :3, 3] += u[:, None] * (T_b[:3, 3] - T_a[:3, 3])
    else:
        poses = np.stack([se3.interpolate(T_a, T_b, float(x)) for x in u])
    return poses, u * line_way(T_a, T_b)


def solve_line(
    inverse: InverseKinematics,
    start: IkSolution,
    T_start: Array,
    T_end: Array,
    margin: float,
    max_step: float = 0.2,
    swivel_change: float = 0.0,
) -> Line:
    """Solve the line from the pose of `start` to another.

    Args:
        inverse: The arm.
        start: Configuration at `T_start`, with its branch.
        T_start: (4, 4).
        T_end: (4, 4).
        margin: Kept from the joint limits, rad.
        max_step: Greatest change of a joint between two points, rad.
        swivel_change: Angle that the elbow swivels by along the line, rad.

    Raises:
        OpenArmError: UNREACHABLE, with the distance from the start at which the line ends and why.
    """
    poses, s = line_poses(T_start, T_end)
    q, reached, why = inverse.follow(poses, start, margin, max_step, swivel_change)
    if reached < len(poses):
        raise OpenArmError(
            Code.UNREACHABLE,
            f"the straight line of {s[-1] * 1e3:.0f} mm ends after {s[max(reached - 1, 0)] * 1e3:.0f} mm: {why}",
        )
    return Line(q, s)


def line_contact(scene: CollisionScene, line: Line) -> Contact | None:
    """Something that the arm would come too near to on the line, or None; the ends are checked first."""
    m = len(line.q)
    order = [m - 1, 0, *range(m // 2, m - 1), *range(1, m // 2)]
    for k in order:
        if scene.collides(line.q[k]):
            return scene.contacts(line.q[k])[0]
    return None
