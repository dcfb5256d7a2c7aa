# SPDX-License-Identifier: Apache-2.0
"""Kinematics of a serial arm from its URDF: forward, Jacobian, damped least squares inverse, and its links.

Works for any chain of revolute, continuous and prismatic joints from the description's root to a tool link; no link or
joint name is written down here. Poses are `T_base_tool` (4, 4) in the description's root frame; angles rad, m.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import Joint, RobotDescription
from openarm_common.robot.tree import KinematicTree, TreeArrays
from openarm_common.robot.tree_kernels import forward, forward_many, jacobian, unplaced
from openarm_common.robot.turns import nearest_turns
from openarm_common.types import Array
from openarm_motion.kinematics import chain_kernels as kernels

#: Guesses for the nearest configuration to what is out of reach.
_OUT_OF_REACH = 4


@dataclass(frozen=True)
class IkResult:
    """Answer of the numeric inverse kinematics.

    Attributes:
        success: Whether the errors are within the tolerances.
        q: (n,) rad; when not successful, the configuration nearest to the target that was found.
        position_error: m.
        orientation_error: rad; not a criterion when the position alone counted.
    """

    success: bool
    q: Array
    position_error: float
    orientation_error: float

    @property
    def cost(self) -> float:
        """Both errors as one, m²."""
        return self.position_error**2 + (kernels.ROTATION_LENGTH * self.orientation_error) ** 2

    def away(self, *, position_only: bool) -> str:
        """How far from the target, with as many digits as it takes: what is not zero never reads so."""
        turn = math.degrees(self.orientation_error)
        parts = [] if position_only or turn < 1e-3 else [f"{digits(turn)}°"]
        if self.position_error > 1e-6 or not parts:
            parts.insert(0, f"{digits(self.position_error * 1e3)} mm")
        return " and ".join(parts)


@dataclass(frozen=True, eq=False)
class IkSolution:
    """One configuration (n,) of the arm at a pose, and what singles it out among the others.

    Attributes:
        q: rad.
        swivel: Angle of the elbow about the line from shoulder to wrist; NaN for an arm solved numerically.
        branch: Branch of the closed form; -1 for an arm solved numerically.
    """

    q: Array
    swivel: float = math.nan
    branch: int = -1


class ArmKinematics:
    """One serial arm.

    Args:
        description: The robot.
        tool_link: Link whose pose is solved for; the movable joints between the root and it are the arm's joints.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the link is unknown or no joint moves it.
    """

    def __init__(self, description: RobotDescription, tool_link: str) -> None:
        if tool_link not in description.links:
            links = ", ".join(description.links)
            raise OpenArmError(Code.INVALID_ARGUMENT, f"tool link {tool_link!r} is not in the URDF; links: {links}")
        tree = KinematicTree(description)
        rows = [i for i, joint in enumerate(tree.joints) if joint in description.chain(tool_link)]
        if not rows:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no joint moves the tool link {tool_link!r}")
        self.tool_link = tool_link
        self.names: tuple[str, ...] = tuple(tree.joints[i].name for i in rows)
        #: Limits, infinite for joints that turn without end, and the same with half a turn in their place.
        self.lower, self.upper = description.limits(self.names)
        self.span = description.limits(self.names, np.pi)
        _, placements, axes, prismatic = tree.arrays
        self.placements, self.axes, self.prismatic = placements[rows], axes[rows], prismatic[rows]
        #: The chain as the kernels take it.
        self.chain: TreeArrays = (np.arange(len(rows)), self.placements, self.axes, self.prismatic)
        self.tip: Array = tree.fixed[tool_link]
        slides = np.where(self.prismatic, np.maximum(np.abs(self.lower), np.abs(self.upper)), 0.0)
        offsets = np.linalg.norm([*self.placements[1:, :3, 3], self.tip[:3, 3]], axis=1)
        #: The tool is nowhere further than this from the origin of the first joint, m.
        self.reach = float(offsets.sum() + slides.sum())

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.names)

    @property
    def middle(self) -> Array:
        """Middle (n,) of the limits; 0 of a joint that has none."""
        return 0.5 * (self.span[0] + self.span[1])

    def fk(self, q: ArrayLike) -> Array:
        """`T_base_tool` (4, 4) of a configuration (n,)."""
        return self._forward(q)[0]

    def fk_many(self, q: ArrayLike) -> Array:
        """Tool poses (m, 4, 4) of configurations (m, n)."""
        return forward_many(np.ascontiguousarray(q, dtype=np.float64), *self.chain, self.n, self.tip)

    def beyond(self, pose: Array, tolerance: float) -> bool:
        """Whether a pose (4, 4) is certainly out of reach by more than a tolerance, m."""
        return bool(np.linalg.norm(pose[:3, 3] - self.placements[0, :3, 3]) > self.reach + tolerance)

    def joint_axes(self, q: ArrayLike) -> tuple[Array, Array]:
        """A point on each joint axis and its direction, (n, 3) each, base frame."""
        levers = self._forward(q)[1]
        return levers[:, 3:], levers[:, :3]

    def jacobian(self, q: ArrayLike) -> Array:
        """(6, n) of the tool's origin: linear velocity over angular velocity, for each joint velocity."""
        pose, levers = self._forward(q)
        out = np.empty((6, self.n))
        jacobian(levers, self.prismatic, pose[:3, 3], out)
        return out

    def margin(self, q: ArrayLike) -> float:
        """Distance to the nearest joint limit, rad; negative outside."""
        values = np.asarray(q, dtype=np.float64)
        return float(np.min(np.minimum(values - self.lower, self.upper - values)))

    def outside(self, q: ArrayLike, margin: float = 0.0) -> str:
        """Sentence about the joint that is furthest outside its limits less `margin`; empty when all are inside."""
        values = np.asarray(q, dtype=np.float64)
        excess = np.maximum(self.lower + margin - values, values - self.upper + margin)
        i = int(np.argmax(excess))
        if excess[i] <= 1e-9:
            return ""
        allowed = f"{self.lower[i] + margin:.3f} to {self.upper[i] - margin:.3f}"
        return f"{self.names[i]} would be at {values[i]:.3f} rad, allowed {allowed}" + (
            f" (limits less a margin of {margin:g})" if margin else ""
        )

    def closest(self, q: ArrayLike) -> str:
        """Sentence about the joint that is nearest to one of its limits."""
        values = np.asarray(q, dtype=np.float64)
        room = np.minimum(values - self.lower, self.upper - values)
        i = int(np.argmin(room))
        limit = self.lower[i] if values[i] - self.lower[i] < self.upper[i] - values[i] else self.upper[i]
        return f"{self.names[i]} would be at {values[i]:.3f} rad, {room[i]:.3f} rad from its limit {limit:.3f}"

    def ik(
        self,
        target: Array,
        seed: ArrayLike | None = None,
        *,
        position_only: bool = False,
        margin: float = 0.0,
        tolerance: tuple[float, float] = (1e-5, 1e-4),
        restarts: int = 200,
    ) -> IkResult:
        """Solve for a tool pose; never raises for one that is out of reach but returns the nearest found.

        Args:
            target: (4, 4) `T_base_tool`.
            seed: (n,) first guess, which redundant motion is pulled towards, and in the turn of which joints without
                end are; default the middle of the limits.
            position_only: The orientation of the target is ignored.
            margin: Kept from every joint limit, rad.
            tolerance: Position (m) and orientation (rad).
            restarts: Random guesses after the first, the same each time; every other one near the limits.
        """
        middle = self.middle
        first = middle if seed is None else np.asarray(seed, dtype=np.float64)
        best = np.empty(self.n)
        if self.beyond(target, tolerance[0]):
            restarts = min(restarts, _OUT_OF_REACH)
        success, error_p, error_r = kernels.solve_ik(
            np.ascontiguousarray(target, dtype=np.float64),
            np.ascontiguousarray(first),
            bool(position_only),
            (float(tolerance[0]), float(tolerance[1])),
            restarts,
            np.minimum(self.lower + margin, middle),
            np.maximum(self.upper - margin, middle),
            *self.chain,
            self.tip,
            best,
        )
        return IkResult(bool(success), nearest_turns(best, first, self.upper), float(error_p), float(error_r))

    def _forward(self, q: ArrayLike) -> tuple[Array, Array]:
        values = np.ascontiguousarray(q, dtype=np.float64)
        if values.shape != (self.n,):
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"got {values.size} joint positions, expected {self.n}: {', '.join(self.names)}"
            )
        pose, levers = np.empty((4, 4)), np.empty((self.n, 6))
        forward(values, *self.chain, self.n, self.tip, unplaced(self.n), levers, pose)
        return pose, levers


