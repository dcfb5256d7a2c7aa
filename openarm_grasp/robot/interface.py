# SPDX-License-Identifier: Apache-2.0
"""The interface to a robot, its cameras and its planner, whatever is behind: a node graph, or a world in this process.

Everything is a coroutine that ends: by its work, a deadline, a cancel, or a lost robot. Trajectories are opaque here:
the planner's, handed back to be executed. Base frame, m, rad; robot time in ns.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol, TypeAlias

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.types import Array
from openarm_grasp.config import LEAST_SCALE
from openarm_grasp.perception.detections import Frame
from openarm_grasp.planning.candidates import Box, GraspCandidate, PlaceTarget
from openarm_grasp.planning.options import Refusal

Trajectory: TypeAlias = object


@dataclass(frozen=True)
class PlanGrasp:
    """Choose and plan one of the candidates with one arm; result `Planned`.

    Attributes:
        target: The object, as one box or several, base frame; the fingers may touch it, and it goes with the hand.
        ignore_regions: Regions that the object will have left by then: the map still shows it there.
        start: Joints that it starts from: of the lift, then of the arm, rad and m; empty: the present ones.
        velocity_scale: Share of the speed of other motions.
        blend: The transfer goes on to the grasp without a stop, as it does to a place.
    """

    arm: str
    candidates: tuple[GraspCandidate, ...]
    obstacles: tuple[Box, ...]
    target: tuple[Box, ...]
    ignore_regions: tuple[Box, ...] = ()
    start: tuple[float, ...] = ()
    velocity_scale: float = 1.0
    blend: bool = False


@dataclass(frozen=True)
class PlanPlace:
    """Choose and plan one of the place targets; result `Planned`.

    Attributes:
        held: Boxes of what the hand carries, TCP frame.
        after: Trajectory whose end is the start; None starts at the present joints.
        ignore_regions: Regions that the object has left: the map may still show it there.
    """

    arm: str
    targets: tuple[PlaceTarget, ...]
    obstacles: tuple[Box, ...]
    held: tuple[Box, ...]
    after: Trajectory | None = None
    ignore_regions: tuple[Box, ...] = ()
    velocity_scale: ClassVar[float] = 1.0
    blend: ClassVar[bool] = True


@dataclass(frozen=True)
class Planned:
    """A plan: which of the offered ways was chosen, and its three trajectories.

    Attributes:
        chosen: Index of the way.
        transfer: Free path to the beginning of the approach.
        approach: Straight line to where it grasps or lets go; None: the transfer goes on to there without a stop.
        retreat: Straight line away.
        refusals: Why others were refused, by id.
        limit_margins: Of each way, how near it comes to a joint limit, rad; NaN: refused or not evaluated. Empty when
            the planner does not say.
        start: Joints at its beginning, rad by name.
        duration: Duration of the three, s.
        scene_version: Version of the planning scene that it was planned in.
    """

    chosen: int
    transfer: Trajectory
    approach: Trajectory
    retreat: Trajectory
    refusals: Mapping[str, Refusal] = field(default_factory=dict[str, Refusal])
    limit_margins: tuple[float, ...] = ()
    start: Mapping[str, float] = field(default_factory=dict[str, float])
    duration: float = 0.0
    scene_version: int = 0


class RobotInterface(Protocol):
    """A robot, its cameras and its planner."""

    @property
    def description(self) -> RobotDescription:
        """The robot."""
        ...

    @property
    def states(self) -> RobotStateBuffer:
        """Its joint states."""
        ...

    deadline_ns: int
    """Robot time after which `check` raises CANCELLED; 0: none."""

    velocity_scale: float
    """Share of the limits of the joints that motions take."""

    @property
    def now_ns(self) -> int:
        """Robot time."""
        ...

    def effort(self, joint: str) -> float:
        """Newest effort of a joint, N or N m; 0 when none is published."""
        ...

    def pads(self, arm: str) -> tuple[float, ...]:
        """Force on each finger pad of a hand, N; empty without a sensor."""
        ...

    def held_box(self, arm: str) -> Box | None:
        """What the planner carries in a hand, TCP frame; None when it knows of nothing there."""
        ...

    def check(self) -> None:
        """Raise when the work may not go on: CANCELLED, ROBOT_LOST."""

    def warn(self, text: str) -> None:
        """Report something that does not stop the work."""

    def expect_near(self, camera: str) -> None:
        """Announce an observation by the camera on the hand, which may need a moment to wake."""

    def stop_observing(self) -> None:
        """The camera is not needed for now."""

    async def until(
        self, done: Callable[[], bool], limit: float, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        """Wait for a condition, no longer than `limit` s; `guard` is called at each check and may raise."""

    async def together(self, parts: Sequence[Callable[[], Awaitable[None]]]) -> None:
        """Carry out several coroutines at once; all end before this does, then the first error is raised."""

    async def observe(self, count: int, *, near: str = "") -> tuple[Frame, ...]:
        """Frames that are taken from now on, oldest first, by the camera over the table, or by one on a hand."""
        ...

    async def plan(self, request: PlanGrasp | PlanPlace) -> Planned:
        """Plan; raises with the planner's code."""
        ...

    async def scene_version(self) -> int:
        """Version of the planning scene."""
        ...

    async def reach(self, arm: str, T_base_tcp: Array) -> Mapping[str, float]:
        """How far the arm's TCP stays from a point, m by arm; empty when that cannot be said."""
        ...

    async def follow(
        self, arm: str, trajectory: Trajectory, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        """Follow a planned trajectory."""

    async def move(
        self, arm: str, to: str | Array, what: str, obstacles: Sequence[Box] = (), *, plan_only: bool = False
    ) -> None:
        """Move an arm on a free path to a named posture, or its TCP on a straight line to a pose (4, 4).

        The lift goes to a position (1,), m. `plan_only`: nothing moves; raises what the motion would be refused with.
        """

    async def grip(self, arm: str, joint: str, position: float, what: str, effort: float = 0.0) -> bool:
        """Move the fingers with at most `effort` N (0: any); whether they arrived or push against something."""
        ...


def slowed(scale: float, share: float) -> float:
    """A share of a velocity scale, no less than what the planner accepts."""
    return max(scale * share, LEAST_SCALE)


def check_deadline(now_ns: int, deadline_ns: int) -> None:
    """Raise CANCELLED when the time of a request is over."""
    if 0 < deadline_ns < now_ns:
        raise OpenArmError(
            Code.CANCELLED, "the time for the request is over; the arm holds, and the hand keeps what it has"
        )
