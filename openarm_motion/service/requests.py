# SPDX-License-Identifier: Apache-2.0
"""Requests to the motion service and its answers. Poses (4, 4) of the tool; m, rad, s."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, Self, TypeAlias

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.collision.solids import Box, Solid
from openarm_motion.constraints.asked import CartesianGoal, RegionGoal
from openarm_motion.kinematics.chain import IkResult
from openarm_motion.planning.approach import ApproachFailedError, ApproachPlan, ApproachRequest, Refused
from openarm_motion.planning.arm import Scale
from openarm_motion.planning.dual_arm import DualArmPlan
from openarm_motion.scene.map_view import MapState
from openarm_motion.timing.trajectory import Motion, Trajectory


# --- goals of one arm
@dataclass(frozen=True, eq=False)
class JointGoal:
    """Joint positions (n,), on a free path."""

    q: Array


@dataclass(frozen=True, eq=False)
class NamedGoal:
    """A posture of the SRDF, on a free path."""

    name: str


@dataclass(frozen=True, eq=False)
class PoseGoal:
    """A tool pose in a frame ("" is the base frame), on a free path; `position_only`: position alone counts."""

    pose: Array
    frame: str = ""
    position_only: bool = False


@dataclass(frozen=True, eq=False)
class LineGoal:
    """A tool pose in a frame, on a straight line."""

    pose: Array
    frame: str = ""


@dataclass(frozen=True, eq=False)
class YieldGoal:
    """Stay, or go to a posture where the arm is in the way of the other one."""

    name: str = "home"


Goal: TypeAlias = JointGoal | NamedGoal | PoseGoal | LineGoal | RegionGoal | CartesianGoal
DualGoal: TypeAlias = JointGoal | NamedGoal | PoseGoal | YieldGoal | RegionGoal
Strategy = Literal["any", "together", "staggered"]


# --- requests
@dataclass(frozen=True, eq=False)
class PlanApproachRequest:
    """Choose and plan one of several approaches.

    Attributes:
        arm: Name of the arm.
        approach: Targets, obstacles and what is held.
        start: (n,) joints that it starts from, or (1 + n,), of a lift and the arm; empty: the present ones.
        scale: Velocity scale; 0: the default.
        ignore_regions: Boxes, base frame; what the map still shows there is left out.
        scene_version: Version that the planning scene must have; 0: any.
    """

    arm: str
    approach: ApproachRequest
    start: Array = field(default_factory=lambda: np.zeros(0))
    scale: float = 0.0
    ignore_regions: tuple[Box, ...] = ()
    scene_version: int = 0


@dataclass(frozen=True, eq=False)
class MoveRequest:
    """Plan, and unless `plan_only` execute, a motion of one arm, or of the lift that carries all of them.

    Attributes:
        arm: Name of the arm; `lift`: the lift, with a `JointGoal` of its position, m.
        goal: Goal of the motion.
        obstacles: Boxes, base frame.
        attached: Boxes held by the arm, tool frame; empty: what it is known to hold.
        hand_empty: It holds nothing: what it was known to hold is forgotten.
        scale: Scale of velocity, or of velocity and acceleration; 0: the default.
        plan_only: Do not move.
        max_start_delay: Longest wait for clearance next to an arm under way, s.
        scene_version: Version that the planning scene must have; 0: any.
        state: Positions of joints, by name, that are taken in place of the present ones.
        attempts: Paths that are searched for, of which the one that is followed soonest is taken.
    """

    arm: str
    goal: Goal
    obstacles: tuple[Box, ...] = ()
    attached: tuple[Box, ...] = ()
    hand_empty: bool = False
    scale: Scale = 0.0
    plan_only: bool = False
    max_start_delay: float = 0.0
    scene_version: int = 0
    state: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    attempts: int = 1

    @property
    def arms(self) -> tuple[str, ...]:
        """Name of the arm."""
        return (self.arm,)


@dataclass(frozen=True, eq=False)
class ArmGoal:
    """Goal of one arm of a dual-arm motion, on a free path; `attached` and `hand_empty` as in `MoveRequest`."""

    arm: str
    goal: DualGoal
    attached: tuple[Box, ...] = ()
    hand_empty: bool = False


@dataclass(frozen=True, eq=False)
class MoveArmsRequest:
    """Plan, and unless `plan_only` execute, a dual-arm motion; attributes as in `MoveRequest`.

    Attributes:
        time_limit: Time limit of the search, s; 0: the default.
    """

    targets: tuple[ArmGoal, ...]
    strategy: Strategy = "any"
    obstacles: tuple[Box, ...] = ()
    scale: Scale = 0.0
    plan_only: bool = False
    scene_version: int = 0
    state: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    attempts: int = 1
    time_limit: float = 0.0

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the arms."""
        return tuple(target.arm for target in self.targets)


@dataclass(frozen=True, eq=False)
class ExecuteRequest:
    """Execute a trajectory; attributes as in `MoveRequest`."""

    arm: str
    motion: Motion
    max_start_delay: float = 0.0
    scene_version: int = 0

    @property
    def arms(self) -> tuple[str, ...]:
        """Name of the arm."""
        return (self.arm,)


# --- answers
@dataclass(frozen=True, eq=False)
class MotionAnswer:
    """What came of a request: `error` is None after a success.

    Attributes:
        error: Why it failed.
        message: A sentence.
        scene_version: Version of the planning scene that it was planned in.
        planning_time: s.
        start_delay: Time that the arm rested first for another arm under way, s.
    """

    error: OpenArmError | None = None
    message: str = ""
    scene_version: int = 0
    planning_time: float = 0.0
    start_delay: float = 0.0

    def __post_init__(self) -> None:
        if self.error is not None:
            self.error.settled()

    @property
    def code(self) -> Code:
        """OK, or the error's."""
        return Code.OK if self.error is None else self.error.code

    def require(self) -> Self:
        """Return this after a success, else raise the error."""
        if self.error is not None:
            raise self.error
        return self


@dataclass(frozen=True, eq=False)
class ApproachAnswer(MotionAnswer):
    """A planned approach."""

    plan: ApproachPlan | None = None

    @property
    def refusals(self) -> tuple[Refused, ...]:
        """Why targets were not chosen, whether one was or none."""
        known = self.plan or self.error
        return known.refusals if isinstance(known, ApproachPlan | ApproachFailedError) else ()


@dataclass(frozen=True, eq=False)
class MoveAnswer(MotionAnswer):
    """A planned, and maybe executed, motion of one arm."""

    trajectory: Trajectory | None = None


@dataclass(frozen=True, eq=False)
class MoveArmsAnswer(MotionAnswer):
    """A planned, and maybe executed, dual-arm motion."""

    plan: DualArmPlan | None = None

    @property
    def trajectory(self) -> Trajectory | None:
        """Of the joints of both arms."""
        return None if self.plan is None else self.plan.whole


@dataclass(frozen=True, eq=False)
class IkAnswer:
    """Nearest configuration to a pose, and the tool's pose there; `error` is None when it solves the pose."""

    nearest: IkResult
    pose: Array
    error: OpenArmError | None = None


@dataclass(frozen=True, eq=False)
class SceneState:
    """The planning scene, ids of what can't be changed in it, and the map."""

    version: int
    solids: tuple[Solid, ...]
    fixed: tuple[str, ...]
    map: MapState