@dataclass(frozen=True)
class ArmLinks:
    """Links of one arm.

    Attributes:
        moving: Every link that the arm's joints move, the gripper's included.
        gripper: Links that further joints beyond the arm move: the fingers and what is fixed to them.
        hand: The gripper, what carries it, and the tool link: what a held object may touch.
        fixed: Links of the robot that no joint moves.
    """

    moving: frozenset[str]
    gripper: frozenset[str]
    hand: frozenset[str]
    fixed: frozenset[str]

    @classmethod
    def of(cls, description: RobotDescription, kinematics: ArmKinematics) -> ArmLinks:
        """Sort the links of `description` for the arm of `kinematics`."""
        chains = {link: [j for j in description.chain(link) if j.type != "fixed"] for link in description.links}
        moving = {link for link, joints in chains.items() if any(j.name in kinematics.names for j in joints)}
        after = {link: _after(joints, kinematics.names[-1]) for link, joints in chains.items()}
        gripper = {link for link, joints in after.items() if joints}
        carriers = {joints[0].parent for joints in after.values() if joints}
        # without a gripper the last rigid body is the hand
        hand = gripper | carriers or {link for link in moving if chains[link][-1] is chains[kinematics.tool_link][-1]}
        return cls(
            moving=frozenset(moving),
            gripper=frozenset(gripper),
            hand=frozenset(hand | {kinematics.tool_link}),
            fixed=frozenset(link for link, joints in chains.items() if not joints),
        )


def _after(joints: Sequence[Joint], name: str) -> list[Joint]:
    """The joints of a chain that come after that of a name."""
    return list(itertools.dropwhile(lambda joint: joint.name != name, joints))[1:]


def digits(value: float) -> str:
    """A figure that only reads 0 when it is: whole from 1 on, else with two digits."""
    return f"{value:.0f}" if value >= 1.0 else f"{value:.2g}"
