# SPDX-License-Identifier: Apache-2.0
"""Regions of configurations: intervals of joints, volumes of a point of the tool, tolerances of its orientation.

What is constrained is fixed to the tool: a link that moves with it, known by its pose there. Base frame, m, rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.turns import nearest_turns
from openarm_common.types import Array

#: What inverse kinematics and rounding may leave, added to every tolerance: m, rad.
_SLACK_M, _SLACK_RAD = 1e-4, 1e-3
#: Tolerances that make no difference to whether a pose is in reach: m, rad.
POSE_M, POSE_RAD = 1e-3, 1e-3


@dataclass(frozen=True)
class JointInterval:
    """Position of a joint, and how far it may be above and below, rad or m.

    Attributes:
        weight: Same as in `TaskRegion.weights`.
        upper: Upper limit of the joint; infinite where whole turns make no difference.
    """

    joint: str
    position: float
    above: float
    below: float
    weight: float = 1.0
    upper: float = 0.0

    def __post_init__(self) -> None:
        """Refuse numbers that are no interval.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming the joint.
        """
        if not np.isfinite([self.position, self.above, self.below]).all() or min(self.above, self.below) < 0.0:
            text = f"position {self.position:g}, tolerances {self.below:g} below and {self.above:g} above"
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"constraint of {self.joint}: {text}; expected finite numbers, tolerances >= 0"
            )


@dataclass(frozen=True, eq=False)
class Volume:
    """A box (three edges), sphere (radius) or cylinder about z (height, radius) at `T` (4, 4)."""

    kind: Literal["box", "sphere", "cylinder"]
    T: Array
    size: tuple[float, ...]

    @property
    def extent(self) -> float:
        """The longest of its measures, m."""
        return max(self.size)

    def excess(self, points: Array) -> Array:
        """How far each of the points (m, 3) is outside, m; 0 inside."""
        local = np.abs((points - self.T[:3, 3]) @ self.T[:3, :3])
        if self.kind == "sphere":
            return np.maximum(np.linalg.norm(local, axis=1) - self.size[0], 0.0)
        if self.kind == "box":
            return np.linalg.norm(np.maximum(local - 0.5 * np.array(self.size), 0.0), axis=1)
        side = np.maximum(np.hypot(local[:, 0], local[:, 1]) - self.size[1], 0.0)
        return np.hypot(side, np.maximum(local[:, 2] - 0.5 * self.size[0], 0.0))

    def sample(self, rng: np.random.Generator) -> Array:
        """A point (3,) inside, drawn uniformly."""
        if self.kind == "box":
            local = rng.uniform(-0.5, 0.5, 3) * np.array(self.size)
        elif self.kind == "sphere":
            direction = rng.normal(size=3)
            local = direction / np.linalg.norm(direction) * self.size[0] * rng.uniform() ** (1 / 3)
        else:
            turn, radius = rng.uniform(0.0, 2.0 * np.pi), self.size[1] * np.sqrt(rng.uniform())
            local = np.array([radius * np.cos(turn), radius * np.sin(turn), rng.uniform(-0.5, 0.5) * self.size[0]])
        return self.T[:3, 3] + self.T[:3, :3] @ local


@dataclass(frozen=True, eq=False)
class PositionRegion:
    """A point `p_tool` (3,) of the tool lies in one of the volumes; `link` is for messages."""

    link: str
    p_tool: Array
    volumes: tuple[Volume, ...]
    weight: float = 1.0

    def excess(self, poses: Array) -> Array:
        """How far outside the point is at poses (m, 4, 4) of the tool, m."""
        points = poses[:, :3, 3] + poses[:, :3, :3] @ self.p_tool
        return np.min([volume.excess(points) for volume in self.volumes], axis=0)


@dataclass(frozen=True, eq=False)
class OrientationRegion:
    """A link fixed to the tool is turned as `R` (3, 3), but for a tolerance about each axis of that, rad.

    Attributes:
        link: Name of the link, for messages.
        R_tool_link: (3, 3).
        R: (3, 3) of the link.
        tolerance: (3,) about x, y, z.
        vector: The error is a rotation vector; else intrinsic angles about x, y and z.
    """

    link: str
    R_tool_link: Array
    R: Array
    tolerance: tuple[float, float, float]
    vector: bool = False
    weight: float = 1.0

    def excess(self, poses: Array) -> Array:
        """How far the worst angle is beyond its tolerance at poses (m, 4, 4) of the tool, rad."""
        errors = Rotation.from_matrix(self.R.T @ poses[:, :3, :3] @ self.R_tool_link)
        angles = errors.as_rotvec() if self.vector else errors.as_euler("XYZ")
        return np.maximum(np.abs(angles) - np.array(self.tolerance), 0.0).max(axis=1)

    def sample(self, rng: np.random.Generator) -> Array:
        """An orientation (3, 3) of the tool inside."""
        angles = rng.uniform(-1.0, 1.0, 3) * np.minimum(self.tolerance, np.pi)
        turn = Rotation.from_rotvec(angles) if self.vector else Rotation.from_euler("XYZ", angles)
        return self.R @ turn.as_matrix() @ self.R_tool_link.T

    def middle(self) -> Array:
        """Orientation (3, 3) of the tool that is asked for."""
        return self.R @ self.R_tool_link.T


@dataclass(frozen=True, eq=False)
class TaskRegion:
    """Configurations that satisfy all of these."""

    joints: tuple[JointInterval, ...] = ()
    positions: tuple[PositionRegion, ...] = ()
    orientations: tuple[OrientationRegion, ...] = ()

    def __bool__(self) -> bool:
        """Whether anything is constrained."""
        return bool(self.joints or self.positions or self.orientations)

    @property
    def weights(self) -> tuple[float, ...]:
        """What the distances of `outside` count for when a state is judged, part by part; all must be 0 anyhow."""
        return tuple(part.weight for part in (*self.joints, *self.positions, *self.orientations))

    @property
    def one_pose(self) -> bool:
        """Whether position and orientation leave nothing to choose, but for `POSE_M` and `POSE_RAD`."""
        volumes = [volume for position in self.positions for volume in position.volumes]
        small = len(volumes) == 1 and volumes[0].extent <= POSE_M
        return small and any(max(one.tolerance) <= POSE_RAD for one in self.orientations)

    def check(self, names: Sequence[str]) -> None:
        """Refuse joints that are not among these.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the joints there are.
        """
        for interval in self.joints:
            if interval.joint not in names:
                text = f"constraint of joint {interval.joint!r}; joints of the arm: {', '.join(names)}"
                raise OpenArmError(Code.INVALID_ARGUMENT, text)

    def outside(self, names: Sequence[str], states: Array, poses: Array) -> list[tuple[str, Array]]:
        """How far configurations are outside, part by part.

        Args:
            names: Joints.
            states: (m, n) rad.
            poses: (m, 4, 4) of the tool there.

        Returns:
            What is constrained, with its unit, and (m,) how far it is beyond its tolerance; 0 inside.
        """
        out: list[tuple[str, Array]] = []
        for interval in self.joints:
            middle = interval.position + 0.5 * (interval.above - interval.below)
            x = nearest_turns(states[:, list(names).index(interval.joint)], middle, interval.upper) - interval.position
            beyond = np.maximum(np.maximum(x - interval.above, -x - interval.below), 0.0)
            out.append((f"rad of {interval.joint}", np.where(beyond > _SLACK_RAD, beyond, 0.0)))
        for position in self.positions:
            beyond = position.excess(poses)
            out.append((f"m of the position of {position.link}", np.where(beyond > _SLACK_M, beyond, 0.0)))
        for orientation in self.orientations:
            beyond = orientation.excess(poses)
            out.append((f"rad of the orientation of {orientation.link}", np.where(beyond > _SLACK_RAD, beyond, 0.0)))
        return out

    def violations(self, names: Sequence[str], states: Array, poses: Array) -> NDArray[np.bool_]:
        """Which of the configurations (m,) are outside; arguments as `outside`."""
        out = np.zeros(len(states), np.bool_)
        for _, beyond in self.outside(names, states, poses):
            out |= beyond > 0.0
        return out

    def fault(self, names: Sequence[str], q: Array, pose: Array) -> str:
        """What one configuration (n,) violates most, in words; "" when it is inside."""
        worst = max(self.outside(names, q[None], pose[None]), key=lambda part: float(part[1][0]), default=None)
        if worst is None or worst[1][0] == 0.0:
            return ""
        return f"{worst[1][0]:.3f} {worst[0]} beyond the tolerance"
